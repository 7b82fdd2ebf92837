"""The path-traced reference set: snow, water, smog and layers against closed forms."""

import hashlib
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import ndimage
from support.images import assert_images_match

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from tools.reference_street import phone, publish, render, sky, smog, snowfall, variants, water  # noqa: E402
from tools.reference_street.geometry import box, quad  # noqa: E402
from tools.reference_street.layout import (  # noqa: E402
    build_scene,
    camera_poses,
    ground_datum,
    heldout_poses,
    look,
    passers_by,
)
from tools.reference_street.mirror import mirrored_view  # noqa: E402
from tools.reference_street.objects import bench, fence, table  # noqa: E402
from tools.reference_street.sky import SUN_AZIMUTH, SUN_ELEVATION, direction  # noqa: E402
from tools.reference_street.terrain import DIP_AT, DIP_DEPTH, ground_height  # noqa: E402
from tools.reference_street.textures import make  # noqa: E402
from tools.reference_street.truth import TRAIN_IDS, layers, pixel_rays, sun_directions  # noqa: E402


@pytest.fixture
def yard(monkeypatch):
    """A level yard of 6 m by 6 m with a table, a roof of 42 degrees and one of 65 degrees."""
    monkeypatch.setattr(snowfall, "RINGS", ((3.0, 3.0, 0.05),))
    ground = quad((-3, -3, 0), (6, 0, 0), (0, 6, 0))
    top = box((-2.0, -2.0, 0.7), (-1.0, -1.0, 0.75))

    def roof(x, degrees):
        run = 1.2 * np.cos(np.deg2rad(degrees))
        rise = 1.2 * np.sin(np.deg2rad(degrees))
        return quad((x, 0, 2.0), (run, 0, rise), (0, 2.0, 0))

    return [ground, top, roof(-1.5, 42.0), roof(0.8, 65.0)]


def mean_depth(cover, x0, x1, y0, y1):
    rows, columns = cover.depth.shape
    x = cover.x0 + cover.cell * np.arange(columns)
    y = cover.y0 + cover.cell * np.arange(rows)
    return cover.depth[(y > y0) & (y < y1)][:, (x > x0) & (x < x1)].mean()


@pytest.mark.slow
def test_snow_depth_follows_the_slope_and_its_mass_is_conserved(yard):
    cover, _ = snowfall.snow_cover(yard, 0.15, 0)
    assert mean_depth(cover, 1.8, 2.8, -2.5, -1.0) == pytest.approx(0.15, rel=0.04)
    assert mean_depth(cover, -1.8, -1.2, -1.8, -1.2) == pytest.approx(0.15, rel=0.08), (
        "on the table"
    )
    # EN 1991-1-3: a roof of 42 degrees keeps (60 - 42) / 30 of the snow, one of 65 nothing.
    assert mean_depth(cover, -1.3, -0.8, 0.5, 1.5) == pytest.approx(0.15 * 0.6, rel=0.12)
    assert mean_depth(cover, 0.9, 1.2, 0.5, 1.5) < 0.002
    # Snow that slid off lies below the eaves, packed to half its volume.
    assert mean_depth(cover, -1.9, -1.55, 0.3, 1.7) > 0.175
    slid = 0.15 * 2.4 * (0.4 * np.cos(np.deg2rad(42)) + np.cos(np.deg2rad(65)))
    assert cover.depth.mean() == pytest.approx(0.15 - slid / 2 / 36, rel=0.005)


def test_no_snow_lies_under_a_table(yard):
    cover, _ = snowfall.snow_cover(yard, 0.15, 0)
    mesh = snowfall.cover_mesh(cover, (0.0, 0.0))
    corners = mesh.vertices[mesh.faces].mean(1)
    under = (np.abs(corners[:, :2] + 1.5) < 0.4).all(1)
    assert under.any() and corners[under, 2].min() > 0.75
    tops = corners[(np.abs(corners[:, 0] - 2.3) < 0.4) & (np.abs(corners[:, 1] + 2) < 0.4)]
    assert np.median(tops[:, 2]) == pytest.approx(0.15, rel=0.05)


