"""Photos matched with their neighbours, against planes that are known and against the street."""

from pathlib import Path

import numpy as np
import pytest
import torch
from support.toy_photos import BENT, PLAIN, pattern, photos, rows_of_cameras, wall
from test_visual_hull import poses

from climatenerf.core.cameras import Camera
from climatenerf.evaluation.reference import read_reference
from climatenerf.ops.cpu import plane_sweep as kernels
from climatenerf.scene import read_scene
from climatenerf.scene.images import load_image
from climatenerf.training.dataset import TrainingPixels
from climatenerf.training.evidence import multiview_stereo as matching
from climatenerf.training.evidence.multiview_stereo import (
    build_pictures,
    depth_ranges,
    neighbours,
    plane_sweep_depth,
)
from climatenerf.training.evidence.sparse_depth import SparseDepth, read_sparse_depth

REFERENCE = Path(__file__).resolve().parents[3] / "reference" / "street"
ASKED = 5 * 96 * 72 // matching.PIXELS  # windows of five photos
TYPICAL = (1.5, 4.0)  # nearest and typical distance, m


def errors(pixels, found):
    """Relative errors of matched distances to the wall."""
    eye, d = found.rays_o.double().numpy(), found.rays_d.double().numpy()
    t = (4.0 + 0.3 * eye[:, 0] - eye[:, 1]) / (d[:, 1] - 0.3 * d[:, 0])
    return np.abs(found.depth.numpy() / t - 1)


@pytest.mark.parametrize("camera", [PLAIN, BENT])
def test_a_patterned_wall_is_found_where_it_is(camera):
    grey = pattern()
    pixels = photos(camera, lambda i, t, x: grey(x), exposure=lambda i: (1.0, 0.5, 0.8)[i % 3])
    found = plane_sweep_depth(pixels, None, TYPICAL, 0)
    assert found is not None
    off = errors(pixels, found)
    assert len(off) > 0.15 * ASKED
    assert np.median(off) < 0.005 and (off < 0.02).mean() > 0.95
    assert torch.allclose(found.rays_d.norm(dim=-1), torch.ones(len(off)), atol=1e-5)
    again = plane_sweep_depth(pixels, None, TYPICAL, 0)
    assert again is not None and torch.equal(again.depth, found.depth)


def test_what_shows_nothing_is_not_matched():
    blank = photos(PLAIN, lambda i, t, x: np.full(t.shape, 0.5))
    assert plane_sweep_depth(blank, None, TYPICAL, 0) is None
    other = [pattern(seed) for seed in range(5)]
    strangers = photos(PLAIN, lambda i, t, x: other[i](x))
    found = plane_sweep_depth(strangers, None, TYPICAL, 0)
    assert found is None or len(found.depth) < 0.03 * ASKED
    one = photos(PLAIN, lambda i, t, x: other[0](x), c2w=rows_of_cameras(1))
    assert plane_sweep_depth(one, None, TYPICAL, 0) is None


def test_stripes_that_fit_in_many_places_are_left_alone():
    stripes = photos(PLAIN, lambda i, t, x: 0.5 + 0.4 * np.sin(2 * np.pi * x[..., 0] / 0.25))
    found = plane_sweep_depth(stripes, None, TYPICAL, 0)
    if found is not None:  # by the pictures' sides, where most distances leave the neighbours
        place = stripes.place_towards(found.image, found.rays_d)
        assert ((place[:, 0] > 0.3) & (place[:, 0] < 0.7)).sum() < 0.01 * ASKED


def test_sky_and_what_masks_hide_is_not_asked():
    grey = pattern()
    labels = [np.full((72, 96), 2, np.uint8) for _ in range(5)]
    masks = [np.ones((72, 96), bool) for _ in range(5)]
    for label, mask in zip(labels, masks, strict=True):
        label[:24], mask[:, :48] = 10, False
    pixels = photos(PLAIN, lambda i, t, x: grey(x), labels=labels, masks=masks)
    found = plane_sweep_depth(pixels, None, TYPICAL, 0)
    assert found is not None
    place = pixels.place_towards(found.image, found.rays_d)
    assert place[:, 0].min() > 0.5 and place[:, 1].min() > 1 / 3
    assert len(found.depth) > 0.05 * ASKED
    pictures = build_pictures(pixels, np.full((5, 9), 1.5), np.full((5, 9), 4.0))
    shown = pictures.grey.reshape(5, 72, 96)
    assert (shown[:, :, :48] == kernels.UNSEEN).all() and (shown[:, :, 48:] > 0).all()


