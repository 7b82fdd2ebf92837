"""Contact shade: openness at a wall, and the closed form of a round hollow."""

import dataclasses

import numpy as np
import pytest
import torch
from support.analytic_fields import AnalyticField, Box, ground
from support.holed_ground import LabelledField

from climatenerf.core.classes import BUILDING, ROAD, VEGETATION
from climatenerf.core.samples import Samples
from climatenerf.field.analytic import HalfSpace
from climatenerf.field.capabilities import COMPLETES
from climatenerf.weather.snow.lattice import SnowGrid
from climatenerf.weather.snow.layer import bake_snow
from climatenerf.weather.snow.openness import (
    LEAFY,
    REFLECTED,
    SNOWY,
    contact_shade,
    openness_of,
)
from climatenerf.weather.snow.parameters import Snow

CAMERAS = np.array([[0.0, 0.0, 1.6]])
RADIUS = 0.5  # m, of the hollow


@dataclasses.dataclass(frozen=True)
class Hollow(AnalyticField):
    """Level ground at z = 0 with half a sphere taken out of it."""

    capabilities: frozenset[str] = frozenset({COMPLETES})

    def march(self, rays_o, rays_d, t_min, t_max, step_scale=1.0, stop=1e-4):
        along = -(rays_o * rays_d).sum(-1)
        inside = RADIUS**2 - (rays_o + along[:, None] * rays_d).square().sum(-1)
        leaves = along + inside.clamp_min(0).sqrt()  # the sphere, from a position in it
        z = rays_o[:, 2] + leaves * rays_d[:, 2]
        blocked = (rays_o[:, 2] < 0) & (z < 0) & (leaves < t_max)
        t = leaves[blocked] + 0.005
        offsets = torch.cat([torch.zeros(1, dtype=torch.long), blocked.long().cumsum(0)])
        return Samples(offsets, t, torch.full_like(t, 0.01), torch.full_like(t, 1e4))

    def ground_height(self, xy):
        return -(RADIUS**2 - xy.square().sum(-1)).clamp_min(0).sqrt()


@pytest.mark.parametrize(("top", "least", "most"), [(3.0, 0.85, 0.97), (0.6, 0.6, 0.8)])
def test_contact_shade_at_a_dark_wall(top, least, most):
    """Next to a wall half of the sky is hidden. The factor is what probes do not see of it.

    Probes stand higher than a low wall, and miss it; a tall one darkens them as well.
    """
    wall = Box((1.0, -8.0, -1.0), (1.2, 8.0, top), (0.05, 0.05, 0.05))
    field = AnalyticField([ground(), wall], box=((-8.0, -8.0, -1.0), (8.0, 8.0, 3.5)))
    x = np.array([[0.92, 0.0, 0.1], [0.7, 0.0, 0.1], [0.0, 0.0, 0.1], [-7.0, 0.0, 0.1]])
    openness, returned = openness_of(field, x.astype(np.float32))
    assert 0.4 < openness[0] < (0.65 if top > 1 else 0.7)  # above a low wall more sky is free
    assert np.all(np.diff(openness) >= 0)
    assert openness[3] == pytest.approx(1)
    assert returned == pytest.approx(REFLECTED * (1 - openness), abs=1e-6), "a wall is no ground"
    grid = SnowGrid((0.0, 0.0), (-1.0, 3.2), 0.06, 64)
    snow = bake_snow(field, Snow(depth=0.1), CAMERAS, np.ones(3), grid=grid)
    assert snow is not None
    near = snow.colour(torch.tensor([[0.85, y, 0.1] for y in (-0.5, 0.0, 0.5)]))
    far = snow.colour(torch.tensor([[-3.0, y, 0.1] for y in (-0.5, 0.0, 0.5)]))
    assert least < float(near.mean() / far.mean()) < most


def test_a_hedge_returns_less_light_than_a_wall():
    box = ((-8.0, -8.0, -1.0), (8.0, 8.0, 3.5))
    wall = Box((1.0, -8.0, -1.0), (1.2, 8.0, 3.0), (0.05, 0.05, 0.05))
    x = np.array([[0.8, 0.0, 0.1], [-7.0, 0.0, 0.1]], np.float32)
    found = {}
    for kind in (BUILDING, VEGETATION):
        field = LabelledField([HalfSpace(), wall], classes=[ROAD, kind], box=box)
        openness, found[kind] = openness_of(field, x)
        assert openness[0] < 0.7
    assert found[VEGETATION][0] / found[BUILDING][0] == pytest.approx(LEAFY / REFLECTED, rel=1e-3)
    assert found[VEGETATION][1] == 0


def test_a_hollow_of_the_ground_is_nearly_as_bright_as_the_open():
    """Half a sphere hides half of the sky everywhere: A/(1 - r (1 - A)) with A = 1/2, exactly."""
    field = Hollow([], box=((-4.0, -4.0, -1.0), (4.0, 4.0, 2.0)))
    bottom = np.array([[0.0, 0.0, 0.01 - RADIUS], [2.0, 0.0, 0.01]], np.float32)
    openness, returned = openness_of(field, bottom)
    assert openness == pytest.approx([0.5, 1.0], abs=0.05)
    assert returned == pytest.approx([SNOWY * 0.5, 0.0], abs=0.05)
    x, y = np.meshgrid(np.arange(-3, 3, 0.06), np.arange(-3, 3, 0.06))
    z = -np.sqrt(np.maximum(RADIUS**2 - x**2 - y**2, 0))
    raster = np.stack([x, y, z], -1).astype(np.float32)
    shade = contact_shade(field, raster, np.ones(x.shape, bool), 0.06, 0.01)
    deep = shade[z < -0.9 * RADIUS].mean()
    exact = 0.5 / (1 - SNOWY * 0.5)
    assert exact == pytest.approx(deep, abs=0.03), "plain occlusion would be 0.5"
    assert shade[np.hypot(x, y) > 2] == pytest.approx(1, abs=1e-3)
