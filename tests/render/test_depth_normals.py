import numpy as np
import pytest
from support.analytic_fields import AnalyticField, Box, HalfSpace

from climatenerf.core.cameras import Camera
from climatenerf.render.depth_normals import plane_normals
from climatenerf.render.frame import FrameOptions, render_frame
from climatenerf.weather.world import World

CAMERA = Camera(80, 60, 100.0, 100.0, 40.0, 30.0)
EYE = np.array([1.0, -2.0, 0.5])
ANGLE = 1 / 100


def depth_to(normal, at, directions):
    """Ray lengths from EYE to the plane through EYE + at."""
    return (at @ normal) / (directions @ normal)


def degrees(a, b):
    return np.degrees(np.arccos(np.clip((a * b).sum(-1), -1, 1)))


@pytest.mark.parametrize("noise", [0.0, 3e-3])
@pytest.mark.parametrize("slant", [0.0, 40.0, 65.0])
def test_normals_of_slanted_planes_with_and_without_depth_noise(slant, noise):
    d = CAMERA.directions()
    s = np.radians(slant)
    normal = np.array([0.0, np.sin(s), -np.cos(s)])
    depth = depth_to(normal, np.array([0.0, 0.0, 6.0]), d)
    depth = depth * (1 + noise * np.random.default_rng(0).normal(size=depth.shape))
    found = plane_normals(EYE, d, depth, ANGLE)
    assert np.linalg.norm(found, axis=-1) == pytest.approx(1, abs=1e-5)
    error = degrees(found, normal)[5:-5, 5:-5]
    assert (error.max() < 0.1) if noise == 0 else (np.median(error) < 8)


def test_normals_are_sharp_at_edges_and_zero_in_the_sky():
    d = CAMERA.directions()
    near = depth_to(np.array([0.0, 0.0, -1.0]), np.array([0.0, 0.0, 3.0]), d)
    s = np.radians(50)
    tilted = np.array([-np.sin(s), 0.0, -np.cos(s)])
    far = depth_to(tilted, np.array([0.0, 0.0, 9.0]), d)
    left = np.arange(80)[None] < 30
    depth = np.where(left, near, far)
    depth[:10] = np.inf
    found = plane_normals(EYE, d, depth, ANGLE)
    assert (found[:10] == 0).all()
    assert degrees(found[10:, :30], np.array([0.0, 0.0, -1.0])).max() < 1
    assert degrees(found[10:, 30:], tilted).max() < 1


def test_a_pixel_without_neighbours_faces_the_camera():
    d = CAMERA.directions()
    depth = np.full((60, 80), np.inf)
    depth[20, 30] = 4.0
    found = plane_normals(EYE, d, depth, ANGLE)
    assert found[20, 30] == pytest.approx(-d[20, 30], abs=1e-5)
    assert np.isfinite(found).all() and np.abs(found).sum() == pytest.approx(
        np.abs(d[20, 30]).sum(), abs=1e-4
    )


@pytest.mark.parametrize("supersample", [1, 3])
def test_the_normal_layer_matches_an_analytic_scene(supersample):
    field = AnalyticField(
        [HalfSpace(), Box((-1.0, 2.0, -1.0), (1.0, 4.0, 2.0))],
        box=((-50.0, -50.0, -5.0), (50.0, 50.0, 9.0)),
    )
    c2w = np.eye(4)
    c2w[:3, :3] = np.stack([[1, 0, 0], [0, 0, -1], [0, 1, 0]], -1)
    c2w[:3, 3] = (0.0, -3.0, 1.5)
    _, layers = render_frame(World(field), CAMERA, c2w, FrameOptions(supersample, normals=True))
    d = CAMERA.directions() @ c2w[:3, :3].T
    hit = c2w[:3, 3] + np.where(np.isfinite(layers["depth"]), layers["depth"], 0)[..., None] * d
    ground = np.isfinite(layers["depth"]) & (np.abs(hit[..., 2]) < 0.02)
    wall = np.isfinite(layers["depth"]) & (np.abs(hit[..., 1] - 2) < 0.02) & (hit[..., 2] > 0.1)
    assert ground.sum() > 300 and wall.sum() > 300
    assert np.median(degrees(layers["normal"][ground], np.array([0.0, 0.0, 1.0]))) < 1
    assert np.median(degrees(layers["normal"][wall], np.array([0.0, -1.0, 0.0]))) < 1
    assert (layers["normal"][~np.isfinite(layers["depth"])] == 0).all()
