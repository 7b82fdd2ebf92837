"""Snow that wind moves: less where the ground is exposed, more in the lee of what stands there.

Exposure is the steepest slope towards the wind, Sx (Winstral, Elder and Davis 2002, equation 1):
positive in the lee of something higher, negative on a crest.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import ndimage

REACH = 25.0  # m upwind, as far as something shelters
NEAREST = 0.3  # m upwind; slopes over less are those of a fitted field's roughness
STEPS = 20  # heights along it
GAIN = 3.0  # depth over that of the open, per unit of slope
MAX_FACTOR = 2.5  # times the depth of the open, at the most
SMOOTH = 0.3  # m, standard deviation; drifts have no sharper edge


class Shelter(NamedTuple):
    """Height map of what shelters from the wind."""

    height: Float[np.ndarray, "y x"]
    """World z, m; NaN where nothing is. Rows lie along +y, columns along +x."""
    first: tuple[float, float]
    """x and y of the first node, m."""
    spacing: float
    """m."""


def upwind_slope(
    position: Float[np.ndarray, "h w 3"], shelter: Shelter, wind_direction: float
) -> Float[np.ndarray, "h w"]:
    """Steepest slope (rise over run) from each point to what stands within `REACH` upwind of it.

    Args:
        position: points on the surface, m; NaN where nothing is.
        shelter: what stands upwind, hedges included.
        wind_direction: where the wind comes from, clockwise from +y, rad.

    Returns:
        The slope; 0 where nothing is known upwind.
    """
    spacing = shelter.spacing
    upwind = np.array([math.sin(wind_direction), math.cos(wind_direction)])
    known = np.isfinite(shelter.height).astype(np.float64)
    filled = np.where(known > 0, shelter.height, -1e9)
    xy, height = position[..., :2].astype(np.float64), position[..., 2]
    steepest = np.full(height.shape, -np.inf)
    distances = np.geomspace(max(spacing, NEAREST), REACH, STEPS)
    for distance in distances:
        there = (xy + distance * upwind - np.array(shelter.first)) / spacing
        # Points that are NaN lie outside of every raster.
        at = np.nan_to_num(np.moveaxis(there[..., ::-1], -1, 0), nan=-1e6)
        # The highest within half a step, so that no thin wall lies between two of them.
        step = (distances[1] / distances[0] - 1) * distance / spacing
        highest = ndimage.maximum_filter(filled, max(1, round(step)))
        inside: np.ndarray = ndimage.map_coordinates(known, at, order=0)
        level: np.ndarray = ndimage.map_coordinates(highest, at, order=0)
        slope = np.where(inside > 0, (level - height) / distance, -np.inf)
        steepest = np.fmax(steepest, slope)
    return np.where(np.isfinite(steepest), steepest, 0.0)


def drifted(
    position: Float[np.ndarray, "h w 3"],
    shelter: Shelter,
    strength: float,
    wind_direction: float,
    spacing: float,
) -> Float[np.ndarray, "h w"]:
    """Depth of snow over that of open level ground, by shelter from the wind; 1 without wind.

    Args:
        position: points on the surface, m; NaN where nothing is.
        shelter: what stands in the wind.
        strength: `Snow.drift`, 0 to 1.
        wind_direction: where the wind comes from, clockwise from +y, rad.
        spacing: of the points, m.
    """
    slope = upwind_slope(position, shelter, wind_direction)
    factor = np.clip(1 + strength * GAIN * slope, 1 - strength, 1 + strength * (MAX_FACTOR - 1))
    return ndimage.gaussian_filter(factor, SMOOTH / spacing)