def slow_likeness(cameras, c2w, images, i, j, x, y, s):
    """Correlation of two windows by way of the world, pixel by pixel; NaN outside or if flat."""
    own, other = [], []
    for row in range(-kernels.SIDE, kernels.SIDE + 1):
        for column in range(-kernels.SIDE, kernels.SIDE + 1):
            at = np.array([x + column, y + row])
            own.append(looked_up(images[i], at))
            local = np.linalg.inv(cameras[i].matrix) @ np.array([*at, 1.0]) / s
            world = c2w[i][:3, :3] @ local + c2w[i][:3, 3]
            there = c2w[j][:3, :3].T @ (world - c2w[j][:3, 3])
            other.append(looked_up(images[j], cameras[j].project(there[None])[0]))
    return np.corrcoef(own, other)[0, 1] if np.std(other) > kernels.MIN_CONTRAST else np.nan


def looked_up(image, at):
    x, y = at - 0.5
    i, j = int(np.floor(x)), int(np.floor(y))
    if not (0 <= x <= image.shape[1] - 1 and 0 <= y <= image.shape[0] - 1):
        return np.nan
    i, j = min(i, image.shape[1] - 2), min(j, image.shape[0] - 2)
    u, v = x - i, y - j
    upper = (1 - u) * image[j, i] + u * image[j, i + 1]
    return (1 - v) * upper + v * ((1 - u) * image[j + 1, i] + u * image[j + 1, i + 1])


def unlike_cameras():
    """Photos of the wall in two sizes, their cameras pitched and rolled as well as turned."""
    grey, c2w = pattern(), poses(40, distance=4.0)[:5]
    small = Camera(64, 60, 70.0, 66.0, 30.0, 31.0)
    images = []
    for i, pose in enumerate(c2w):
        pose[:3, :3] = pose[:3, :3] @ turned(0.1 * (i - 2), 0.15 * (-1) ** i)
        level = grey(wall((PLAIN, small)[i % 2], pose)[1])
        images.append(np.repeat((255 * level + 0.5).astype(np.uint8)[..., None], 3, -1))
    return TrainingPixels([PLAIN, small], [0, 1, 0, 1, 0], c2w, images), c2w


def turned(pitch, roll):
    """Rotation about x and then z."""
    a, b, c, d = np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
    about_x = np.array([[1.0, 0, 0], [0, a, -b], [0, b, a]])
    return about_x @ np.array([[c, -d, 0], [d, c, 0], [0, 0, 1.0]])


def test_likeness_is_that_of_the_slow_twin():
    pixels, c2w = unlike_cameras()
    near, middle = np.full((5, 9), 1.0), np.full((5, 9), 4.0)
    pictures = build_pictures(pixels, near, middle)
    cameras = pixels.cameras
    images = [
        pictures.grey[start : start + c.width * c.height].reshape(c.height, c.width).astype(float)
        for start, c in zip(pictures.start, cameras, strict=True)
    ]
    random, compared = np.random.default_rng(0), 0
    for _ in range(120):
        i, s = int(random.integers(5)), float(random.uniform(0.1, 0.5))
        width, height = cameras[i].width, cameras[i].height
        x, y = random.uniform(3, width - 3), random.uniform(3, height - 3)
        window = np.empty(25, np.float32)
        if not kernels._take_window(pictures, i, np.float32(x), np.float32(y), window):
            continue
        tile = kernels._tile(pictures, i, x, y)
        assert tile == 3 * int(3 * y / height) + int(3 * x / width)
        assert tile == matching._tiles(np.array([[x / width, y / height]]))[0]
        ours = kernels._alike(pictures, i, tile, np.float32(x), np.float32(y), s, window)
        js = [j for j in pictures.others[i, tile] if j >= 0]
        each = [slow_likeness(cameras, c2w, images, i, j, x, y, s) for j in js]
        best = sorted(value for value in each if np.isfinite(value))[-2:]
        if len(best) < 2:
            assert ours == kernels.NONE
        else:
            compared += 1
            assert ours == pytest.approx(np.mean(best), abs=2e-3)
    assert compared > 20