def test_snow_falls_through_a_crown_without_piling_up(yard):
    """Snow that loose leaves do not hold is spread evenly over the ground below."""
    rng = np.random.default_rng(0)
    leaves = []
    for x, y in rng.uniform((-2.5, -2.8), (2.5, -0.2), (900, 2)):
        pitch = np.deg2rad(rng.uniform(0, 90))
        side, down = (0.12, 0, 0), (0, 0.12 * np.cos(pitch), -0.12 * np.sin(pitch))
        leaves.append(quad((x, y, rng.uniform(2.0, 3.0)), side, down).tagged("l", "", "vegetation"))
    below, held = snowfall.snow_cover([yard[0], *leaves], 0.15, 0)
    under = mean_depth(below, -2.0, 2.0, -2.5, -0.5)
    assert 0.04 < under < 0.13, "less than in the open, but not bare"
    assert below.depth.max() < 0.25, "no piles in the gaps"
    assert held.depth.max() > 0.05
    assert below.depth.mean() + held.depth.mean() == pytest.approx(0.15, rel=0.02)


def test_snow_is_reproducible_by_its_seed(yard):
    first, second = (snowfall.snow_cover(yard, 0.05, 0)[0].depth for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_the_wave_mesh_has_the_waves_of_the_program(tmp_path, monkeypatch):
    from climatenerf.weather.description import read_weather
    from climatenerf.weather.flood.waves import at_time, make_waves

    monkeypatch.setattr(water, "EXTENT", ((-14.0, 14.0), (-22.0, 18.0)))
    water.wavy(5.0, 1.0, tmp_path)
    raw = (tmp_path / "water.ply").read_bytes()
    start = raw.index(b"end_header\n") + len(b"end_header\n")
    (x0, x1), (y0, y1) = water.EXTENT
    columns, rows = round((x1 - x0) / water.STEP) + 1, round((y1 - y0) / water.STEP) + 1
    table = np.frombuffer(raw, "<f4", rows * columns * 6, start).reshape(rows, columns, 6)
    z, normal = table[..., 2].astype(float) - 5.0, table[..., 3:].astype(float)
    inner = (slice(80, -80), slice(80, -80))
    slope_y, slope_x = np.gradient(z, water.STEP)
    analytic = -normal[..., :2] / normal[..., 2:]
    expected = np.stack([slope_x, slope_y], -1)
    error = np.sqrt(((analytic - expected)[inner] ** 2).mean())
    assert error < 0.25 * np.sqrt((analytic[inner] ** 2).mean()), "differences smooth short waves"
    weather = read_weather(REFERENCE / "weather" / "flood-waves.toml").base
    waves = make_waves(weather.flood, weather.seed)
    x, y = np.meshgrid(x0 + water.STEP * np.arange(80, 300), y0 + water.STEP * np.arange(80, 300))
    positions = torch.from_numpy(np.stack([x.ravel(), y.ravel()], -1)).float()
    of_mesh = analytic[80:300, 80:300].reshape(-1, 2)
    for time, same in ((1.0, True), (1.5, False)):
        found = at_time(waves, time).at(positions, torch.zeros(len(positions)))[1].numpy()
        error = ((found - of_mesh) ** 2).mean() / (of_mesh**2).mean()
        assert (error < 0.01) == same, (time, error)
    maps = at_time(waves, 1.0)
    finest = [maps.texels[start : start + 256**2, 0] for start in maps.start]
    spread = np.sqrt(sum(float(height.var()) for height in finest))
    assert z[inner].std() == pytest.approx(spread, rel=0.25)
    assert z[0].std() > 0.5 * spread, "waves out to the border"


def test_periodic_interpolation_is_exact_at_the_nodes():
    values = np.random.default_rng(0).normal(size=(8, 8))
    x, y = np.meshgrid(np.arange(8) * 0.25, np.arange(8) * 0.25)
    np.testing.assert_allclose(water.periodic(values, 2.0, x, y), values)
    np.testing.assert_allclose(water.periodic(values, 2.0, x - 4.0, y + 2.0), values)
    middle = water.periodic(values, 2.0, np.array([0.125]), np.array([0.0]))
    assert middle[0] == pytest.approx((values[0, 0] + values[0, 1]) / 2)


def test_sun_directions_cover_the_core_of_the_sun():
    rays, sun = sun_directions(), direction(SUN_AZIMUTH, SUN_ELEVATION)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1)
    angles = np.degrees(np.arccos(rays @ sun))
    assert angles.max() < 12.5 and angles.min() < 5
    assert np.degrees(np.arccos(rays.mean(0) @ sun / np.linalg.norm(rays.mean(0)))) < 2


