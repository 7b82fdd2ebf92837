"""Heuristic labels on synthetic pictures, the reference street and real captures."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.scene_builders import look_at, names_of, ring, write_colmap, write_images

from climatenerf.perception.heuristic import (
    BUILDING,
    GROUND,
    SKY,
    VEGETATION,
    heuristic_labels,
    is_outdoors,
    segment_sky,
)
from climatenerf.perception.heuristic_ground import classify_ground_points
from climatenerf.perception.heuristic_standing import segment_vegetation, standing_points
from climatenerf.scene import Camera, Scene, View, read_scene
from climatenerf.scene.images import load_labels

STREET = Path(__file__).parents[2] / "reference" / "street"
HEIGHT, WIDTH = 120, 200


def upward(horizon=70, roll=0):
    """Sine of the elevation of each pixel's ray, for an upright camera or one rolled by 90°."""
    rows = np.broadcast_to((horizon - np.arange(HEIGHT))[:, None] / 150, (HEIGHT, WIDTH))
    return np.rot90(rows, roll).astype(np.float32)


def textured(seed=0, base=(90, 80, 50)):
    noise = np.random.default_rng(seed).integers(-40, 41, (HEIGHT, WIDTH, 1))
    return np.clip(np.asarray(base) + noise, 0, 255).astype(np.uint8)


def landscape(top=(110, 160, 235), low=(200, 215, 240), edge=50):
    """Picture of a gradient sky over textured ground, and the true sky mask."""
    fraction = np.linspace(0, 1, edge)[:, None, None]
    picture = textured()
    picture[:edge] = np.rint(np.asarray(top) * (1 - fraction) + np.asarray(low) * fraction)
    sky = np.zeros((HEIGHT, WIDTH), bool)
    sky[:edge] = True
    return picture, sky


NO_POINTS = np.zeros((HEIGHT, WIDTH), bool)


@pytest.mark.parametrize(
    "colours", [((110, 160, 235), (200, 215, 240)), ((225, 228, 232), (245, 246, 248))]
)
def test_blue_and_overcast_skies_are_segmented_up_to_a_margin(colours):
    picture, sky = landscape(*colours)
    found = segment_sky(picture, upward(), NO_POINTS)
    assert not (found & ~sky).any()
    assert found.sum() > 0.9 * sky.sum() and not found[47:50].any(), "the margin is unknown"


def test_segmentation_does_not_depend_on_camera_roll():
    picture, _ = landscape()
    upright = segment_sky(picture, upward(), NO_POINTS)
    for roll in (1, 2, 3):
        turned = np.ascontiguousarray(np.rot90(picture, roll))
        found = segment_sky(turned, upward(roll=roll), np.rot90(NO_POINTS, roll))
        np.testing.assert_array_equal(np.rot90(found, -roll), upright)


def test_sky_continues_across_wires_and_includes_clouds():
    picture, sky = landscape()
    picture[20:22] = 40
    picture[30:40, 60:90] = 250
    found = segment_sky(picture, upward(), NO_POINTS)
    assert found[5:15].all() and found[27:29].all() and found[30:40, 60:90].all()
    assert not found[20:22].any() and not (found & ~sky).any()


def test_regions_continuing_below_the_horizon_are_not_sky():
    wall = np.full((HEIGHT, WIDTH, 3), 235, np.uint8)
    wall[100:] = textured()[100:]
    assert not segment_sky(wall, upward(), NO_POINTS).any()


def test_rooms_have_no_sky():
    """A warm wall, a dim ceiling, and a white wall that is darker than the window."""
    for colour in ((240, 232, 215), (150, 152, 155)):
        picture = textured()
        picture[:50] = colour
        assert not segment_sky(picture, upward(), NO_POINTS).any()
    picture = textured()
    picture[:50] = (215, 216, 218)
    picture[55:75, 50:190] = 255
    assert not segment_sky(picture, upward(), NO_POINTS).any()


def test_pixels_near_sparse_points_are_not_sky():
    picture, _ = landscape()
    matter = NO_POINTS.copy()
    matter[10:20, 30:40] = True
    found = segment_sky(picture, upward(), matter)
    assert found.any() and not found[matter].any()
    matter[:40] = True
    assert not segment_sky(picture, upward(), matter).any(), "too much matter in the region"


