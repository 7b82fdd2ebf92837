"""Drifts: depth by the shelter from the wind."""

import math

import numpy as np
import pytest
import torch
from support.analytic_fields import AnalyticField, Box, ground

from climatenerf.weather.snow.drift import Shelter, drifted, upwind_slope
from climatenerf.weather.snow.lattice import SnowGrid
from climatenerf.weather.snow.layer import bake_snow
from climatenerf.weather.snow.parameters import Snow

H = 0.2  # m, spacing
NORTH, EAST = 0.0, math.pi / 2


def raster(height):
    """Points of a raster, and what stands on it."""
    y, x = np.indices(height.shape) * H
    return np.stack([x, y, height], -1), Shelter(height, (0.0, 0.0), H)


def fence():
    """Ground with a wall of 1.5 m along y, at x = 0 of a raster of 40 m."""
    height = np.zeros((200, 200))
    height[:, 99:101] = 1.5
    return height


def test_level_ground_keeps_its_depth_whatever_the_wind():
    level = np.full((60, 60), 3.0)
    level[:10, :10] = np.nan
    for wind in (NORTH, EAST, 4.0):
        assert drifted(*raster(level), 1.0, wind, H) == pytest.approx(1)
    assert np.array_equal(drifted(*raster(fence()), 0.0, EAST, H), np.ones((200, 200)))


def test_the_steepest_slope_upwind_is_that_to_the_top_of_a_wall():
    slope = upwind_slope(*raster(fence()), EAST)
    for metres in (2, 5, 10):  # west of the wall, in its lee
        column = 99 - round(metres / H)
        assert slope[100, column] == pytest.approx(1.5 / metres, rel=0.2)
    assert slope[100, 120:180] == pytest.approx(0), "towards the wind nothing stands"
    turned = upwind_slope(*raster(fence()), EAST + 2 * math.pi)
    assert turned[10:-10] == pytest.approx(slope[10:-10])
    along = upwind_slope(*raster(fence()), NORTH)
    assert along[100:150, :80] == pytest.approx(0)


def test_snow_lies_deeper_in_the_lee_and_thinner_towards_the_wind():
    factor = drifted(*raster(fence()), 1.0, EAST, H)
    assert factor[100, 85:95].mean() > 1.5 and factor.max() <= 2.5
    assert factor[100, 106:180] == pytest.approx(1, abs=0.02)
    y = np.mgrid[:200, :200][1] * H
    ridge = 4 - 0.4 * np.abs(y - 20)
    factor = drifted(*raster(ridge), 1.0, EAST, H)
    assert factor[100, 20:80].mean() > 1.5 > 0.5 > factor[100, 120:180].mean()
    dome = 4 - 0.05 * (y - 20) ** 2
    assert drifted(*raster(dome), 1.0, EAST, H)[100, 100] < 0.99, "no more than the open"


def test_drifts_through_the_renderers_snow():
    wall = Box((-0.1, -8.0, 0.0), (0.1, 8.0, 1.0), (0.3, 0.3, 0.3))
    field = AnalyticField([ground(), wall], box=((-8.0, -8.0, -1.0), (8.0, 8.0, 3.0)))
    grid = SnowGrid((0.0, 0.0), (-1.0, 3.2), 0.06, 64)
    snow = Snow(depth=0.1, drift=0.5, wind_direction=EAST)
    baked = bake_snow(field, snow, np.array([[0.0, 0.0, 1.6]]), np.ones(3), grid=grid)
    assert baked is not None

    def depth_at(x):
        z = torch.linspace(-0.1, 0.6, 1401)
        points = torch.stack([torch.full_like(z, x), torch.zeros_like(z), z], -1)
        return float(z[baked.density(points) > 1].max())

    assert depth_at(-1.5) > 0.14, "in the lee"
    assert depth_at(2.0) == pytest.approx(0.1, rel=0.1)


def test_drifts_go_on_beyond_the_finest_cascade():
    """A wall outside it shelters the ground inside."""
    wall = Box((0.0, -8.0, -1.0), (0.2, 8.0, 1.0), (0.3, 0.3, 0.3))
    field = AnalyticField([ground(), wall], box=((-8.0, -8.0, -1.0), (8.0, 8.0, 3.0)))
    snow = Snow(depth=0.1, drift=0.5, wind_direction=EAST)
    eye = np.array([[-2.0, 0.0, 1.6]])
    factors = []
    for grid in (
        SnowGrid((-2.0, 0.0), (-1.0, 2.0), 0.06, 48),
        SnowGrid((-2.2, 0.0), (-1.0, 2.0), 0.06, 32, 2),
    ):
        baked = bake_snow(field, snow, eye, np.ones(3), grid=grid)
        assert baked is not None
        catch = baked.deposits.cascades[0][0]
        near = catch.weight > 0
        x, y = catch.position[near][:, :2].T
        bins = [
            (np.abs(x + metres) < 0.15) & (np.abs(y) < 1) for metres in (0.8, 1.5, 2.0, 3.0, 4.0)
        ]
        factors.append([catch.of_fall[near][each].mean() for each in bins])
    assert factors[1] == pytest.approx(factors[0], abs=0.06)
    assert factors[1][1] > 1.5