def test_test_views_are_clear_of_objects_and_water():
    solid = np.concatenate(
        [m.vertices for m in build_scene() if m.label not in ("road", "terrain")]
    )
    near = solid[np.abs(solid[:, :2]).max(1) < 18]
    photos = np.stack([pose[:3, 3] for _, pose in camera_poses()])
    for name, pose in heldout_poses():
        assert np.linalg.norm(near - pose[:3, 3], axis=-1).min() > 0.3, name
        assert pose[2, 3] > ground_datum()[0] + 0.6 + 0.3, "above the high flood"
        distance = np.linalg.norm(photos - pose[:3, 3], axis=-1).min()
        assert 0.05 < distance < 3.0, "between the photos, but at none of them"


def test_objects_have_their_documented_positions():
    top = table()[0].vertices
    assert ground_height(-6.35, 2.45) + 0.74 < top[:, 2].max() < ground_height(-6.35, 2.45) + 0.76
    pickets = fence()[0].vertices
    assert pickets[:, 0].min() > 5.4 and pickets[:, 0].max() < 5.7
    assert bench()[0].vertices[:, 2].max() < 3
    ring = [ground_height(DIP_AT[0] + 2.5 * np.cos(a), DIP_AT[1]) for a in (0, np.pi)]
    assert np.mean(ring) - ground_height(*DIP_AT) > 0.6 * DIP_DEPTH


def test_people_move_between_the_pictures_that_show_them():
    seen = [passers_by(i) for i in range(64)]
    assert 15 < sum(bool(s) for s in seen) < 40
    walkers = [s[0].vertices.mean(0) for s in seen[2:16]]
    steps = np.linalg.norm(np.diff(walkers, axis=0)[:, :2], axis=1)
    assert steps.min() > 0.5
    for someone in seen:
        for mesh in someone:
            assert mesh.label == "person"
        if someone:
            low = min(mesh.vertices[:, 2].min() for mesh in someone)
            x, y = someone[0].vertices[:, :2].mean(0)
            assert abs(low - ground_height(x, y)) < 0.16  # one foot may be beside the kerb


REFERENCE = ROOT / "reference" / "street"
PHOTOS = {
    "": 64, "busy": 64, "turned": 64, "sparse": 20, "tracks": 64, "plain": 64, "hard": 20,
    "sun": 64, "overcast": 64,
}  # fmt: skip
LIT = ("sun", "overcast")  # under another sky
PLAIN = ("plain", "hard")  # with ground and light of their own


def variant(name):
    return publish.variant_folder(REFERENCE, name) if name else REFERENCE


@pytest.mark.parametrize("name", PHOTOS)
def test_the_set_on_disk_matches_its_checksums(name):
    folder = variant(name)
    lines = (folder / "SHA256SUMS").read_text().splitlines()
    assert len(lines) >= 3
    for line in lines:
        digest, file = line.split("  ")
        assert hashlib.sha256((folder / file).read_bytes()).hexdigest() == digest, file
    files = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
    assert files == {line.split("  ")[1] for line in lines} | {"SHA256SUMS"}


def test_the_set_on_disk_is_small():
    sizes = {p: p.stat().st_size for p in REFERENCE.parent.rglob("*") if p.is_file()}
    folders = {p.relative_to(REFERENCE.parent).parts[0] for p in sizes}
    assert folders == {variant(name).name for name in PHOTOS}
    assert sum(sizes.values()) < 45e6
    for name in ("sparse", "tracks", "hard"):  # lists and points, no pictures
        assert sum(size for p, size in sizes.items() if variant(name) in p.parents) < 300e3


def test_the_set_is_readable_as_capture_and_as_ground_truth():
    from climatenerf.evaluation.reference import read_reference
    from climatenerf.scene import read_scene

    for name, photos in PHOTOS.items():
        scene = read_scene(variant(name))
        assert len(scene.of_split("train")) == photos and len(scene.of_split("heldout")) == 6
        assert all(view.path.is_file() for view in scene.views)
        reference = read_reference(variant(name))
        assert len(reference.truths) == 6
        expected = 0 if name in PLAIN else 1 if name in LIT else 11
        assert len(reference.weathers) == expected
    reference = read_reference(REFERENCE)
    cases = {case.name: case for case in reference.weathers}
    truth = reference.truths[0]
    assert cases["flood-low"].weather.at(0).flood.level == 0.25
    assert cases["flood-waves"].time == publish.WAVE_TIME
    deep = cases["snow-deep"].layers(truth.name)
    snowy = deep["thickness"] > 0.005
    road = snowy & (truth.label == TRAIN_IDS["road"]) & (truth.depth < 20)
    assert np.median(deep["thickness"][road]) == pytest.approx(0.15, rel=0.1)
    # Snow is nearer than the surface below it.
    assert (deep["depth"] < truth.depth + 1e-3)[~truth.sky].all()
    clean = render.encode(truth.clean).astype(float)
    thin = cases["smog-far"].picture(truth.name).astype(float)
    dense = cases["smog-near"].picture(truth.name).astype(float)
    assert np.abs(dense - clean).mean() > 2 * np.abs(thin - clean).mean()