def test_capture_without_sky_is_not_outdoors(tmp_path):
    names = names_of(9)
    write_images(tmp_path / "images", names)  # uniform and dark
    write_colmap(tmp_path / "sparse" / "0", ring(9), names)
    scene = read_scene(tmp_path)
    assert not is_outdoors(scene)
    assert (heuristic_labels(scene.views[0], scene, classify_ground_points(scene)) == 255).all()


@pytest.mark.skipif(not STREET.is_dir(), reason="the reference street is not in this checkout")
def test_sky_precision_and_recall_on_the_reference_street():
    scene = read_scene(STREET, holdout="0")
    assert is_outdoors(scene)
    correct = wrong = missed = 0
    for view in scene.views[::7]:
        labels = heuristic_labels(view, scene, None)
        assert set(np.unique(labels)) <= {SKY, 255}
        truth = load_labels(view, scene) == SKY
        found = labels == SKY
        correct += (found & truth).sum()
        wrong += (found & ~truth).sum()
        missed += (truth & ~found).sum()
    assert correct / (correct + wrong) > 0.999
    assert correct / (correct + missed) > 0.7


BOX = np.array([[-0.6, -0.6, 0.0], [0.6, 0.6, 1.1]])
CAMERA = Camera(160, 120, 130.0, 130.0, 80.0, 60.0)


def first_hits(rays, origin, slope):
    """Ray lengths to the box and to the ground z = slope x; infinite for a miss."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = (BOX - origin) / rays[..., None, :]
        enter, leave = ends.min(axis=-2).max(axis=-1), ends.max(axis=-2).min(axis=-1)
        box = np.where((enter < leave) & (enter > 0), enter, np.inf)
        ground = (slope * origin[0] - origin[2]) / (rays[..., 2] - slope * rays[..., 0])
    return box, np.where(ground > 0, ground, np.inf)


@pytest.fixture(params=[0.0, 0.15], ids=["level", "slope"])
def yard(tmp_path, request):
    """A box on the ground among nine cameras, points on both, and the true class of each pixel.

    Box and ground have the same colour, so only the points distinguish them.
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
        offset = points - pose[:3, 3]
        pixels = CAMERA.project(offset @ pose[:3, :3])
        inside = ((pixels >= 0) & (pixels < (160, 120))).all(axis=-1)
        length = np.linalg.norm(offset, axis=-1)
        hit = np.minimum(*first_hits(offset / length[:, None], pose[:3, 3], slope))
        seen = np.flatnonzero(inside & (hit > length - 1e-6))
        path = tmp_path / f"{number}.png"
        noise = random.integers(85, 95, (120, 160, 3), dtype=np.uint8)
        Image.fromarray(noise).save(path)
        views.append(View(path.name, path, 0, pose, seen=seen))
    scene = Scene(tmp_path, "test", (CAMERA,), tuple(views), points)
    return scene, truths, np.arange(len(points)) < len(ground)


def test_ground_label_fills_the_area_between_ground_points(yard):
    scene, truths, is_ground = yard
    ground = classify_ground_points(scene)
    assert ground is not None
    assert ground.is_ground[~is_ground].mean() < 0.02 and ground.is_ground[is_ground].mean() > 0.8
    for view, truth in zip(scene.views, truths, strict=True):
        found = heuristic_labels(view, scene, ground) == GROUND
        on_box, on_ground, on_sky = (truth == kind for kind in (1, 0, 2))
        assert not found[on_sky].any()
        assert found[on_box].mean() < 0.06 and found[on_box].sum() < 0.01 * found.sum()
        assert found[on_ground].mean() > 0.6


def test_ground_label_stops_at_colour_edges(yard):
    """A painted patch without sparse points of its own stays unknown."""
    scene, _, _ = yard
    ground = classify_ground_points(scene)
    view = scene.views[0]
    patch = np.zeros((120, 160), bool)
    patch[100:118, 10:60] = True
    pixels = CAMERA.project((scene.points[view.seen] - view.c2w[:3, 3]) @ view.c2w[:3, :3])
    column, row = pixels.astype(int).T
    view = replace(view, seen=view.seen[~patch[row, column]])
    picture = np.array(Image.open(view.path))
    before = heuristic_labels(view, scene, ground) == GROUND
    picture[patch] = (200, 30, 30)
    Image.fromarray(picture).save(view.path)
    after = heuristic_labels(view, scene, ground) == GROUND
    assert before[patch].mean() > 0.9 and after[patch].mean() < 0.1
    assert after[~patch].sum() > 0.9 * before[~patch].sum()


