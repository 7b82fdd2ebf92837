"""Smog, flood, snow, layers and the session with other fields than hash grids.

The renderer depends on `field.protocol` only: an analytic field, and one of 42 Gaussians.
"""

import ast
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from support.analytic_fields import AnalyticField, Box, HalfSpace
from support.gaussian_field import plain_with_stones

import climatenerf
from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError
from climatenerf.field.compositing import composited
from climatenerf.render.frame import traced_rays
from climatenerf.render.session import RenderSession
from climatenerf.scene.scene import Scene, View
from climatenerf.weather.flood.parameters import Flood
from climatenerf.weather.light.parameters import Sun
from climatenerf.weather.smog.medium import sigma_from_visibility
from climatenerf.weather.smog.parameters import Smog
from climatenerf.weather.snow.parameters import Snow
from climatenerf.weather.weather import Weather

CAMERA = Camera(48, 27, 30.0, 30.0, 24.0, 13.5)
C2W = np.eye(4)
C2W[:3, :3] = np.array([[1, 0, 0], [0, -0.35, 0.9367], [0, -0.9367, -0.35]])
C2W[:3, 3] = (0.0, -4.5, 1.8)
EVERY = ("depth", "normal", "transmittance", "water_depth", "snow_thickness",
         "mask_water", "mask_snow", "mask_smog")  # fmt: skip


def analytic():
    box = ((-6.0, -6.0, -2.0), (6.0, 6.0, 4.0))
    return AnalyticField([HalfSpace(), Box((-1.0, 0.0, 0.0), (0.5, 1.0, 0.8))], box=box)


FIELDS = {"analytic": analytic, "gaussians": plain_with_stones}


def session(field, tmp_path, **sections):
    views = tuple(View(f"{i}.png", tmp_path / f"{i}.png", 0, C2W) for i in range(3))
    scene = Scene(tmp_path, "test", (CAMERA,), views)
    return RenderSession(field, scene, Weather(**sections))


@pytest.mark.parametrize("kind", FIELDS)
def test_all_weathers_and_layers_are_rendered_together(kind, tmp_path):
    weather = {
        "smog": Smog(visibility=60.0),
        "flood": Flood(level=0.05, wind_speed=0.0),
        "snow": Snow(depth=0.15),
        "sun": Sun(elevation=0.6, azimuth=1.0),
    }
    frame = session(FIELDS[kind](), tmp_path, **weather).frame(CAMERA, C2W, layers=EVERY)
    assert set(EVERY) <= frame.layers.keys() and frame.picture.shape == (27, 48, 3)
    assert all(np.isfinite(v).all() for name, v in frame.layers.items() if name != "depth")
    assert frame.layers["mask_water"].max() > 0.9, "the ground at z = 0 is flooded"
    assert frame.layers["mask_snow"].max() > 0.5, "surfaces above the water carry snow"
    assert 0 < frame.layers["mask_smog"].min() < frame.layers["mask_smog"].max() <= 1


@pytest.mark.slow
@pytest.mark.parametrize("kind", FIELDS)
def test_snow_on_the_ground_has_the_requested_depth(kind, tmp_path):
    frame = session(FIELDS[kind](), tmp_path, snow=Snow(depth=0.2)).frame(CAMERA, C2W)
    snowy = frame.layers["mask_snow"] > 0.9
    assert snowy.mean() > 0.3
    # Ground of Gaussians is blurred: its surface is where the transmittance is 1/2.
    assert np.median(frame.layers["snow_thickness"][snowy]) == pytest.approx(0.2, rel=0.2)


@pytest.mark.parametrize("kind", FIELDS)
def test_smog_equals_the_sum_over_samples(kind, tmp_path):
    """L = sum w_i (T_i c_i + (1 - T_i) c) + T_end (sky through endless smog = c)."""
    field = FIELDS[kind]()
    frame = session(field, tmp_path, smog=Smog(visibility=20.0, colour=(1.0, 1.0, 1.0))).frame(
        CAMERA, C2W
    )
    o, d, _ = traced_rays(CAMERA, C2W)
    near, far = torch.zeros(len(o)), torch.full((len(o),), 1e9)
    samples = field.march(o, d, near, far)
    expected = torch.empty(len(o), 3)
    sigma = sigma_from_visibility(20.0)
    for r in range(len(o)):
        part = slice(int(samples.offsets[r]), int(samples.offsets[r + 1]))
        tau = (samples.sigma * samples.dt)[part]
        before = torch.exp(-torch.cat([torch.zeros(1), tau.cumsum(0)]))
        weights = before[:-1] - before[1:]
        x = o[r] + samples.t[part, None] * d[r]
        ids = None if samples.ids is None else samples.ids[part]
        colour = field.colour(x, d[r].expand_as(x), ids=ids)
        passed = torch.exp(-sigma * samples.t[part])[:, None]
        lit = passed * colour + (1 - passed)
        expected[r] = (weights[:, None] * lit).sum(0) + before[-1]
    assert (frame.linear.reshape(-1, 3) - expected).abs().max() < 2e-3


def test_compositing_of_gaussians_equals_dense_sampling():
    """One sample per Gaussian against fine steps through the sum of their densities."""
    field = plain_with_stones()
    o, d, _ = traced_rays(CAMERA, C2W)
    _, transmittance, _ = composited(field, o, d, torch.zeros(len(o)))
    steps = torch.linspace(0, 20, 8001)
    for r in range(0, len(o), 97):
        sigma = field.density(o[r] + steps[:, None] * d[r])
        depth = float(torch.trapezoid(sigma, steps))
        if depth < 5:
            assert float(transmittance[r]) == pytest.approx(math.exp(-depth), abs=2e-3)


def test_flooding_a_field_without_density_is_refused(tmp_path):
    field = AnalyticField([HalfSpace()], capabilities=frozenset())
    with pytest.raises(UserError, match="'flood' needs a field with density") as error:
        session(field, tmp_path, flood=Flood(level=0.1))
    assert "Traceback" not in str(error.value) and "\n" not in str(error.value)
    assert session(field, tmp_path, smog=Smog(visibility=9.0)).world(0.0).media


def test_no_part_above_the_field_imports_the_hash_field():
    root = Path(climatenerf.__file__).parent
    for part in ("weather", "render", "output"):
        for path in (root / part).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.ImportFrom):
                    assert node.module != "climatenerf.field.hash_field", path