@pytest.mark.parametrize("name", ["sparse", "tracks", *PLAIN])
def test_hard_variants_have_the_geometry_of_the_street(name):
    from climatenerf.evaluation.reference import read_reference
    from climatenerf.scene import load_scene

    street, scene = load_scene(REFERENCE), load_scene(variant(name))
    assert (scene.ground_z, scene.lowest_ground_z) == (street.ground_z, street.lowest_ground_z)
    views = {view.name: view for view in street.views}
    for view in scene.views:
        np.testing.assert_array_equal(scene.c2w_world(view), street.c2w_world(views[view.name]))
        photos = variant("plain") if name in PLAIN else REFERENCE
        assert view.path.resolve() == photos / "images" / view.name
        assert view.label_path.resolve() == views[view.name].label_path.resolve()
    true, found = read_reference(REFERENCE), read_reference(variant(name))
    assert found.folder == REFERENCE
    for a, b in zip(true.truths, found.truths, strict=True):
        for key in ("depth", "normal", "label", *(() if name in PLAIN else ("clean",))):
            np.testing.assert_array_equal(getattr(a, key), getattr(b, key))


def test_the_sparse_variant_has_wide_baselines_and_the_points_of_its_photos():
    from climatenerf.scene import load_scene

    street, sparse = load_scene(REFERENCE), load_scene(variant("sparse"))
    centres = np.stack([view.c2w[:3, 3] for view in sparse.of_split("train")])
    apart = np.linalg.norm(centres[:, None] - centres, axis=-1)[~np.eye(20, dtype=bool)]
    assert apart.reshape(20, 19).min(1).min() > 1.4 and apart.reshape(20, 19).min(1).mean() > 2.5
    views = {view.name: view for view in street.views}
    seen = 0
    for view in sparse.views:
        true = street.points[views[view.name].seen]
        np.testing.assert_array_equal(sparse.points[view.seen], true)
        seen += len(view.seen)
    assert seen == len(sparse.points) > 800


def test_tracks_lie_near_the_ground_with_the_errors_of_matches():
    """On the road the heights of exact points are exact, and those of tracks are not."""
    from climatenerf.scene import load_scene

    exact, tracks = (load_scene(variant(name)).points for name in ("", "tracks"))
    spread = []
    for points in (exact, tracks):
        road = points[(np.abs(points[:, 0]) < 2.6) & (np.abs(points[:, 1]) < 15)]
        above = road[:, 2] - ground_height(road[:, 0], road[:, 1])
        spread.append(np.median(np.abs(above[np.abs(above) < 0.5])))
    assert spread[0] < 0.002 and 0.01 < spread[1] < 0.06
    under = ground_height(tracks[:, 0], tracks[:, 1]) - tracks[:, 2]
    assert 0.02 < (under > 0.1).mean() < 0.08, "some matches are wrong"
    scene = load_scene(variant("tracks"))
    observed = np.bincount(
        np.concatenate([v.seen for v in scene.of_split("train")]), minlength=len(tracks)
    )
    assert observed.min() >= 2 and observed.mean() > 4
    assert all(len(view.seen) == 0 for view in scene.of_split("heldout"))


def local_contrast(grey, mask, size=15):
    """Return the median over windows of the standard deviation about a plane, over the mean.

    Means of three by three pixels are compared: they suppress the noise of the path tracer.
    """
    y, x = np.mgrid[:size, :size]
    plane = np.stack([np.ones(size**2), x.ravel(), y.ravel()], -1)
    rest = np.eye(size**2) - plane @ np.linalg.pinv(plane)
    smooth, found = ndimage.uniform_filter(grey, 3), []
    for row in range(0, mask.shape[0] - size, 4):
        for column in range(0, mask.shape[1] - size, 4):
            window = slice(row, row + size), slice(column, column + size)
            if mask[window].all():
                found.append(np.std(rest @ smooth[window].ravel()) / smooth[window].mean())
    return np.median(found)


