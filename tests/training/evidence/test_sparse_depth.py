"""Sparse depth: which rays a scene gives, and how masks hide some of them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from support.toy_scene import CAMERA, make_scene

from climatenerf.training.evidence.sparse_depth import read_sparse_depth, unmasked_sparse_depth
from climatenerf.training.run import load_pixels


@pytest.fixture
def scene(tmp_path):
    """The toy scene with three points; views observe none, one, two and three in turn."""
    points = np.array([[0.0, 0.0, 1.0], [0.5, 0.0, 0.2], [-1.0, 0.5, 0.3]])
    scene = make_scene(tmp_path)
    views = tuple(replace(v, seen=np.arange(i % 4)) for i, v in enumerate(scene.views))
    return replace(scene, points=points, views=views)


def test_rays_end_at_their_points_and_skip_held_out_views(scene):
    found = read_sparse_depth(scene)
    assert found is not None
    training = scene.of_split("train")
    assert found.depth.shape[0] == sum(len(v.seen) for v in training)
    assert len(training) < len(scene.views)
    ends = found.rays_o + found.depth[:, None] * found.rays_d
    expected = np.concatenate([scene.points_world()[v.seen] for v in training])
    np.testing.assert_allclose(ends, expected, atol=1e-5)
    assert torch.allclose(found.rays_d.norm(dim=-1), torch.ones(len(ends)))
    # The direction is that of the pixel onto which the point projects.
    view = next(v for v in training if len(v.seen))
    local = (expected[0] - scene.c2w_world(view)[:3, 3]) @ scene.c2w_world(view)[:3, :3]
    pixel = CAMERA.project(local)
    direction = scene.c2w_world(view)[:3, :3] @ CAMERA.directions(pixel)
    np.testing.assert_allclose(found.rays_d[0], direction, atol=1e-5)


def test_drawn_rays_keep_origin_direction_and_depth_together(scene):
    found = read_sparse_depth(scene)
    drawn = found.draw(50, torch.Generator().manual_seed(0))
    ends = drawn.rays_o + drawn.depth[:, None] * drawn.rays_d
    distance = (ends[:, None] - torch.tensor(scene.points_world()[None], dtype=torch.float32)).norm(
        dim=-1
    )
    assert distance.min(dim=1).values.max() < 1e-5


def test_no_sparse_depth_without_points_or_observations(scene):
    unknown = tuple(replace(v, seen=None) for v in scene.views)
    assert read_sparse_depth(replace(scene, views=unknown)) is None
    assert read_sparse_depth(replace(scene, points=None)) is None
    nothing = tuple(replace(v, seen=np.empty(0, int)) for v in scene.views)
    assert read_sparse_depth(replace(scene, views=nothing)) is None


def test_masked_pixels_give_no_sparse_depth(scene, tmp_path):
    """A masked mirror, for example: its points lie behind the wall."""
    unmasked = read_sparse_depth(scene)
    views = scene.of_split("train")
    view = next(v for v in views if len(v.seen) == 3)
    c2w, points = scene.c2w_world(view), scene.points_world()[view.seen]
    column = CAMERA.project((points - c2w[:3, 3]) @ c2w[:3, :3])[:, 0]
    border = int(np.sort(column)[1])  # between the leftmost and the others
    mask = np.full((CAMERA.height, CAMERA.width), 255, np.uint8)
    mask[:, : border - 1] = 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    masked = tuple(
        replace(v, mask_path=tmp_path / "mask.png") if v.name == view.name else v
        for v in scene.views
    )
    masked = replace(scene, views=masked)
    found = unmasked_sparse_depth(masked, load_pixels(masked, 1))
    image = [v.name for v in views].index(view.name)
    assert (unmasked.image == image).sum() == 3 and (found.image == image).sum() == 2
    assert (found.image != image).sum() == (unmasked.image != image).sum()
    hidden = points[np.argmin(column)]
    ends = found.points[found.image == image].numpy()
    assert np.linalg.norm(ends - hidden, axis=-1).min() > 0.1
    assert unmasked_sparse_depth(scene, load_pixels(scene, 1)).depth.shape == unmasked.depth.shape
