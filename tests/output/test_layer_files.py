"""Every layer of every effect, in all formats and for all supersampling, read back from its files.

Each format has a reader that shares no code with its writer.
"""

import dataclasses
import importlib.util
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from support.analytic_fields import AnalyticField, Box, HalfSpace
from support.exr import read_exr

from climatenerf.core.cameras import Camera
from climatenerf.core.classes import SOLID, TERRAIN, UNKNOWN
from climatenerf.field.capabilities import CLASSES, DENSITY
from climatenerf.output.layers import save_layers
from climatenerf.render.completed_ground import CompletedField
from climatenerf.render.session import RenderSession
from climatenerf.scene.scene import Scene, View
from climatenerf.scene.terrain import Terrain
from climatenerf.weather.description import weather_from_table
from climatenerf.weather.registry import layer_table

W, H = 40, 26
CAMERA = Camera(W, H, 26.0, 26.0, W / 2, H / 2)
PITCH = math.radians(10)
C2W = np.eye(4)
C2W[:3, :3] = np.array(
    [
        [1, 0, 0],
        [0, -math.sin(PITCH), math.cos(PITCH)],
        [0, -math.cos(PITCH), -math.sin(PITCH)],
    ]
)
C2W[:3, 3] = (0.0, -4.5, 1.8)
WEATHER = {
    "flood": {"level": "12 cm", "wind-speed": "1 m/s", "clarity": "2 m"},
    "smog": {"visibility": "30 m"},
    "snow": {"depth": "5 cm"},
}


@dataclasses.dataclass(frozen=True)
class Labelled(AnalyticField):
    """Boxes and ground with a class for each half of the scene."""

    capabilities: frozenset[str] = frozenset({DENSITY, CLASSES})

    def surface_heads(self, rays_o, rays_d, samples, selected):
        x = rays_o[:, 0][samples.ray_index()] + samples.t * rays_d[:, 0][samples.ray_index()]
        kind = (x[selected] > 0).long() + 1
        logits = torch.nn.functional.one_hot(kind, len(SOLID)).float()
        return torch.zeros(len(selected), 3), logits


def continued_ground():
    """Terrain at the height of the ground, which the field holds as far as x = 2.5 m."""
    x, y = np.meshgrid(np.arange(-9, 9.1, 0.25), np.arange(-9, 9.1, 0.25))
    seen, height = x < 2.5, (0.05 / 0.998749 * y).astype(np.float32)
    label = np.where(seen, TERRAIN, UNKNOWN).astype(np.uint8)
    error = np.full_like(height, 0.05)
    return Terrain((-9.0, -9.0), 0.25, height, error, label, seen, np.zeros_like(seen))


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    folder = tmp_path_factory.mktemp("layers")
    ground = HalfSpace((0.0, -0.05, 0.998749), 0.0)
    boxes = [ground, Box((-1.6, 0.5, -1.0), (-0.2, 2.0, 1.0))]
    inner = Labelled(boxes, box=((-9, -9, -3), (2.5, 9, 9)))
    field = CompletedField(inner, continued_ground())
    views = tuple(View(f"{i}.png", folder / f"{i}.png", 0, C2W) for i in range(3))
    scene = Scene(folder, "test", (CAMERA,), views)
    return RenderSession(field, scene, weather_from_table(WEATHER))


@pytest.fixture(scope="module", params=[1, 2, 3])
def frame(session, request):
    return session.frame(CAMERA, C2W, supersample=request.param, layers=tuple(layer_table()))


def test_the_scene_shows_something_in_every_layer(frame):
    assert frame.layers.keys() == layer_table().keys()
    for name, values in frame.layers.items():
        assert len(np.unique(values)) > 1, name
    depth = frame.layers["depth"]
    assert 0.1 < np.isinf(depth).mean() < 0.6 and not np.isnan(depth).any()
    assert np.isinf(depth[0]).all() and np.isfinite(depth[-1]).all(), "sky above, ground below"
    assert (frame.layers["water_depth"][np.isinf(depth)] == 0).all()
    assert (frame.layers["normal"][np.isinf(depth)] == 0).all()


def test_npz_holds_every_layer_exactly(frame, tmp_path):
    for name, values in saved(frame, tmp_path, "npz"):
        with np.load(tmp_path / name / "0000.npz") as arrays:
            assert arrays.files == [name] and arrays[name].dtype == np.float32
            assert np.array_equal(arrays[name], values), name


@pytest.mark.skipif(not importlib.util.find_spec("OpenEXR"), reason="needs OpenEXR (extra exr)")
def test_exr_holds_every_layer_exactly(frame, tmp_path):
    for name, values in saved(frame, tmp_path, "exr"):
        channels, attributes = read_exr(tmp_path / name / "0000.exr")
        planes = values[..., None] if values.ndim == 2 else values
        names = "Z" if name == "depth" else "XYZ" if name == "normal" else "Y"
        assert sorted(channels) == list(names)
        for index, channel in enumerate(names):
            assert np.array_equal(channels[channel], planes[..., index]), (name, channel)
        assert b"simulated" in attributes["comments"]


def test_png_holds_every_layer_within_half_a_step(frame, tmp_path):
    for name, values in saved(frame, tmp_path, "png"):
        layer = layer_table()[name]
        with Image.open(tmp_path / name / "0000.png") as picture:
            levels = np.asarray(picture).astype(np.float64)
        if name == "normal":
            back, step = levels / 255 * 2 - 1, 2 / 255
        else:
            back, step = levels * layer.png_step, layer.png_step
        top = step * (2**layer.png_bits - 1)
        known = np.isfinite(values) & (values <= top)
        assert known.mean() > 0.4
        assert np.abs(back - values)[known].max() <= step / 2 + 1e-6, name
        assert (levels[np.isinf(values)] == 0).all(), name
        assert (levels[np.isfinite(values) & (values > top)] == 2**layer.png_bits - 1).all()
        if name == "depth":
            assert ((levels > 0) == np.isfinite(values)).all()


def test_layers_of_supersampled_frames_are_those_of_the_ray_nearest_to_the_centre(session):
    fine = session.frame(CAMERA.resized(3 * W, 3 * H), C2W, layers=("normal", "label"))
    frame = session.frame(CAMERA, C2W, supersample=3, layers=("normal", "label"))
    for name in ("depth", "water_depth", "transmittance", "snow_thickness", "mask_snow", "label"):
        wanted, values = fine.layers[name][1::3, 1::3], frame.layers[name]
        assert np.array_equal(wanted, values), name


def saved(frame, folder: Path, kind):
    save_layers(folder, "0000", frame.layers, (kind,))
    return [(name, np.asarray(values, np.float32)) for name, values in frame.layers.items()]
