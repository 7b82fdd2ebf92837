"""Sparkle of snow: its mean is that of a mirror in pieces, and it stays where it is."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from support.analytic_fields import AnalyticField, HalfSpace

from climatenerf.weather.snow.lattice import SnowGrid
from climatenerf.weather.snow.layer import bake_snow
from climatenerf.weather.snow.parameters import Snow
from climatenerf.weather.snow.sparkle import MIRRORED, SUN_SOLID_ANGLE, TILTS, WIDEST, glints

SUN = torch.tensor([0.6, 0.0, 0.8])


def looks(count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions on 20 m of level ground and downward directions to them."""
    generator = torch.Generator().manual_seed(seed)
    x = 20 * torch.rand(count, 3, generator=generator) * torch.tensor([1.0, 1.0, 0.0])
    d = torch.randn(count, 3, generator=generator)
    d[:, 2] = -d[:, 2].abs() - 0.2
    return x, torch.nn.functional.normalize(d, dim=-1)


@pytest.mark.parametrize("width", [5e-4, 8e-4, 1e-3, 0.02, 0.06, 0.2])
def test_the_mean_is_that_of_a_mirror_in_randomly_tilted_pieces(width: float):
    """Of all faces the fraction TILTS / 2 pi mirrors the disc, whose radiance is 1 / its angle."""
    # Few pieces are as small as a face; many more faces than fit on the snow show their mean.
    faces = 0.5 if width > 0.01 else 100.0
    x, d = looks(4_000_000, 0)
    found = glints(x, d, torch.full((len(x),), width), SUN, faces)
    mean = faces * TILTS / (2 * math.pi) * MIRRORED / SUN_SOLID_ANGLE
    assert float(found.mean()) == pytest.approx(mean, rel=0.1)
    assert float((found > 0).float().mean()) < 0.2, "points, no sheen"


def test_a_pixel_that_sees_less_sees_fewer_and_brighter_sparkles():
    x, d = looks(4_000_000, 1)
    near, far = (glints(x, d, torch.full((len(x),), w), SUN, 1.0) for w in (0.01, 0.08))
    assert 0 < (near > 0).sum() < (far > 0).sum() / 30
    assert near.max() > 30 * far.max()


def test_sparkles_stay_while_eye_and_sun_do_and_change_with_them():
    x, d = looks(1_000_000, 2)
    width = torch.full((len(x),), 0.06)
    first = glints(x, d, width, SUN, 1.0)
    assert torch.equal(first, glints(x, d, width, SUN, 1.0))
    turned = torch.nn.functional.normalize(SUN + torch.tensor([0.0, 0.05, 0.0]), dim=-1)
    both = (first > 0) & (glints(x, d, width, turned, 1.0) > 0)
    assert both.sum() < 0.05 * (first > 0).sum()


def test_none_without_faces_and_none_far_away():
    x, d = looks(1_000_000, 3)
    assert not glints(x, d, torch.full((len(x),), 0.06), SUN, 0.0).any()
    assert not glints(x, d, torch.full((len(x),), 2 * WIDEST), SUN, 1.0).any()
    against = glints(x[:1], SUN[None], torch.full((1,), 0.01), SUN, 1.0)
    assert torch.isfinite(against).all(), "an eye that looks into the sun"


@dataclasses.dataclass
class SunlitPlace:
    """A sun that half of the place sees."""

    def beam(self):
        return SUN, torch.tensor([3.0, 2.0, 1.0])

    def visibility(self, x, normal):
        return (x[:, 0] > 0).float()


def test_snow_sparkles_in_the_sun_and_not_in_shadow():
    field = AnalyticField([HalfSpace()], box=((-4.0, -4.0, -1.0), (4.0, 4.0, 2.0)))
    grid = SnowGrid((0.0, 0.0), (-1.0, 1.0), 0.05, 32)
    snow = bake_snow(field, Snow(depth=0.1), np.array([[0.0, 0.0, 1.6]]), np.ones(3), grid=grid)
    assert snow is not None
    generator = torch.Generator().manual_seed(0)
    x = 2 * torch.rand(200_000, 3, generator=generator) - 1
    x[:, 2] = 0.1
    _, d = looks(len(x), 4)
    width = torch.full((len(x),), 0.06)
    assert not snow.glints(x, d, width).any(), "no light of the place, no sun"
    lit = dataclasses.replace(snow, place_light=SunlitPlace())
    found = lit.glints(x, d, width)
    assert not found[x[:, 0] <= 0].any()
    expected = glints(x, d, width, SUN, snow.snow.sparkle)[:, None] * torch.tensor([3.0, 2.0, 1.0])
    sunny = x[:, 0] > 0
    assert expected[sunny].any()
    torch.testing.assert_close(found[sunny], expected[sunny])
    dull = dataclasses.replace(lit, snow=Snow(depth=0.1, sparkle=0.0))
    assert not dull.glints(x, d, width).any()
    paper = dataclasses.replace(lit, snow=Snow(depth=0.1, light="paper"))
    assert not paper.glints(x, d, width).any(), "the paper's snow does not sparkle"