def asphalt(truth):
    """Return the pixels of the road without its gutters, nearer than 15 m."""
    on_road = (truth.label == TRAIN_IDS["road"]) & (np.abs(truth.points[..., 0]) < 2.6)
    return on_road & (truth.depth < 15)


def test_plain_ground_has_no_texture():
    from climatenerf.evaluation.reference import read_reference

    sets = [read_reference(variant(name)).truths for name in ("", "plain")]
    for street, plain in zip(*sets, strict=True):
        grass = (street.label == TRAIN_IDS["terrain"]) & (street.depth < 15)
        grass &= np.abs(street.points[..., 0]) > 5.2
        masks = [(asphalt(street), 8)]
        if street.name in ("t02.jpg", "t04.jpg", "t05.jpg"):  # open lawn without shadows
            masks.append((grass, 6))
        for mask, factor in masks:
            detail, faint = (local_contrast(t.clean.mean(-1), mask) for t in (street, plain))
            assert faint < detail / factor, street.name


def test_plain_photos_are_dark_and_noisy():
    from climatenerf.evaluation.reference import read_reference
    from climatenerf.scene.images import read_rgb

    photos = variant("plain") / "images"
    assert len(list(photos.iterdir())) == 70
    levels = {p.name: np.median(read_rgb(p)) for p in photos.iterdir()}
    assert min(levels.values()) > 35 and max(levels.values()) < 110
    assert 50 < np.median(list(levels.values())) < 75, "the street has 110"
    for truth in read_reference(variant("plain")).truths:
        clean = render.encode(truth.clean).astype(float)
        error = read_rgb(photos / truth.name) - clean
        spread = error[asphalt(truth)].std(0)
        assert (spread > 3.5).all() and (spread < 5.5).all(), truth.name
        assert abs(error[asphalt(truth)].mean()) < 2.5, "the photo shows the same exposure"


def test_phone_noise_follows_its_model():
    """A grey card: the variance of the raw signal is that of shot and read noise."""
    linear = np.full((200, 200, 3), 0.2)
    picture = phone.photo(linear, np.random.default_rng(0)).astype(float)
    again = phone.photo(linear, np.random.default_rng(0)).astype(float)
    np.testing.assert_array_equal(picture, again)
    grey = picture @ [0.299, 0.587, 0.114]
    # Noise of brightness before the blur, by the derivative of the display curve.
    electrons = phone.WHITE * 0.2 / phone.BALANCE
    relative = np.sqrt(electrons + phone.READ_NOISE**2) / electrons
    slope = 255 * 1.055 / 2.4 * 0.2 ** (1 / 2.4)  # per relative change
    sharp = slope * np.sqrt(((np.array([0.299, 0.587, 0.114]) * relative) ** 2).sum())
    kernel = np.zeros((15, 15))
    kernel[7, 7] = 1
    kept = np.sqrt((ndimage.gaussian_filter(kernel, phone.LUMA_BLUR) ** 2).sum())
    assert grey.std() == pytest.approx(kept * sharp, rel=0.05)
    assert grey.mean() == pytest.approx(float(render.encode(np.array(0.2))), abs=1.5)


def test_gravity_alignment_and_scale_of_the_rotated_variant():
    from climatenerf.scene import read_scene
    from climatenerf.scene.alignment.known_length import apply_known_lengths, measure

    scene = read_scene(variant("turned"))
    turn = np.eye(4)
    turn[:3, :3] = publish.SHRUNK * publish._rotation(*publish.TURN)
    turn[:3, 3] = publish.SHIFT
    up = (scene.world_from_input @ turn)[:3, 2]
    assert np.degrees(np.arccos(up[2] / np.linalg.norm(up))) < 0.5
    # Mark the ends of a wall of known length in all pictures that show both.
    ends = {"from": np.array([-10.5, -6.5, 1.0, 1.0]), "to": np.array([-10.5, 1.5, 1.0, 1.0])}
    marks = {"from": {}, "to": {}}
    rng = np.random.default_rng(0)
    for view in scene.of_split("train"):
        camera = scene.cameras[view.camera]
        local = {k: np.linalg.inv(view.c2w) @ (turn @ p) for k, p in ends.items()}
        if min(p[2] for p in local.values()) < 0.5:
            continue
        pixels = {k: camera.project(p[:3]) for k, p in local.items()}
        if all(
            (q > 0).all() and (q < (camera.width, camera.height)).all() for q in pixels.values()
        ):
            for end, pixel in pixels.items():
                marks[end][view.name] = tuple(pixel + rng.normal(0, 0.5, 2))
    assert len(marks["from"]) >= 3
    measured = measure(scene, {"WALL": marks}, "WALL", 8.0)
    scaled = apply_known_lengths(scene, [measured])
    assert np.cbrt(np.linalg.det((scaled.world_from_input @ turn)[:3, :3])) == pytest.approx(
        1.0, abs=0.01
    )
    # Camera heights above the ground datum equal the true heights.
    heights = {Path(v.name).name: scaled.c2w_world(v)[2, 3] - scaled.ground_z for v in scaled.views}
    true = {name: pose[2, 3] - ground_datum()[0] for name, pose in camera_poses()}
    assert len(true) == 64
    assert max(abs(heights[name] - true[name]) for name in true) < 0.05


