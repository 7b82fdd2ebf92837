"""Multi-view stereo against known planes and against the reference street."""

from pathlib import Path

import numpy as np
import pytest
import torch
from support.tower import poses
from support.toy_photos import DISTORTED, PINHOLE, pattern, photos, rows_of_cameras, wall

from climatenerf.core.cameras import Camera
from climatenerf.evaluation.reference import read_reference
from climatenerf.ops.cpu import plane_sweep as kernels
from climatenerf.scene import read_scene
from climatenerf.scene.images import load_image
from climatenerf.training.dataset import TrainingPixels
from climatenerf.training.evidence import multiview_stereo
from climatenerf.training.evidence.multiview_stereo import (
    build_pictures,
    depth_ranges,
    plane_sweep_depth,
    select_neighbours,
)
from climatenerf.training.evidence.sparse_depth import SparseDepth, read_sparse_depth

REFERENCE = Path(__file__).resolve().parents[3] / "reference" / "street"
WINDOWS = 5 * 96 * 72 // multiview_stereo.PIXELS_PER_WINDOW  # of five photos
DEFAULT_RANGE = (1.5, 4.0)  # nearest and median depth, m


def errors(pixels, found):
    """Relative errors of the measured depth of the wall."""
    eye, d = found.rays_o.double().numpy(), found.rays_d.double().numpy()
    t = (4.0 + 0.3 * eye[:, 0] - eye[:, 1]) / (d[:, 1] - 0.3 * d[:, 0])
    return np.abs(found.depth.numpy() / t - 1)


@pytest.mark.parametrize("camera", [PINHOLE, DISTORTED])
def test_depth_of_a_textured_wall(camera):
    grey = pattern()
    pixels = photos(camera, lambda i, t, x: grey(x), exposure=lambda i: (1.0, 0.5, 0.8)[i % 3])
    found = plane_sweep_depth(pixels, None, DEFAULT_RANGE, 0)
    assert found is not None
    off = errors(pixels, found)
    assert len(off) > 0.15 * WINDOWS
    assert np.median(off) < 0.005 and (off < 0.02).mean() > 0.95
    assert torch.allclose(found.rays_d.norm(dim=-1), torch.ones(len(off)), atol=1e-5)
    again = plane_sweep_depth(pixels, None, DEFAULT_RANGE, 0)
    assert again is not None and torch.equal(again.depth, found.depth)


def test_no_depth_without_texture_overlap_or_neighbours():
    blank = photos(PINHOLE, lambda i, t, x: np.full(t.shape, 0.5))
    assert plane_sweep_depth(blank, None, DEFAULT_RANGE, 0) is None
    other = [pattern(seed) for seed in range(5)]
    unrelated = photos(PINHOLE, lambda i, t, x: other[i](x))
    found = plane_sweep_depth(unrelated, None, DEFAULT_RANGE, 0)
    assert found is None or len(found.depth) < 0.03 * WINDOWS
    one = photos(PINHOLE, lambda i, t, x: other[0](x), c2w=rows_of_cameras(1))
    assert plane_sweep_depth(one, None, DEFAULT_RANGE, 0) is None


def test_ambiguous_stripes_are_rejected():
    stripes = photos(PINHOLE, lambda i, t, x: 0.5 + 0.4 * np.sin(2 * np.pi * x[..., 0] / 0.25))
    found = plane_sweep_depth(stripes, None, DEFAULT_RANGE, 0)
    if found is not None:  # near the sides most depths project outside the neighbours
        uv = stripes.xy_towards(found.image, found.rays_d)
        assert ((uv[:, 0] > 0.3) & (uv[:, 0] < 0.7)).sum() < 0.01 * WINDOWS


