"""Reflectance of snow against published figures and limits."""

import numpy as np
import pytest
import torch

from climatenerf.weather.snow.optics import (
    ICE_DENSITY,
    albedo_of,
    deep_reflectance,
    density,
    over_ground,
    slab_reflectance,
    specific_surface,
)
from climatenerf.weather.snow.parameters import Snow


def radius(surface: float) -> float:
    """Optical radius (m) of grains with a specific surface in m2/kg."""
    return 3 / (ICE_DENSITY * surface)


@pytest.mark.parametrize(
    ("surface", "soot", "expected"),
    [
        (60.0, 0.0, (0.983, 0.989, 0.994)),
        (20.0, 0.0, (0.971, 0.981, 0.989)),
        (3.0, 0.0, (0.927, 0.952, 0.972)),
        (60.0, 1e-7, (0.969, 0.970, 0.969)),
    ],
)
def test_deep_snow_by_grain_and_soot(surface, soot, expected):
    """Picard et al. (2016) and Kokhanovsky and Zege (2004); red, green, blue."""
    assert deep_reflectance(radius(surface), soot) == pytest.approx(expected, abs=0.002)
    assert specific_surface(radius(surface)) == pytest.approx(surface)


@pytest.mark.parametrize(
    ("water", "expected"), [(0.5, 0.52), (1.0, 0.67), (2.0, 0.80), (5.0, 0.91), (10.0, 0.95)]
)
def test_a_slab_over_dark_ground_by_its_water(water, expected):
    """Grains of 33 m2/kg over ground of .12; water in mm, of snow of 100 kg/m3."""
    slab = slab_reflectance(torch.tensor([[water / 100]]), radius(33.0))
    found = over_ground(slab, torch.ones(3), torch.full((1, 3), 0.12))
    assert found.numpy() == pytest.approx(np.full((1, 3), expected), abs=0.012)


def test_limits_of_the_slab():
    deep = torch.tensor([0.9, 0.92, 0.94])
    ground = torch.tensor([[0.1, 0.5, 0.94], [0.0, 0.0, 0.0]])
    none = over_ground(torch.zeros(2, 1), deep, ground)
    assert torch.equal(none, ground)
    thick = over_ground(slab_reflectance(torch.full((2, 1), 5.0), 1e-4), deep, ground)
    assert torch.allclose(thick, deep.expand(2, 3), atol=1e-3)
    assert slab_reflectance(torch.tensor([-1.0]), 1e-4) == 0
    rising = slab_reflectance(torch.linspace(0, 0.3, 200), 1e-4)
    assert bool((rising.diff() > 0).all())
    assert float(rising[-1]) < 1


def test_a_given_albedo_replaces_grain_and_soot():
    assert albedo_of(Snow(albedo=0.5)).tolist() == [0.5] * 3
    dirty, clean = albedo_of(Snow(soot=1000.0)), albedo_of(Snow(soot=0.0))
    assert np.all(dirty < clean)
    assert 0.9 < albedo_of(Snow()).min() < albedo_of(Snow()).max() < 0.95


def test_coarse_snow_has_settled():
    """Fresh snow 100, wet snow with grains of a millimetre 300 to 400, never over 500 kg/m3."""
    assert density(1e-4) == pytest.approx(100)
    assert 300 < density(1e-3) < 400
    assert (density(1e-5), density(2e-3)) == (50, 500)
    # So 15 cm of it hide the ground better than as much ice as fresh snow has.
    through = 1 - float(slab_reflectance(torch.tensor(0.15), 1e-3))
    as_fresh = 1 - float(slab_reflectance(torch.tensor(0.15 * 100 / density(1e-3)), 1e-3))
    assert through < 0.4 * as_fresh