# The tests below need the path tracer.


@pytest.mark.slow
def test_the_plain_street_is_traced_in_the_light_of_dusk(tmp_path):
    pytest.importorskip("mitsuba")
    from climatenerf.evaluation.reference import read_reference

    traced = render.load(build_scene(plain=True), tmp_path, sky=sky.dusk())
    truth = read_reference(variant("plain"), ("t06",)).truths[0]
    linear = render.render_view(traced, truth.c2w, 96, 54, 25, 0)[..., :3]
    fresh = render.encode(variants.PLAIN_EXPOSURE * linear) / 255.0
    small = truth.clean.reshape(54, 4, 96, 4, 3).mean((1, 3))
    assert -10 * np.log10(np.mean((fresh - render.encode(small) / 255.0) ** 2)) > 30


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "median", "wrong"), [("tracks", 0.009, 0.155), ("hard", 0.018, 0.257)]
)
def test_tracks_have_their_documented_errors(name, median, wrong, tmp_path):
    """The distance of each point, over that of the true surface behind or before it."""
    mi = pytest.importorskip("mitsuba")
    from climatenerf.scene import load_scene

    traced, scene = render.load(build_scene(), tmp_path), load_scene(variant(name))
    errors: list[list[float]] = [[] for _ in scene.points]
    for view in scene.of_split("train"):
        eye = view.c2w[:3, 3]
        for index in view.seen:
            ray = scene.points[index] - eye
            length = np.linalg.norm(ray)
            hit = traced.ray_intersect(mi.Ray3f(mi.Point3f(*eye), mi.Vector3f(*ray / length)))
            true = float(hit.t) if hit.is_valid() else np.inf
            errors[index].append(abs(true - length) / length)
    error = np.array([np.median(each) for each in errors])
    assert np.median(error) == pytest.approx(median, abs=0.002)
    assert (error > 0.1).mean() == pytest.approx(wrong, abs=0.01)


@pytest.mark.slow
def test_layers_agree_with_the_ground_function_and_each_other(tmp_path):
    pytest.importorskip("mitsuba")
    from tools.reference_street.render import load

    meshes = build_scene()
    scene = load(meshes, tmp_path, named=True)
    name, pose = heldout_poses()[5]
    truth = layers(scene, meshes, pose, 96, 54)
    focal = 48 / np.tan(np.deg2rad(34.0))
    x, y = np.meshgrid(np.arange(96) + 0.5, np.arange(54) + 0.5)
    local = np.stack([(x - 48) / focal, (y - 27) / focal, np.ones_like(x)], -1)
    rays = (local / np.linalg.norm(local, axis=-1, keepdims=True)) @ pose[:3, :3].T
    road = truth["label"] == TRAIN_IDS["road"]
    assert road.mean() > 0.2
    points = pose[:3, 3] + truth["depth"][road, None] * rays[road]
    assert np.abs(points[:, 2] - ground_height(points[:, 0], points[:, 1])).max() < 0.03
    # Normals agree with the planes through neighbouring points.
    whole = pose[:3, 3] + np.where(road, truth["depth"], 0)[..., None] * rays
    across, down = whole[1:-1, 2:] - whole[1:-1, :-2], whole[2:, 1:-1] - whole[:-2, 1:-1]
    plane = np.cross(down, across)
    plane /= np.maximum(np.linalg.norm(plane, axis=-1, keepdims=True), 1e-9)
    flat = road[1:-1, 1:-1] & road[1:-1, 2:] & road[1:-1, :-2] & road[2:, 1:-1] & road[:-2, 1:-1]
    cosine = np.abs((plane * truth["normal"][1:-1, 1:-1]).sum(-1))[flat]
    assert np.median(np.degrees(np.arccos(np.clip(cosine, 0, 1)))) < 1.0
    sky = truth["label"] == TRAIN_IDS["sky"]
    assert (np.isinf(truth["depth"]) == sky).all() and (truth["normal"][sky] == 0).all()
    assert ((truth["sun"] >= 0) & (truth["sun"] <= 1)).all() and truth["sun"][road].mean() > 0.3