def test_sky_and_masked_pixels_are_skipped():
    grey = pattern()
    labels = [np.full((72, 96), 2, np.uint8) for _ in range(5)]
    masks = [np.ones((72, 96), bool) for _ in range(5)]
    for label, mask in zip(labels, masks, strict=True):
        label[:24], mask[:, :48] = 10, False
    pixels = photos(PINHOLE, lambda i, t, x: grey(x), labels=labels, masks=masks)
    found = plane_sweep_depth(pixels, None, DEFAULT_RANGE, 0)
    assert found is not None
    uv = pixels.xy_towards(found.image, found.rays_d)
    assert uv[:, 0].min() > 0.5 and uv[:, 1].min() > 1 / 3
    assert len(found.depth) > 0.05 * WINDOWS
    pictures = build_pictures(pixels, np.full((5, 9), 1.5), np.full((5, 9), 4.0))
    grey_levels = pictures.grey.reshape(5, 72, 96)
    assert (grey_levels[:, :, :48] == kernels.UNSEEN).all() and (grey_levels[:, :, 48:] > 0).all()


def correlation_in_world_space(cameras, c2w, images, i, j, x, y, s):
    """Correlation of two windows, pixel by pixel through world space; NaN outside or if flat."""
    window, other = [], []
    for row in range(-kernels.SIDE, kernels.SIDE + 1):
        for column in range(-kernels.SIDE, kernels.SIDE + 1):
            at = np.array([x + column, y + row])
            window.append(bilinear(images[i], at))
            local = np.linalg.inv(cameras[i].matrix) @ np.array([*at, 1.0]) / s
            world = c2w[i][:3, :3] @ local + c2w[i][:3, 3]
            there = c2w[j][:3, :3].T @ (world - c2w[j][:3, 3])
            other.append(bilinear(images[j], cameras[j].project(there[None])[0]))
    return np.corrcoef(window, other)[0, 1] if np.std(other) > kernels.MIN_CONTRAST else np.nan


def bilinear(image, at):
    x, y = at - 0.5
    i, j = int(np.floor(x)), int(np.floor(y))
    if not (0 <= x <= image.shape[1] - 1 and 0 <= y <= image.shape[0] - 1):
        return np.nan
    i, j = min(i, image.shape[1] - 2), min(j, image.shape[0] - 2)
    u, v = x - i, y - j
    upper = (1 - u) * image[j, i] + u * image[j, i + 1]
    return (1 - v) * upper + v * ((1 - u) * image[j + 1, i] + u * image[j + 1, i + 1])


def different_cameras():
    """Photos of the wall in two sizes, with cameras of different yaw, pitch and roll."""
    grey, c2w = pattern(), poses(40, distance=4.0)[:5]
    small = Camera(64, 60, 70.0, 66.0, 30.0, 31.0)
    images = []
    for i, pose in enumerate(c2w):
        pose[:3, :3] = pose[:3, :3] @ turned(0.1 * (i - 2), 0.15 * (-1) ** i)
        levels = grey(wall((PINHOLE, small)[i % 2], pose)[1])
        images.append(np.repeat((255 * levels + 0.5).astype(np.uint8)[..., None], 3, -1))
    return TrainingPixels([PINHOLE, small], [0, 1, 0, 1, 0], c2w, images), c2w


def turned(pitch, roll):
    """Rotation about x and then z."""
    a, b, c, d = np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
    about_x = np.array([[1.0, 0, 0], [0, a, -b], [0, b, a]])
    return about_x @ np.array([[c, -d, 0], [d, c, 0], [0, 0, 1.0]])


def test_correlation_matches_the_reference():
    pixels, c2w = different_cameras()
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
        assert tile == multiview_stereo._tiles(np.array([[x / width, y / height]]))[0]
        ours = kernels._correlation(pictures, i, tile, np.float32(x), np.float32(y), s, window)
        js = [j for j in pictures.neighbours[i, tile] if j >= 0]
        each = [correlation_in_world_space(cameras, c2w, images, i, j, x, y, s) for j in js]
        best = sorted(value for value in each if np.isfinite(value))[-2:]
        if len(best) < 2:
            assert ours == kernels.NONE
        else:
            compared += 1
            assert ours == pytest.approx(np.mean(best), abs=2e-3)
    assert compared > 20