def test_ground_needs_points_and_their_observations(yard):
    scene, _, _ = yard
    unobserved = tuple(replace(view, seen=None) for view in scene.views)
    assert classify_ground_points(replace(scene, points=None)) is None
    assert classify_ground_points(replace(scene, views=unobserved)) is None
    high = replace(scene, points=scene.points + (0, 0, 50))
    assert classify_ground_points(high) is None
    ground = classify_ground_points(scene)
    for seen in (None, np.empty(0, np.int64), np.flatnonzero(~ground.is_ground)):
        labels = heuristic_labels(replace(scene.views[0], seen=seen), scene, ground)
        assert not (labels == GROUND).any()


def test_raised_terrace_is_not_ground(yard):
    """A terrace is level, but no walkable slope connects it to ground below a camera."""
    scene, _, is_ground = yard
    points = scene.points.copy()
    raised = is_ground & (np.abs(points[:, :2] - (2.5, 0)) < (1.2, 1.6)).all(axis=-1)
    assert raised.sum() > 50
    points[raised, 2] += 1.4
    ground = classify_ground_points(replace(scene, points=points))
    assert ground is not None
    assert (
        ground.is_ground[raised].mean() < 0.02
        and ground.is_ground[is_ground & ~raised].mean() > 0.5
    )


def test_unconnected_roof_is_not_ground(yard):
    scene, _, is_ground = yard
    roof = np.random.default_rng(1).uniform((11, -2, 1), (15, 2, 1.01), (400, 3))
    ground = classify_ground_points(replace(scene, points=np.concatenate([scene.points, roof])))
    assert ground is not None
    assert not ground.is_ground[len(is_ground) :].any()
    assert ground.is_ground[: len(is_ground)][is_ground].mean() > 0.8


@pytest.mark.skipif(not STREET.is_dir(), reason="the reference street is not in this checkout")
def test_ground_precision_and_recall_on_the_reference_street():
    scene = read_scene(STREET, holdout="0")
    ground = classify_ground_points(scene)
    correct = wrong = missed = 0
    for view in scene.views[::7]:
        truth = load_labels(view, scene)
        found = heuristic_labels(view, scene, ground)[truth != 255] == GROUND
        truth = np.isin(truth[truth != 255], (0, 1, 9))
        correct += (found & truth).sum()
        wrong += (found & ~truth).sum()
        missed += (truth & ~found).sum()
    assert correct / (correct + wrong) > 0.995
    assert correct / (correct + missed) > 0.3


@pytest.mark.parametrize(
    ("base", "noise", "expected"),
    [
        ((60, 80, 40), 30, True),  # a hedge
        ((18, 24, 12), 9, True),  # the same in shade
        ((60, 80, 40), 0, False),  # green paint
        ((20, 72, 68), 30, False),  # a teal door with reflections
        ((100, 85, 65), 30, False),  # leaf litter
        ((1, 3, 1), 1, False),  # the noise of black
    ],
)
def test_leaves_are_green_and_rough(base, noise, expected):
    bright = 1 + np.random.default_rng(0).uniform(-1, 1, (HEIGHT, WIDTH, 1)) * noise / base[1]
    values = (np.asarray(base) * bright / 255).astype(np.float32)
    found = segment_vegetation(values)
    assert found.mean() > 0.9 if expected else not found.any()


def test_moss_is_too_small_for_vegetation():
    values = textured(base=(100, 80, 60)).astype(np.float32) / 255
    values[40:44, 60:64] = values[40:44, 60:64] * (0.5, 1, 0.5)
    values[10:40, 100:150] = values[10:40, 100:150] * (0.5, 1, 0.5)
    found = segment_vegetation(values)
    assert not found[:, :90].any() and found[10:40, 100:150].mean() > 0.8