def fresnel(cosine, n=1.333):
    """Return the unpolarised reflectance of a smooth dielectric, and the refracted cosine."""
    inside = np.sqrt(1 - (1 - cosine**2) / n**2)
    s = ((cosine - n * inside) / (cosine + n * inside)) ** 2
    p = ((inside - n * cosine) / (inside + n * cosine)) ** 2
    return 0.5 * (s + p), inside


@pytest.mark.parametrize("degrees", [10.0, 45.0, 75.0])
def test_traced_water_follows_fresnel_and_beer_lambert(degrees):
    """A black bottom shows the reflected sky alone; an emissive one the transmitted radiance."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    depth, height = 0.8, 1.0
    theta = np.deg2rad(degrees)
    flat = mi.ScalarTransform4f()
    target = [height * np.tan(theta), 0, 0]
    sensor = {
        "type": "perspective", "fov": 0.2, "near_clip": 0.01,
        "to_world": flat.look_at(origin=[0, 0, height], target=target, up=[0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}},
        "sampler": {"type": "independent", "sample_count": 4096},
    }  # fmt: skip
    bottom_place = flat.translate([0, 0, -depth]).scale([250, 250, 1])
    reflected, inside = fresnel(np.cos(theta))

    def radiance(bottom, sky):
        scene = {
            "type": "scene", "integrator": {"type": "volpath", "max_depth": 12, "rr_depth": 8},
            "sensor": sensor, "water": water.still(0.0),
            "bottom": {"type": "rectangle", "to_world": bottom_place, **bottom},
        }  # fmt: skip
        if sky:
            scene["sky"] = {"type": "constant", "radiance": 1.0}
        return float(np.array(mi.render(mi.load_dict(scene), seed=1))[..., :3].mean())

    black = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
    assert radiance({"bsdf": black}, sky=True) == pytest.approx(reflected, abs=0.003)
    emissive = {"bsdf": black, "emitter": {"type": "area", "radiance": 1.0}}
    transmitted = (1 - reflected) * np.exp(-water.ABSORPTION * depth / inside) / water.IOR**2
    assert radiance(emissive, sky=False) == pytest.approx(transmitted, abs=0.004)


def test_smog_transmittance_equals_the_closed_forms():
    depth, rise = np.array([[10.0, 200.0, np.inf]]), np.array([[0.0, 0.1, 0.5]])
    homogeneous = smog.transmittance("smog-mid", depth, 1.7, rise, 0.1)
    np.testing.assert_allclose(homogeneous, 0.05 ** (depth / 120.0))
    hazy = smog.transmittance("haze", depth, 1.7, rise, 0.1)
    sigma, falloff = -np.log(0.05) / 60.0, 5.0
    level = np.exp(-sigma * 10.0 * np.exp(-1.6 / falloff))
    up = np.exp(-sigma * np.exp(-1.6 / falloff) * falloff / 0.5)
    assert hazy[0, 0] == pytest.approx(level, rel=1e-4)
    assert hazy[0, 2] == pytest.approx(up, rel=2e-3)
    # Down from 1.7 m to the base at 0.1 m, then through the homogeneous part below.
    low = smog.transmittance("haze", np.array([[20.0]]), 1.7, np.array([[-0.2]]), 0.1)
    above = falloff * (1 - np.exp(-1.6 / falloff)) / 0.2
    assert low[0, 0] == pytest.approx(np.exp(-sigma * (above + 12.0)), rel=1e-3)
    white, passed = smog.smoggy(np.zeros((1, 1, 16)), "smog-mid", 1.0)
    assert passed.max() == 0
    assert np.abs(render.encode(white)[0, 0] / 255 - smog.COLOUR).max() < 0.003


@pytest.mark.slow
def test_smog_transmittance_agrees_with_a_path_traced_absorbing_medium(tmp_path):
    """The surfaces emit their own colours, in a medium that absorbs without scattering."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    sigma, samples, width, height = -np.log(0.05) / 40.0, 400, 96, 54
    air = mi.load_dict({"type": "homogeneous", "sigma_t": sigma, "albedo": 0.0})
    black = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
    content = {"type": "scene", "integrator": {"type": "volpath", "max_depth": 2}}
    meshes = build_scene()
    textures = {}
    for mesh in meshes:
        if mesh.texture not in textures:
            bitmap = mi.Bitmap(make(mesh.texture))
            textures[mesh.texture] = mi.load_dict({"type": "bitmap", "bitmap": bitmap})
        path = tmp_path / f"{mesh.name}.ply"
        render.write_ply(mesh, path)
        content[mesh.name.replace(".", "_")] = {
            "type": "ply", "filename": str(path), "bsdf": {"type": "twosided", "own": black},
            "emitter": {"type": "area", "radiance": textures[mesh.texture]},
        }  # fmt: skip
    clear = mi.load_dict(content)
    extent = mi.ScalarTransform4f().scale([500, 500, 300])
    box = {"type": "cube", "to_world": extent, "bsdf": {"type": "null"}, "interior": air}
    smoky = mi.load_dict(content | {"air": box})
    pose = heldout_poses()[0][1]
    dry = render.render_view(clear, pose, width, height, samples, 0)[..., :3]
    seen = render.render_view(smoky, pose, width, height, samples, 1, air=air)[..., :3]
    fine = layers(render.load(meshes, tmp_path, named=True), meshes, pose, width, height)
    passed = smog.transmittance("smog-near", fine["depth"], 0.0, np.zeros((height, width)), 0.0)
    # The depth of the central ray is valid for a whole pixel only where depth varies slowly.
    depth = np.pad(fine["depth"], 1, mode="edge")
    around = np.stack([depth[i : i + height, j : j + width] for i in range(3) for j in range(3)])
    flat = np.isfinite(around).all(0) & (around.max(0) < 1.2 * around.min(0)) & (dry.sum(-1) > 0.05)
    assert flat.mean() > 0.25
    expected = (dry * passed[..., None])[flat]
    noise = dry[flat] * np.sqrt(passed * (1 - passed) / samples)[flat][:, None]
    error = seen[flat] - expected
    assert abs(error.mean()) < 0.01 * expected.mean()
    assert np.sqrt((error**2).mean()) < 2.0 * np.sqrt((noise**2).mean())


