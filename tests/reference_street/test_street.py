"""The embedded street: geometry, poses, and the pictures that the package contains."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
ASSETS = ROOT / "src" / "climatenerf" / "assets" / "street"
sys.path.insert(0, str(ROOT))

from climatenerf.scene import load_image, read_scene  # noqa: E402
from climatenerf.scene.images import load_labels  # noqa: E402
from tools.reference_street.geometry import LABELS  # noqa: E402
from tools.reference_street.layout import (  # noqa: E402
    EYE,
    FIELD_OF_VIEW,
    build_scene,
    camera_poses,
    ground_datum,
)
from tools.reference_street.objects import CAR_AT  # noqa: E402
from tools.reference_street.sky import SUN_AZIMUTH, SUN_ELEVATION, SUN_WIDTH, direction, environment  # noqa: E402
from tools.reference_street.terrain import ground_height, road_profile  # noqa: E402
from tools.reference_street.textures import NAMES, make  # noqa: E402


@pytest.fixture(scope="module")
def meshes():
    return build_scene()


@pytest.fixture(scope="module")
def scene():
    return read_scene(ASSETS)


def test_the_geometry_builds_without_mitsuba():
    code = (
        "import sys; sys.modules['mitsuba'] = None\n"
        "from tools.reference_street import layout, render, sky, textures\n"
        "print(float(layout.ground_height(0.0, 0.0)))"
    )
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert float(run.stdout) == pytest.approx(0.055)  # the crown of the road


def test_ground_is_continuous_and_has_a_kerb():
    step = 0.001
    for y in (-37.0, -4.3, 12.0):
        x = np.arange(-40, 40, step)
        # The steepest part is the kerb face, which rises 12 cm over 2 cm.
        assert np.abs(np.diff(ground_height(x, np.full_like(x, y)))).max() < 6.5 * step
    for x in (-20.0, 0.0, 3.07, 150.0):
        y = np.arange(-250, 250, 0.01)
        assert np.abs(np.diff(ground_height(np.full_like(y, x), y))).max() < 0.6 * 0.01
    kerb = ground_height(3.0, 5.0) - ground_height(2.98, 5.0)
    assert kerb == pytest.approx(0.12, abs=1e-9)
    walk = np.linspace(-11, 9, 100)
    assert 0.02 < (road_profile(9.0) - road_profile(-11.0)) / 20 < 0.03
    assert (np.diff(road_profile(walk)) > 0).all()


def test_a_flood_of_half_a_metre_has_visible_shorelines():
    level = ground_datum()[0] + 0.5
    positions = np.array([pose[:3, 3] for _, pose in camera_poses()])
    assert positions[:, 2].min() > level + 0.3  # no camera is under water
    assert ground_height(0.0, 0.0) < level - 0.3
    assert ground_height(0.0, 20.0) > level  # the road leaves the water ahead
    assert ground_height(14.0, 0.0) > level  # so do the lawns
    assert ground_height(-16.0, 0.0) > level


def test_meshes_are_valid(meshes):
    assert len({m.name for m in meshes}) == len(meshes)
    labels = {m.label for m in meshes}
    assert {"road", "building", "vegetation", "terrain", "vehicle", "object"} == labels
    assert labels <= set(LABELS)
    for mesh in meshes:
        assert mesh.texture in NAMES, mesh.name
        assert np.isfinite(mesh.vertices).all() and np.isfinite(mesh.uv).all(), mesh.name
        assert mesh.vertices.shape[0] == mesh.uv.shape[0]
        assert mesh.faces.min() >= 0 and mesh.faces.max() < len(mesh.vertices), mesh.name


def test_ground_meshes_follow_the_height_function(meshes):
    ground = ("road", "gutter", "kerb", "pavement", "lawn+1", "lawn-1", "meadow")
    by_name = {m.name: m for m in meshes}
    for name in ground:
        mesh = by_name[name]
        v = mesh.vertices
        np.testing.assert_allclose(v[:, 2], ground_height(v[:, 0], v[:, 1]), atol=1e-9)
        centre = v[mesh.faces].mean(1)
        near = np.hypot(centre[:, 0], centre[:, 1]) < 24  # the detailed part
        gap = np.abs(centre[:, 2] - ground_height(centre[:, 0], centre[:, 1]))[near]
        assert gap.size == 0 or gap.max() < 0.015, name  # between the vertices


def test_objects_stand_on_the_ground(meshes):
    by_name = {m.name: m for m in meshes}
    wheels = by_name["car-wheels"].vertices
    gap = wheels[:, 2] - ground_height(wheels[:, 0], wheels[:, 1])
    assert abs(gap.min()) < 0.03
    for name in ("bench-feet", "lamp-post", "tree-wood", "hedge-a-core", "house-a-stone"):
        v = by_name[name].vertices
        assert (v[:, 2] - ground_height(v[:, 0], v[:, 1])).min() < 0.0, name


def test_camera_poses_are_valid_and_clear_of_objects(meshes):
    poses = camera_poses()
    names = [name for name, _ in poses]
    assert len(names) == 64 and names == sorted(set(names))
    stack = np.stack([pose for _, pose in poses])
    turn = stack[:, :3, :3]
    np.testing.assert_allclose(
        turn @ turn.transpose(0, 2, 1), np.eye(3)[None].repeat(64, 0), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(turn), 1.0)
    assert (turn[:, 2, 1] < -0.9).all()  # image down is world down
    x, y, z = stack[:, :3, 3].T
    height = z - ground_height(x, y)
    np.testing.assert_allclose(height[:50], EYE, atol=1e-9)
    assert (height[50:] > 2.9).all() and (height[50:] < 4.1).all()
    solid = np.concatenate([m.vertices for m in meshes if m.label not in ("road", "terrain")])
    near = solid[np.abs(solid[:, :2]).max(1) < 16]
    for pose in stack:
        assert np.linalg.norm(near - pose[:3, 3], axis=-1).min() > 0.35


def test_the_sun_has_its_documented_direction_and_width():
    sky = environment(128)
    assert np.isfinite(sky).all() and (sky > 0).all()
    row, column = np.argwhere(sky.sum(-1) > 0.9 * sky.sum(-1).max()).mean(0)
    assert 90 - (row + 0.5) / 128 * 180 == pytest.approx(SUN_ELEVATION, abs=1.5)
    assert (column + 0.5) / 256 * 360 == pytest.approx(SUN_AZIMUTH, abs=1.5)
    assert SUN_WIDTH >= 15
    assert np.linalg.norm(direction(SUN_AZIMUTH, SUN_ELEVATION)) == pytest.approx(1.0)


def test_textures_are_reproducible():
    for name in ("asphalt", "brick", "car-body"):
        picture = make(name)
        assert picture.dtype == np.uint8 and picture.shape[2] == 3
        np.testing.assert_array_equal(picture, make(name))
        assert picture.std() > 8  # visible detail


def test_the_embedded_scene_is_readable(scene):
    assert len(scene.views) == 64
    assert [v.name for v in scene.of_split("heldout")] == [v.name for v in scene.views[::8]]
    np.testing.assert_array_equal(scene.world_from_input, np.eye(4))
    assert scene.scale_source == "metric-input" and scene.scale_error == 0.0
    ground, lowest = ground_datum()
    assert scene.ground_z == pytest.approx(ground) and scene.lowest_ground_z == pytest.approx(
        lowest
    )
    camera = scene.cameras[0]
    assert camera.width >= 320 and camera.height >= 180
    assert 2 * np.rad2deg(np.arctan(0.5 * camera.width / camera.fx)) == pytest.approx(FIELD_OF_VIEW)
    for view, (name, pose) in zip(scene.views, camera_poses(), strict=True):
        assert view.name == name
        np.testing.assert_allclose(scene.c2w_world(view), pose, atol=1e-9)
        with Image.open(view.path) as image:
            assert image.size == (camera.width, camera.height)


def test_the_embedded_scene_is_small_and_without_local_paths():
    files = [f for f in ASSETS.rglob("*") if f.is_file()]
    assert sum(f.stat().st_size for f in files) <= 4_000_000
    assert {f.suffix for f in files} <= {".jpg", ".json", ".npz", ".ply", ".png"}
    text = (ASSETS / "scene.json").read_text(encoding="utf-8")
    assert str(ROOT) not in text and '"/' not in text


def test_labels_name_the_class_of_every_pixel(scene):
    fractions = []
    for view in scene.views:
        label = load_labels(view, scene, 1)
        camera = scene.cameras[view.camera]
        assert label is not None and label.shape == (camera.height, camera.width), view.name
        assert set(np.unique(label)) <= {0, 2, 4, 8, 9, 10, 13}, view.name
        sky = label == 10
        fractions.append(sky.mean())
        down = (camera.directions() @ scene.c2w_world(view)[:3, :3].T)[..., 2] < 0
        assert not (sky & down).any(), view.name  # hills hide the horizon
        photo = load_image(view, scene).astype(float)
        if sky.sum() > 200:
            assert photo[sky][:, 2].mean() > 180, view.name
    assert 0.05 < np.mean(fractions) < 0.5


def test_sparse_points_lie_on_surfaces(scene):
    points = scene.points_world()
    assert points is not None and len(points) > 1500
    below = ground_height(points[:, 0], points[:, 1]) - points[:, 2]
    assert below.max() < 0.1
    assert (np.abs(below) < 0.02).mean() > 0.3  # photos of a street show much ground


def test_pictures_agree_with_the_poses(scene):
    """The red car roof and the bright sky project to where the pictures show them."""
    roof = np.array([CAR_AT[0], CAR_AT[1] - 0.7, ground_height(*CAR_AT) + 1.43])
    checked = 0
    for view in scene.views[50:]:
        camera, pose = scene.cameras[view.camera], scene.c2w_world(view)
        local = pose[:3, :3].T @ (roof - pose[:3, 3])
        if local[2] < 1.0:
            continue
        column, row = np.floor(camera.project(local)).astype(int)
        if 0 <= column < camera.width and 0 <= row < camera.height:
            r, g, b = load_image(view, scene)[row, column].astype(float)
            assert r > 1.8 * g and r > 1.8 * b, view.name
            checked += 1
    assert checked >= 6
    for view in scene.views:
        picture = load_image(view, scene).astype(float)
        assert 45 < np.median(picture) < 190, view.name  # well exposed
        # The brightest part of the sky is clipped in the views towards it, as in photos.
        assert (picture >= 255).all(-1).mean() < 0.25, view.name
        if view.name in ("0016.jpg", "0017.jpg", "0022.jpg", "0038.jpg"):  # open sky above
            top, bottom = picture[:12].mean((0, 1)), picture[-12:].mean((0, 1))
            assert top.min() > 150 and top.mean() > bottom.mean() + 30, view.name


@pytest.mark.slow
def test_a_new_render_matches_the_stored_picture(scene, tmp_path):
    pytest.importorskip("mitsuba")
    from tools.reference_street.render import EXPOSURE, encode, load, render_view

    traced = load(build_scene(), tmp_path)
    view = scene.views[5]
    radiance = render_view(traced, scene.c2w_world(view), 96, 54, 25, 0)[..., :3]
    fresh = encode(EXPOSURE * radiance) / 255.0
    stored = load_image(view, scene, 4) / 255.0
    assert -10 * np.log10(np.mean((fresh - stored) ** 2)) > 24