def test_each_ninth_of_a_photo_has_distances_of_its_own():
    pixels = photos(PLAIN, lambda i, t, x: np.full(t.shape, 0.5))
    place = np.array(
        [(16.0, 12.0)] * 30 + [(80.0, 12.0)] * 30 + [(48.0, 60.0)] * 5 + [(0.0, 0.0)] * 30
    )
    local = np.concatenate([(place - (48, 36)) / 90, np.ones((95, 1))], -1)
    local[-30:] = (9.0, 0.0, -1.0)  # behind: in no tile, though these are the nearest
    depth = np.repeat([2.0, 8.0, 1.0, 1.0], [30, 30, 5, 30])
    local /= np.linalg.norm(local, axis=-1, keepdims=True)
    turn = pixels.c2w[1, :3, :3].numpy()
    points = SparseDepth(
        torch.zeros(95, 3),
        torch.from_numpy((local @ turn.T).astype(np.float32)),
        torch.from_numpy(depth.astype(np.float32)),
        torch.ones(95, dtype=torch.long),
    )
    near, middle = depth_ranges(pixels, points, TYPICAL)
    assert middle[1, 0] == 2.0 and middle[1, 2] == 8.0
    assert near[1, 0] == pytest.approx(0.5 * 2.0 * local[0, 2], rel=1e-5), "z-depth, with a margin"
    assert near[1, 2] == pytest.approx(0.5 * 8.0 * local[30, 2], rel=1e-5)
    assert (middle[1, [1, 3, 5, 7]] == np.median(depth)).all(), "few points: the photo's"
    assert (middle[0] == np.median(depth)).all(), "a photo without points: that of all"
    assert (near > 0).all(), "its inverse is searched"
    near, middle = depth_ranges(pixels, None, TYPICAL)
    assert (near == TYPICAL[0]).all() and (middle == TYPICAL[1]).all()


def test_neighbours_look_the_same_way_from_the_side():
    c2w = rows_of_cameras(9)
    turned = c2w[0].copy()
    turned[:3, 0], turned[:3, 2] = -turned[:3, 0], -turned[:3, 2]
    c2w = np.concatenate([c2w, turned[None]])
    middle = np.full((10, 9), 4.0)
    found = neighbours(c2w, [PLAIN] * 10, middle)
    assert (found[9] == -1).all(), "it looks the other way"
    assert sorted(found[4, 4]) == [2, 3, 5, 6], "4 and 8 degrees to either side"
    assert (neighbours(c2w[:1], [PLAIN], middle[:1]) == -1).all()
    middle[4, 4] = 8.0
    wider = neighbours(c2w, [PLAIN] * 10, middle)
    assert sorted(wider[4, 4]) == [1, 2, 6, 7], "what is far, from farther apart"
    assert (wider[4, 3] == found[4, 3]).all() and (found[4, 3] != found[4, 5]).any()


def test_the_street_s_distances_are_found(monkeypatch):
    """In photos whose true depth is known: a percent off, and few are wrong."""
    monkeypatch.setattr(matching, "WINDOWS", 2**14)
    scene, truths = read_scene(REFERENCE), read_reference(REFERENCE).truths
    views = [*scene.of_split("heldout"), *scene.of_split("train")]
    pixels = TrainingPixels(
        [scene.cameras[0]],
        [0] * len(views),
        np.stack([scene.c2w_world(view) for view in views]),
        [load_image(view, scene) for view in views],
    )
    points = read_sparse_depth(scene)
    assert points is not None
    moved = points.select(torch.arange(points.depth.shape[0]))
    moved.image.add_(len(scene.of_split("heldout")))
    found = plane_sweep_depth(pixels, moved, TYPICAL, 0)
    assert found is not None
    off = []
    for i, view in enumerate(scene.of_split("heldout")):
        truth = next(truth for truth in truths if truth.name == Path(view.name).name)
        some = found.select(found.image == i)
        place = pixels.place_towards(some.image, some.rays_d).numpy()
        height, width = truth.depth.shape
        true = truth.depth[(place[:, 1] * height).astype(int), (place[:, 0] * width).astype(int)]
        off.append(np.abs(some.depth.numpy() / true - 1))
    off = np.concatenate(off)
    assert len(off) > 100
    assert np.median(off) < 0.015 and (off < 0.05).mean() > 0.88
