"""Progressive frames of an analytic street with flood and smog."""

import numpy as np
from test_integrator import CAMERA, flooded, pose_along, street

from climatenerf.core.cameras import Camera
from climatenerf.render import progressive
from climatenerf.render.frame import FrameOptions, render_frame
from climatenerf.weather.smog.medium import medium
from climatenerf.weather.smog.parameters import Smog
from climatenerf.weather.world import World

WORLD = World(street(), media=(medium(Smog(visibility=40.0), 0.0),), surfaces=(flooded(),))
POSE = pose_along((0.0, 1.0, -0.2))


def render_progressively(world, camera, supersample=1):
    pictures = []
    options = FrameOptions(supersample, show=pictures.append)
    frame, layers = render_frame(world, camera, POSE, options)
    return pictures, frame, layers


def test_the_last_picture_is_the_frame_and_each_ray_is_traced_once(monkeypatch):
    traced = []

    def counted(world, rays_o, *rest, **options):
        traced.append(len(rays_o))
        return trace(world, rays_o, *rest, **options)

    trace = progressive.trace
    monkeypatch.setattr(progressive, "trace", counted)
    pictures, frame, layers = render_progressively(WORLD, CAMERA)
    exact, exact_layers = render_frame(WORLD, CAMERA, POSE)
    assert np.array_equal(pictures[-1], exact) and np.array_equal(frame, exact)
    assert layers.keys() == exact_layers.keys()
    for name, values in exact_layers.items():
        assert np.array_equal(layers[name], values, equal_nan=True), name
    assert sum(traced) == CAMERA.width * CAMERA.height and traced[0] < sum(traced) / 15
    for picture, spacing in zip(pictures, progressive.SPACINGS, strict=True):
        known = frame[::spacing, ::spacing]
        assert np.array_equal(picture[::spacing, ::spacing], known), "traced pixels do not change"
        filled = known.repeat(spacing, 0).repeat(spacing, 1)
        assert np.array_equal(picture, filled[: CAMERA.height, : CAMERA.width])


def test_supersampled_frames_show_complete_pictures():
    pictures, frame, _ = render_progressively(WORLD, CAMERA, 2)
    assert [each.shape for each in pictures] == [frame.shape] * 3
    assert np.array_equal(pictures[-1], frame)
    assert np.array_equal(frame, render_frame(WORLD, CAMERA, POSE, FrameOptions(2))[0])
    error = [np.abs(each.astype(int) - frame).mean() for each in pictures]
    assert error[0] > error[1] > error[2] == 0


def test_picture_sides_need_not_be_multiples_of_the_spacing():
    for width, height in ((7, 5), (2, 1)):
        camera = Camera(width, height, 6.0, 6.0, width / 2, height / 2)
        pictures, _, _ = render_progressively(World(street()), camera)
        assert np.array_equal(pictures[-1], render_frame(World(street()), camera, POSE)[0])