def test_the_mirror_equals_the_view_of_a_mirrored_camera(tmp_path):
    """A ball under a sky that is dark below the horizon, by Mitsuba's camera below the plane."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    sky = np.zeros((32, 64, 3), np.float32)
    sky[:16] = [0.4, 0.6, 0.9]
    red = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.2, 0.1]}}
    turn = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    scene = mi.load_dict({
        "type": "scene", "integrator": {"type": "path", "max_depth": 3},
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(sky), "to_world": turn},
        "ball": {"type": "sphere", "center": [0.6, 4.0, 0.9], "radius": 0.5, "bsdf": red},
    })  # fmt: skip
    pose, level = look(np.array([0.0, 0.0, 1.6]), 3.0, -30.0), 0.2
    seen = mirrored_view(scene, pose, level, (64, 36), 64, 0)
    flip = np.diag([1.0, 1.0, -1.0, 1.0])
    flip[2, 3] = 2 * level
    expected = render.render_view(scene, flip @ pose, 64, 36, 256, 1)[..., :3]
    dry = render.render_view(scene, pose, 64, 36, 256, 1)[..., :3]
    rays = pixel_rays(pose, 64, 36)
    t = (level - pose[2, 3]) / np.minimum(rays[..., 2], -1e-9)
    assert (rays[..., 2] < 0).all()
    ball = dry[..., 0] > 1.2 * dry[..., 2]  # visible directly, in front of the mirror
    assert 0.02 < ball.mean() < 0.5 and np.isfinite(t).all()
    mirror = ~ndimage.binary_dilation(ball)
    assert_images_match(seen, expected, tmp_path, mask=mirror, block=4, max_block=0.04)
    reflected_ball = (expected[..., 0] > 1.2 * expected[..., 2]) & mirror
    assert reflected_ball.mean() > 0.02, "the picture shows the reflected ball"
    assert np.abs(seen - expected).max(-1)[reflected_ball].mean() < 0.05
