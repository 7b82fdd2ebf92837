"""Sky by its looks and ground by its points: made pictures, the reference street, captures."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.scene_builders import look_at, names_of, ring, write_colmap, write_images

from climatenerf.perception.heuristic import GROUND, SKY, find_sky, shows_sky, simple_labels
from climatenerf.perception.heuristic_ground import ground_points
from climatenerf.scene import Camera, Scene, View, read_scene
from climatenerf.scene.images import load_labels

STREET = Path(__file__).parents[2] / "reference" / "street"
HEIGHT, WIDTH = 120, 200


def upward(horizon=70, roll=0):
    """Sine above the horizon of the rays of an upright or rolled camera."""
    rows = np.broadcast_to((horizon - np.arange(HEIGHT))[:, None] / 150, (HEIGHT, WIDTH))
    return np.rot90(rows, roll).astype(np.float32)


def textured(seed=0, base=(90, 80, 50)):
    noise = np.random.default_rng(seed).integers(-40, 41, (HEIGHT, WIDTH, 1))
    return np.clip(np.asarray(base) + noise, 0, 255).astype(np.uint8)


def landscape(top=(110, 160, 235), low=(200, 215, 240), edge=50):
    """A gradient sky over textured ground, and where the sky is."""
    share = np.linspace(0, 1, edge)[:, None, None]
    picture = textured()
    picture[:edge] = np.rint(np.asarray(top) * (1 - share) + np.asarray(low) * share)
    sky = np.zeros((HEIGHT, WIDTH), bool)
    sky[:edge] = True
    return picture, sky


NO_POINTS = np.zeros((HEIGHT, WIDTH), bool)


@pytest.mark.parametrize(
    "colours", [((110, 160, 235), (200, 215, 240)), ((225, 228, 232), (245, 246, 248))]
)
def test_blue_and_overcast_skies_are_found_up_to_their_edge(colours):
    picture, sky = landscape(*colours)
    found = find_sky(picture, upward(), NO_POINTS)
    assert not (found & ~sky).any()
    assert found.sum() > 0.9 * sky.sum() and not found[47:50].any(), "the edge is doubtful"


def test_a_camera_on_its_side_sees_the_same_sky():
    picture, _ = landscape()
    upright = find_sky(picture, upward(), NO_POINTS)
    for roll in (1, 2, 3):
        turned = np.ascontiguousarray(np.rot90(picture, roll))
        found = find_sky(turned, upward(roll=roll), np.rot90(NO_POINTS, roll))
        np.testing.assert_array_equal(np.rot90(found, -roll), upright)


def test_wires_do_not_stop_the_sky_and_clouds_belong_to_it():
    picture, sky = landscape()
    picture[20:22] = 40
    picture[30:40, 60:90] = 250
    found = find_sky(picture, upward(), NO_POINTS)
    assert found[5:15].all() and found[27:29].all() and found[30:40, 60:90].all()
    assert not found[20:22].any() and not (found & ~sky).any()


def test_what_goes_on_below_the_horizon_is_no_sky():
    wall = np.full((HEIGHT, WIDTH, 3), 235, np.uint8)
    wall[100:] = textured()[100:]
    assert not find_sky(wall, upward(), NO_POINTS).any()


def test_a_room_has_no_sky():
    """Warm walls, a white wall no brighter than the window, and a ceiling in dim light."""
    for colour in ((240, 232, 215), (150, 152, 155)):
        picture = textured()
        picture[:50] = colour
        assert not find_sky(picture, upward(), NO_POINTS).any()
    picture = textured()
    picture[:50] = (215, 216, 218)
    picture[55:75, 50:190] = 255
    assert not find_sky(picture, upward(), NO_POINTS).any()


def test_points_of_matter_are_no_sky():
    picture, _ = landscape()
    some = NO_POINTS.copy()
    some[10:20, 30:40] = True
    found = find_sky(picture, upward(), some)
    assert found.any() and not found[some].any()
    some[:40] = True
    assert not find_sky(picture, upward(), some).any()


def test_a_capture_without_sky_is_not_outdoors(tmp_path):
    names = names_of(9)
    write_images(tmp_path / "images", names)  # plain and dark
    write_colmap(tmp_path / "sparse" / "0", ring(9), names)
    scene = read_scene(tmp_path)
    assert not shows_sky(scene)
    assert (simple_labels(scene.views[0], scene, ground_points(scene)) == 255).all()


@pytest.mark.skipif(not STREET.is_dir(), reason="the reference street is not in this checkout")
def test_sky_of_the_street_is_sky():
    scene = read_scene(STREET, holdout="0")
    assert shows_sky(scene)
    right = wrong = missed = 0
    for view in scene.views[::7]:
        labels = simple_labels(view, scene, None)
        assert set(np.unique(labels)) <= {SKY, 255}
        truth = load_labels(view, scene) == SKY
        found = labels == SKY
        right += (found & truth).sum()
        wrong += (found & ~truth).sum()
        missed += (truth & ~found).sum()
    assert right / (right + wrong) > 0.999
    assert right / (right + missed) > 0.7


BOX = np.array([[-0.6, -0.6, 0.0], [0.6, 0.6, 1.1]])
CAMERA = Camera(160, 120, 130.0, 130.0, 80.0, 60.0)


def first_hits(rays, origin, slope):
    """Distance along rays to the box and to the ground z = slope x, infinite where missed."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = (BOX - origin) / rays[..., None, :]
        enter, leave = ends.min(axis=-2).max(axis=-1), ends.max(axis=-2).min(axis=-1)
        box = np.where((enter < leave) & (enter > 0), enter, np.inf)
        ground = (slope * origin[0] - origin[2]) / (rays[..., 2] - slope * rays[..., 0])
    return box, np.where(ground > 0, ground, np.inf)


