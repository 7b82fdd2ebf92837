"""Flood water as a surface: how its body is lit."""

import math

import pytest
import torch

from climatenerf.field.analytic import AnalyticField, HalfSpace
from climatenerf.render.integrator import trace
from climatenerf.weather.flood import optics
from climatenerf.weather.flood.parameters import Flood
from climatenerf.weather.flood.surface import Water
from climatenerf.weather.flood.waves import at_time, make_waves
from climatenerf.weather.world import World


class HalfShaded:
    """A black sky and a hard sun that shines where x > 0."""

    def __init__(self, hard: bool):
        self.hard = hard

    def irradiance(self, x, normal, diffuse=None):
        return math.pi * (x[:, :1] > 0).float().expand(-1, 3)

    def open_irradiance(self):
        return torch.full((3,), math.pi)

    def reflected_sky(self, d, sky):
        return torch.zeros_like(sky)

    def sun_elevation(self):
        return None

    def beam(self):
        return (torch.tensor([0.0, 0.0, 1.0]), self.open_irradiance()) if self.hard else None


def mud_across_the_edge(hard: bool, clarity: float) -> torch.Tensor:
    """Radiance of windless, deep, muddy water, seen from straight above, along x."""
    flood = Flood(level=1.0, wind_speed=0.0, clarity=clarity, colour=(1.0, 1.0, 1.0))
    light = HalfShaded(hard)
    water = Water(flood, 1.0, at_time(make_waves(flood, 0), 0.0), light.open_irradiance())
    ground = AnalyticField([HalfSpace(colour=(0.0,) * 3)], zenith=(0.0,) * 3, horizon=(0.0,) * 3)
    x = torch.linspace(-0.6, 0.6, 241)
    o = torch.stack([x, torch.zeros_like(x), torch.full_like(x, 2.0)], dim=-1)
    d = torch.tensor([[0.0, 0.0, -1.0]]).expand(len(x), 3).contiguous()
    world = World(ground, surfaces=(water,), light=light)  # pyright: ignore[reportArgumentType]
    return trace(world, o, d, torch.full((len(x),), 1e-3)).rgb[:, 1]


@pytest.mark.parametrize("clarity", [0.05, 0.3])
def test_mud_softens_the_edge_of_a_hard_shadow_over_its_attenuation_length(clarity):
    seen = mud_across_the_edge(True, clarity)
    reach = 1 / optics.attenuation(Flood(clarity=clarity))[1]
    x = torch.linspace(-0.6, 0.6, 241)
    full = float(seen[-1])
    assert full == pytest.approx(1 - 0.0204, abs=5e-3)
    assert float(seen[0]) < 1e-3
    assert (seen.diff() > -1e-5).all()
    partial = x[(seen > 0.05 * full) & (seen < 0.95 * full)].abs()
    assert 0.6 * reach < partial.max() < reach
    assert float(seen[120]) == pytest.approx(full / 2, abs=0.1)


def test_only_a_hard_sun_costs_more_than_one_look_at_the_light():
    seen = mud_across_the_edge(False, 0.3)
    assert set((seen > 0.5).tolist()) == {False, True}
    assert ((seen < 1e-3) | (seen > 0.97)).all()


def test_mud_does_not_jump_when_the_eye_goes_under_in_the_shade():
    """Its light is that of the place on both sides of the surface."""
    flood = Flood(level=1.0, wind_speed=0.0, clarity=0.05, colour=(1.0, 1.0, 1.0))
    light = HalfShaded(True)
    water = Water(flood, 1.0, at_time(make_waves(flood, 0), 0.0), light.open_irradiance())
    ground = AnalyticField([HalfSpace(colour=(0.0,) * 3)], zenith=(0.0,) * 3, horizon=(0.0,) * 3)
    world = World(ground, surfaces=(water,), light=light)  # pyright: ignore[reportArgumentType]
    d, angle = torch.tensor([[0.0, 0.0, -1.0]]), torch.full((1,), 1e-3)
    for x, bright in ((-3.0, 0.0), (3.0, 1.0)):
        above, below = (trace(world, torch.tensor([[x, 0.0, 1.0 + h]]), d, angle).rgb[0, 1]
                        for h in (0.01, -0.01))  # fmt: skip
        assert float(above) == pytest.approx(bright * (1 - 0.0204), abs=0.01)
        assert float(below) == pytest.approx(bright, abs=0.01)


def test_clear_water_is_dark_and_blue_green_and_mud_is_brown():
    mud, lake, sea = (optics.deep_colour(Flood(clarity=c)) for c in (0.3, 6.0, 100.0))
    assert mud[0] > mud[1] > mud[2]
    assert lake == sea and lake[2] > lake[1] > lake[0] and max(lake) < min(mud)
    between = optics.deep_colour(Flood(clarity=1.3))
    assert all(min(a, b) < c < max(a, b) for a, b, c in zip(mud, lake, between, strict=True))
    assert optics.deep_colour(Flood(colour=(1.0, 0.0, 0.0))) == (1.0, 0.0, 0.0)
    pure = Flood(attenuation=(0.3, 0.06, 0.01))
    assert optics.deep_colour(pure) == lake, "the default clarity says nothing about it"
    muddy = optics.deep_colour(Flood(attenuation=optics.attenuation(Flood(clarity=0.3))))
    assert muddy == pytest.approx(mud, rel=0.05)
    assert optics.deep_colour(Flood(attenuation=(0.0, 0.0, 0.0))) == lake


class Hump:
    """A mound of water h = .3 exp(-r^2 / 2), m, over the level."""

    still = False

    def crest(self):
        return 0.3

    def crest_of(self, footprint):
        return torch.full_like(footprint, 0.3)

    def at(self, x, footprint):
        h = 0.3 * torch.exp(-x.square().sum(-1) / 2)
        return h, -h[:, None] * x, torch.zeros_like(h)


def test_any_water_surface_covers_the_ground_that_it_rises_over():
    """A mound over a level 10 cm below level ground: a disc of water, its radius in closed form."""
    flood = Flood(level=-0.1, wind_speed=0.0)
    water = Water(flood, -0.1, Hump(), torch.full((3,), math.pi))
    x = torch.linspace(-3, 3, 601)
    o = torch.stack([x, torch.zeros_like(x), torch.full_like(x, 2.0)], dim=-1)
    d = torch.tensor([[0.0, 0.0, -1.0]]).expand(len(x), 3).contiguous()
    ground = AnalyticField([HalfSpace(colour=(0.2,) * 3)])
    seen = trace(World(ground, surfaces=(water,)), o, d, torch.full((len(x),), 1e-3))
    radius = math.sqrt(2 * math.log(3))  # .3 exp(-r^2 / 2) = .1
    wet = seen.layers["mask_water"] > 0.5
    assert wet.any() and float(x[wet].abs().max()) == pytest.approx(radius, abs=0.02)
    assert wet[x.abs() < radius - 0.02].all()
    assert float(seen.depth[300]) == pytest.approx(1.8, abs=0.02), "the eye meets its top"