def test_each_tile_has_its_own_depth_range():
    pixels = photos(PINHOLE, lambda i, t, x: np.full(t.shape, 0.5))
    pixel = np.array(
        [(16.0, 12.0)] * 30 + [(80.0, 12.0)] * 30 + [(48.0, 60.0)] * 5 + [(0.0, 0.0)] * 30
    )
    local = np.concatenate([(pixel - (48, 36)) / 90, np.ones((95, 1))], -1)
    local[-30:] = (9.0, 0.0, -1.0)  # behind the camera: in no tile, although nearest
    depth = np.repeat([2.0, 8.0, 1.0, 1.0], [30, 30, 5, 30])
    local /= np.linalg.norm(local, axis=-1, keepdims=True)
    turn = pixels.c2w[1, :3, :3].numpy()
    points = SparseDepth(
        torch.zeros(95, 3),
        torch.from_numpy((local @ turn.T).astype(np.float32)),
        torch.from_numpy(depth.astype(np.float32)),
        torch.ones(95, dtype=torch.long),
    )
    near, middle = depth_ranges(pixels, points, DEFAULT_RANGE)
    assert middle[1, 0] == 2.0 and middle[1, 2] == 8.0
    assert near[1, 0] == pytest.approx(0.5 * 2.0 * local[0, 2], rel=1e-5), "z-depth, with a margin"
    assert near[1, 2] == pytest.approx(0.5 * 8.0 * local[30, 2], rel=1e-5)
    assert (middle[1, [1, 3, 5, 7]] == np.median(depth)).all(), (
        "too few points: the range of the photo"
    )
    assert (middle[0] == np.median(depth)).all(), "a photo without points: the range of all"
    assert (near > 0).all(), "the sweep uses its inverse"
    near, middle = depth_ranges(pixels, None, DEFAULT_RANGE)
    assert (near == DEFAULT_RANGE[0]).all() and (middle == DEFAULT_RANGE[1]).all()


def test_neighbours_have_similar_axes_and_triangulation_angles():
    c2w = rows_of_cameras(9)
    turned = c2w[0].copy()
    turned[:3, 0], turned[:3, 2] = -turned[:3, 0], -turned[:3, 2]
    c2w = np.concatenate([c2w, turned[None]])
    middle = np.full((10, 9), 4.0)
    found = select_neighbours(c2w, [PINHOLE] * 10, middle)
    assert (found[9] == -1).all(), "it looks in the opposite direction"
    assert sorted(found[4, 4]) == [2, 3, 5, 6], "4 and 8 degrees to each side"
    assert (select_neighbours(c2w[:1], [PINHOLE], middle[:1]) == -1).all()
    middle[4, 4] = 8.0
    wider = select_neighbours(c2w, [PINHOLE] * 10, middle)
    assert sorted(wider[4, 4]) == [1, 2, 6, 7], "distant points need a wider baseline"
    assert (wider[4, 3] == found[4, 3]).all() and (found[4, 3] != found[4, 5]).any()


def test_depth_of_the_reference_street(monkeypatch):
    """Against the true depth of the held-out views: median error about 1 %, few outliers."""
    monkeypatch.setattr(multiview_stereo, "MAX_WINDOWS", 2**14)
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
    found = plane_sweep_depth(pixels, moved, DEFAULT_RANGE, 0)
    assert found is not None
    off = []
    for i, view in enumerate(scene.of_split("heldout")):
        truth = next(truth for truth in truths if truth.name == Path(view.name).name)
        of_view = found.select(found.image == i)
        uv = pixels.xy_towards(of_view.image, of_view.rays_d).numpy()
        height, width = truth.depth.shape
        true = truth.depth[(uv[:, 1] * height).astype(int), (uv[:, 0] * width).astype(int)]
        off.append(np.abs(of_view.depth.numpy() / true - 1))
    off = np.concatenate(off)
    assert len(off) > 100
    assert np.median(off) < 0.015 and (off < 0.05).mean() > 0.88