@pytest.fixture(params=[0.0, 0.15], ids=["level", "slope"])
def yard(tmp_path, request):
    """A box on the ground amid nine cameras, points on both, and what each pixel shows.

    The box looks like the ground: what tells them apart are the points alone.
    """
    slope, random = request.param, np.random.default_rng(0)
    ground = random.uniform(-7, 7, (2500, 3))
    ground[:, 2] = slope * ground[:, 0]
    ground = ground[(np.abs(ground[:, :2]) > 0.6).any(axis=-1)]
    box = random.uniform(*BOX, (500, 3))
    side = random.integers(0, 5, 500)  # four walls and the top
    for axis, end in ((0, 0), (0, 1), (1, 0), (1, 1), (2, 1)):
        rows = side == 2 * axis + end - (axis == 2)
        box[rows, axis] = BOX[end, axis]
    box = box[box[:, 2] > slope * box[:, 0]]
    points = np.concatenate([ground, box])
    views, truths = [], []
    for number, pose in enumerate(ring(9, radius=4.5)):
        pose = look_at(pose[:3, 3] + (0, 0, slope * pose[0, 3]), (0, 0, 0.5))
        near, far = first_hits(CAMERA.directions() @ pose[:3, :3].T, pose[:3, 3], slope)
        truths.append(np.where(np.isinf(near) & np.isinf(far), 2, near < far))
        way = points - pose[:3, 3]
        pixels = CAMERA.project(way @ pose[:3, :3])
        inside = ((pixels >= 0) & (pixels < (160, 120))).all(axis=-1)
        length = np.linalg.norm(way, axis=-1)
        hit = np.minimum(*first_hits(way / length[:, None], pose[:3, 3], slope))
        seen = np.flatnonzero(inside & (hit > length - 1e-6))
        path = tmp_path / f"{number}.png"
        noise = random.integers(85, 95, (120, 160, 3), dtype=np.uint8)
        Image.fromarray(noise).save(path)
        views.append(View(path.name, path, 0, pose, seen=seen))
    scene = Scene(tmp_path, "test", (CAMERA,), tuple(views), points)
    return scene, truths, np.arange(len(points)) < len(ground)


def test_ground_is_what_lies_between_its_points(yard):
    scene, truths, is_ground = yard
    known = ground_points(scene)
    assert known is not None
    assert known.on[~is_ground].mean() < 0.02 and known.on[is_ground].mean() > 0.8
    for view, truth in zip(scene.views, truths, strict=True):
        found = simple_labels(view, scene, known) == GROUND
        box, ground, sky = (truth == kind for kind in (1, 0, 2))
        assert not found[sky].any()
        assert found[box].mean() < 0.06 and found[box].sum() < 0.01 * found.sum()
        assert found[ground].mean() > 0.6