def test_points_stand_by_their_height_above_the_ground_near_them():
    ground = np.array([[0.0, 0.0, 0.0], [0.0, 5.0, 1.0]])
    others = np.array([[0.1, 0, 1.0], [0.1, 0, 0.1], [3.0, 0, 2.0], [0, 5.1, 1.2], [0, 5.1, 2.0]])
    points = np.concatenate([ground, others, [[np.nan, 0, 9]]])
    stands = standing_points(points, np.arange(8) < 2, camera_height=1.6)
    assert stands.tolist() == [False, False, True, False, False, False, True, False]
    assert not standing_points(points, np.zeros(8, bool), 1.6).any()
    assert not standing_points(ground, np.ones(2, bool), 1.6).any()


def test_a_box_stands_and_a_green_one_is_vegetation(yard):
    scene, truths, _ = yard
    ground = classify_ground_points(scene)
    for view, truth in zip(scene.views, truths, strict=True):
        grey = heuristic_labels(view, scene, ground)
        assert not (grey == VEGETATION).any()
        assert (grey == BUILDING)[truth == 1].mean() > 0.3
        assert (grey == BUILDING)[truth != 1].mean() < 0.03
        green = np.random.default_rng(1).uniform(0.6, 1.4, (120, 160, 1)) * (50, 80, 40)
        picture = np.where((truth == 1)[..., None], green, np.asarray(Image.open(view.path)))
        Image.fromarray(np.clip(picture, 0, 255).astype(np.uint8)).save(view.path)
        found = heuristic_labels(view, scene, ground)
        assert (found == VEGETATION)[truth == 1].mean() > 0.3
        assert not (found == VEGETATION)[truth != 1].mean() > 0.03


@pytest.mark.skipif(not STREET.is_dir(), reason="the reference street is not in this checkout")
def test_precision_of_what_stands_on_the_reference_street():
    scene = read_scene(STREET, holdout="0")
    ground = classify_ground_points(scene)
    pairs = [(heuristic_labels(v, scene, ground), load_labels(v, scene)) for v in scene.views[::7]]
    found, truth = (np.concatenate([each[i].ravel() for each in pairs]) for i in (0, 1))
    leaves, solid = truth == 8, ~np.isin(truth, (0, 1, 8, 9, 10))
    assert leaves[found == VEGETATION].mean() > 0.85  # the rest is mostly lawn
    assert (found == VEGETATION)[leaves].mean() > 0.5
    assert solid[found == BUILDING].mean() > 0.9
    assert (found == BUILDING)[solid].mean() > 0.03


@pytest.mark.slow
def test_a_cairn_among_trees_is_solid(captures):
    """The network that labelled this capture takes the cairn for a person or for leaves."""
    scene = read_scene(captures / "stone_sign", holdout="0")
    ground = classify_ground_points(scene)
    labels = [heuristic_labels(view, scene, ground) for view in scene.views[::12]]
    found = np.concatenate([each[320:400, 190:260].ravel() for each in labels])
    assert (found == BUILDING).mean() > 0.6 and (found == VEGETATION).mean() < 0.1


@pytest.mark.slow
def test_ground_of_a_real_drive(captures):
    """Reference labels are a network's, which takes dry verges and leaf litter for vegetation."""
    scene = read_scene(captures / "kitti_drive", holdout="0")
    ground = classify_ground_points(scene)
    found = [heuristic_labels(view, scene, ground) == GROUND for view in scene.views[::12]]
    truth = [np.isin(load_labels(view, scene), (0, 1, 9)) for view in scene.views[::12]]
    correct = np.sum([f & t for f, t in zip(found, truth, strict=True)])
    assert correct > 0.94 * np.sum(found) and correct > 0.4 * np.sum(truth)


@pytest.mark.slow
def test_sky_of_real_captures_and_of_a_room(captures):
    """Reference labels are a network's, which misses some sky between branches."""
    for name, precision, recall in (("ditch", 0.95, 0.65), ("stone_sign", 0.75, 0.65)):
        scene = read_scene(captures / name, holdout="0")
        assert is_outdoors(scene), name
        found = [heuristic_labels(view, scene, None) == SKY for view in scene.views[::12]]
        truth = [load_labels(view, scene) == SKY for view in scene.views[::12]]
        correct = np.sum([f & t for f, t in zip(found, truth, strict=True)])
        assert correct > precision * np.sum(found) and correct > recall * np.sum(truth), name
    assert not is_outdoors(read_scene(captures / "fox", holdout="0"))
