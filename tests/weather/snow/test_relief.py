"""Fine relief of snow: its height, what a pixel filters out, and how the sun shows it."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from support.analytic_fields import AnalyticField, HalfSpace

from climatenerf.weather.snow.lattice import SnowGrid
from climatenerf.weather.snow.layer import bake_snow
from climatenerf.weather.snow.parameters import Snow
from climatenerf.weather.snow.relief import COVERED, slopes, tilted

HEIGHT = 0.004
DOWN = torch.tensor([0.0, 0.0, -1.0])


def test_the_relief_has_the_height_that_is_asked_for():
    """Slopes summed along a line are heights."""
    step = 0.005
    x = torch.zeros(40_000, 3, dtype=torch.float64)
    x[:, 0] = step * torch.arange(len(x))
    along = slopes(x, DOWN.double().expand_as(x), torch.zeros(len(x)).double(), HEIGHT)[:, 0]
    heights = torch.cumsum(along, 0) * step
    assert float(heights.std()) == pytest.approx(HEIGHT, rel=0.1)
    assert heights.abs().max() < 6 * HEIGHT, "no drift"


@pytest.mark.parametrize("incidence", [0, 60, 80])
def test_a_pixel_shows_the_mean_of_what_it_covers(incidence):
    """Mean of unfiltered slopes over the footprint, which is longer where the view is flat."""
    generator = torch.Generator().manual_seed(0)
    centre = 20 * torch.rand(400, 3, generator=generator)
    angle = math.radians(incidence)
    d = torch.tensor([0.0, math.sin(angle), -math.cos(angle)]).expand(400, 3)
    width = 0.03
    found = slopes(centre, d, torch.full((400,), width), HEIGHT)
    side = (torch.arange(21) + 0.5) / 21 - 0.5
    across, along = torch.meshgrid(side * width, side * width / math.cos(angle), indexing="ij")
    offset = torch.stack([across, along, torch.zeros_like(along)], -1).reshape(-1, 3)
    points = (centre[:, None] + offset).reshape(-1, 3)
    every = slopes(points, DOWN.expand_as(points), torch.zeros(len(points)), HEIGHT)
    mean = every.view(400, -1, 2).mean(1)
    assert float((found - mean).std()) < 0.12 * float(every.std())
    assert torch.corrcoef(torch.stack([found[:, 0], mean[:, 0]]))[0, 1] > 0.95


def test_no_place_is_special():
    """The waves do not meet in phase at the origin of the world."""
    near = torch.linspace(-0.4, 0.4, 41)
    x = torch.cartesian_prod(near, near, torch.zeros(1))
    found = slopes(x, DOWN.expand_as(x), torch.zeros(len(x)), HEIGHT)
    usual = slopes(x + 300.0, DOWN.expand_as(x), torch.zeros(len(x)), HEIGHT)
    assert found.norm(dim=-1).max() < 2.8 * usual.square().sum(-1).mean().sqrt()


def test_far_snow_is_smooth():
    x = 50 * torch.rand(1000, 3, generator=torch.Generator().manual_seed(1))
    flat = torch.nn.functional.normalize(torch.tensor([0.0, 1.0, -0.05]), dim=0).expand_as(x)
    near, far = (slopes(x, flat, torch.full((1000,), w), HEIGHT).std() for w in (0.002, 0.5))
    assert far < 0.02 * near


def test_thin_snow_has_less_of_it():
    normal = torch.tensor([[0.0, 0.0, 1.0]]).expand(3, 3)
    slope = torch.tensor([[0.3, 0.0]]).expand(3, 2)
    found = tilted(normal, slope, torch.tensor([0.0, COVERED / 2, 1.0]))
    torch.testing.assert_close(found.norm(dim=-1), torch.ones(3))
    torch.testing.assert_close(-found[:, 0] / found[:, 2], torch.tensor([0.0, 0.15, 0.3]))


@dataclasses.dataclass
class Lambertian:
    """A beam from a direction and even light besides."""

    sun: torch.Tensor
    beam_share: float

    def irradiance(self, x, normal, diffuse=None):
        facing = (normal @ self.sun).clamp_min(0) / float(self.sun[2])
        total = math.pi * (1 - self.beam_share + self.beam_share * facing)
        return total[:, None].expand(-1, 3)

    def beam(self):
        return None


@pytest.mark.parametrize("share", [0.0, 0.8])
def test_a_low_sun_shows_it_and_an_even_sky_does_not(share):
    field = AnalyticField([HalfSpace()], box=((-4.0, -4.0, -1.0), (4.0, 4.0, 2.0)))
    grid = SnowGrid((0.0, 0.0), (-1.0, 1.0), 0.05, 32)
    snow = bake_snow(field, Snow(depth=0.1), np.array([[0.0, 0.0, 1.6]]), np.ones(3), grid=grid)
    assert snow is not None
    place = Lambertian(torch.nn.functional.normalize(torch.tensor([1.0, 0.0, 0.4]), dim=0), share)
    lit = dataclasses.replace(snow, place_light=place)
    x = 2 * torch.rand(20_000, 3, generator=torch.Generator().manual_seed(0)) - 1
    x[:, 2] = 0.1
    d, width = DOWN.expand_as(x), torch.full((len(x),), 0.005)
    rough = lit.colour_towards(x, d, width)[:, 0]
    plain = lit.colour(x)[:, 0]
    assert float(rough.mean()) == pytest.approx(float(plain.mean()), rel=0.01)
    added = (rough / plain - 1).std()
    if share:
        assert 0.05 < added < 0.2
    else:
        assert added < 1e-5
    without = dataclasses.replace(lit, snow=dataclasses.replace(lit.snow, relief=0.0))
    assert torch.equal(without.colour_towards(x, d, width)[:, 0], plain)