def test_ground_ends_where_a_photo_changes(yard):
    """Paint of another colour, without points of its own, is no longer surely ground."""
    scene, _, _ = yard
    known = ground_points(scene)
    view = scene.views[0]
    patch = np.zeros((120, 160), bool)
    patch[100:118, 10:60] = True
    pixels = CAMERA.project((scene.points[view.seen] - view.c2w[:3, 3]) @ view.c2w[:3, :3])
    column, row = pixels.astype(int).T
    view = replace(view, seen=view.seen[~patch[row, column]])
    picture = np.array(Image.open(view.path))
    before = simple_labels(view, scene, known) == GROUND
    picture[patch] = (200, 30, 30)
    Image.fromarray(picture).save(view.path)
    after = simple_labels(view, scene, known) == GROUND
    assert before[patch].mean() > 0.9 and after[patch].mean() < 0.1
    assert after[~patch].sum() > 0.9 * before[~patch].sum()


def test_no_ground_without_points_or_without_knowing_who_sees_them(yard):
    scene, _, _ = yard
    blind = tuple(replace(view, seen=None) for view in scene.views)
    assert ground_points(replace(scene, points=None)) is None
    assert ground_points(replace(scene, views=blind)) is None
    high = replace(scene, points=scene.points + (0, 0, 50))
    assert ground_points(high) is None
    known = ground_points(scene)
    for seen in (None, np.empty(0, np.int64), np.flatnonzero(~known.on)):
        labels = simple_labels(replace(scene.views[0], seen=seen), scene, known)
        assert not (labels == GROUND).any()


def test_a_raised_terrace_is_no_ground(yard):
    """It is level too, but no slope leads there from the ground below the cameras."""
    scene, _, is_ground = yard
    points = scene.points.copy()
    raised = is_ground & (np.abs(points[:, :2] - (2.5, 0)) < (1.2, 1.6)).all(axis=-1)
    assert raised.sum() > 50
    points[raised, 2] += 1.4
    known = ground_points(replace(scene, points=points))
    assert known is not None
    assert known.on[raised].mean() < 0.02 and known.on[is_ground & ~raised].mean() > 0.5


def test_a_roof_that_no_ground_leads_to_is_none(yard):
    scene, _, is_ground = yard
    roof = np.random.default_rng(1).uniform((11, -2, 1), (15, 2, 1.01), (400, 3))
    known = ground_points(replace(scene, points=np.concatenate([scene.points, roof])))
    assert known is not None
    assert not known.on[len(is_ground) :].any()
    assert known.on[: len(is_ground)][is_ground].mean() > 0.8


@pytest.mark.skipif(not STREET.is_dir(), reason="the reference street is not in this checkout")
def test_ground_of_the_street_is_ground():
    scene = read_scene(STREET, holdout="0")
    known = ground_points(scene)
    right = wrong = missed = 0
    for view in scene.views[::7]:
        truth = load_labels(view, scene)
        found = simple_labels(view, scene, known)[truth != 255] == GROUND
        truth = np.isin(truth[truth != 255], (0, 1, 9))
        right += (found & truth).sum()
        wrong += (found & ~truth).sum()
        missed += (truth & ~found).sum()
    assert right / (right + wrong) > 0.995
    assert right / (right + missed) > 0.3


@pytest.mark.slow
def test_ground_of_a_drive(captures):
    """The labels are a network's; dry verges and leaf litter are vegetation to it."""
    scene = read_scene(captures / "kitti_drive", holdout="0")
    known = ground_points(scene)
    found = [simple_labels(view, scene, known) == GROUND for view in scene.views[::12]]
    truth = [np.isin(load_labels(view, scene), (0, 1, 9)) for view in scene.views[::12]]
    right = np.sum([f & t for f, t in zip(found, truth, strict=True)])
    assert right > 0.94 * np.sum(found) and right > 0.4 * np.sum(truth)


@pytest.mark.slow
def test_sky_of_real_captures_and_none_in_a_room(captures):
    """The labels are a network's, and miss some sky between branches."""
    for name, precision, recall in (("ditch", 0.95, 0.65), ("stone_sign", 0.75, 0.65)):
        scene = read_scene(captures / name, holdout="0")
        assert shows_sky(scene), name
        found = [simple_labels(view, scene, None) == SKY for view in scene.views[::12]]
        truth = [load_labels(view, scene) == SKY for view in scene.views[::12]]
        right = np.sum([f & t for f, t in zip(found, truth, strict=True)])
        assert right > precision * np.sum(found) and right > recall * np.sum(truth), name
    assert not shows_sky(read_scene(captures / "fox", holdout="0"))
