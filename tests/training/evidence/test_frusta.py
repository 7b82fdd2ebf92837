"""Frustum culling against the camera's projection of many points."""

import numpy as np
import pytest
import torch
from support.toy_scene import poses

from climatenerf.core.cameras import Camera
from climatenerf.training.evidence.frusta import (
    frustum_planes,
    intersects_frustum,
    within_camera_range,
)

PINHOLE = Camera(48, 36, 40.0, 44.0, 20.0, 19.0)
DISTORTED = Camera(48, 36, 40.0, 44.0, 20.0, 19.0, k1=-0.2, k2=0.03, p1=0.01)


def projected(camera, c2w, x):
    """Whether positions x project into any camera."""
    seen = np.zeros(len(x), bool)
    for pose in c2w:
        local = (x - pose[:3, 3]) @ pose[:3, :3]
        with np.errstate(invalid="ignore"):
            pixel = camera.project(local)
            visible = np.all((pixel >= 0) & (pixel <= (camera.width, camera.height)), axis=-1)
        if camera.distorted:  # far off the axis the polynomial is not monotonic
            visible &= local[:, 2] > 0.5 * np.linalg.norm(local, axis=-1)
        seen |= visible
    return seen


def test_points_in_a_frustum_are_those_that_a_pinhole_camera_shows():
    c2w = np.stack(poses(5))
    x = np.random.default_rng(0).uniform(-6, 6, (20_000, 3)).astype(np.float32)
    ours = intersects_frustum(
        torch.from_numpy(x), torch.zeros(len(x)), frustum_planes([PINHOLE] * 5, c2w)
    ).numpy()
    theirs = projected(PINHOLE, c2w, x)
    assert 0.2 < theirs.mean() < 0.9
    assert (ours != theirs).mean() < 1e-3, "except for rounding at the border"


def test_frustum_of_a_distorted_camera_encloses_its_image_closely():
    c2w = np.stack(poses(5))
    x = np.random.default_rng(1).uniform(-6, 6, (20_000, 3)).astype(np.float32)
    ours = intersects_frustum(
        torch.from_numpy(x), torch.full((len(x),), 1e-3), frustum_planes([DISTORTED] * 5, c2w)
    )
    theirs = projected(DISTORTED, c2w, x)
    assert not (theirs & ~ours.numpy()).any()
    assert (ours.numpy() & ~theirs).mean() < 0.1


def test_a_ball_intersects_a_frustum_as_soon_as_it_touches_it():
    c2w = np.eye(4)[None]
    frusta = frustum_planes([PINHOLE], c2w)
    edge = np.array([(48 - 20) / 40, 0.0, 1.0])  # the middle of the right side, at 1 m
    outward = np.array([40, 0, -28]) / np.hypot(40, 28)
    x = torch.from_numpy((3 * edge + 0.5 * outward).astype(np.float32))[None]
    assert not intersects_frustum(x, torch.tensor([0.49]), frusta)
    assert intersects_frustum(x, torch.tensor([0.51]), frusta)
    behind = torch.tensor([[0.0, 0.0, -2.0]])
    assert not intersects_frustum(behind, torch.tensor([1.0]), frusta)


@pytest.mark.parametrize(
    "camera", [Camera(40, 40, 12.0, 12.0, 20.0, 20.0, fisheye=True), Camera(40, 40, 1, 1, 20, 20)]
)
def test_a_camera_too_wide_for_a_frustum_contains_everything(camera):
    x = torch.tensor([[0.0, 0.0, -2.0], [9.0, 9.0, 0.0]])
    assert intersects_frustum(x, torch.zeros(2), frustum_planes([camera], np.eye(4)[None])).all()


def test_empty_input_gives_empty_output():
    frusta = frustum_planes([PINHOLE], np.eye(4)[None])
    assert intersects_frustum(torch.zeros(0, 3), torch.zeros(0), frusta).shape == (0,)


def test_camera_range_is_bounded_by_frustum_and_distance():
    c2w = np.stack(poses(5))
    x = np.random.default_rng(2).uniform(-6, 6, (20_000, 3)).astype(np.float32)
    max_distance = np.array([0.5, 1.0, 2.0, 3.0, 0.0], np.float32)
    centres = c2w[:, :3, 3].astype(np.float32)
    near = np.zeros(len(x), bool)
    for pose, far in zip(c2w, max_distance, strict=True):
        near |= projected(PINHOLE, [pose], x) & (np.linalg.norm(x - pose[:3, 3], axis=-1) < far)
    arguments = (
        frustum_planes([PINHOLE] * 5, c2w),
        torch.from_numpy(centres),
        torch.from_numpy(max_distance),
    )
    ours = within_camera_range(torch.from_numpy(x), torch.zeros(len(x)), *arguments)
    assert near.sum() > 100 and (ours.numpy() != near).sum() <= 2, "except for rounding"
    balls = within_camera_range(torch.from_numpy(x), torch.full((len(x),), 0.2), *arguments)
    assert (ours | ~balls).all() and balls.sum() < ours.sum(), "the whole ball must be in range"
