"""Snow that wind moves: less where the ground is exposed, more in the lee of what stands there.

Exposure is the steepest slope towards the wind, Sx (Winstral, Elder and Davis 2002, equation 1):
positive in the lee of something higher, negative on a crest.
"""

import math

import numpy as np
from jaxtyping import Float
from scipy import ndimage

REACH = 25.0  # m upwind, as far as something shelters
NEAREST = 0.3  # m upwind; slopes over less are those of a fitted field's roughness
STEPS = 20  # heights along it
GAIN = 3.0  # depth over that of the open, per unit of slope
MOST = 2.5  # times the depth of the open, at the most
SMOOTH = 0.3  # m, standard deviation; drifts have no sharper edge


def upwind_slope(
    height: Float[np.ndarray, "h w"],
    shelter: Float[np.ndarray, "h w"],
    wind_direction: float,
    spacing: float,
) -> Float[np.ndarray, "h w"]:
    """Steepest slope (rise over run) from each node to what stands within `REACH` upwind of it.

    Args:
        height: of the surface, m; NaN where nothing is. Rows lie along +y, columns along +x.
        shelter: height of what stands there, hedges included, m; NaN where nothing is.
        wind_direction: where the wind comes from, clockwise from +y, rad.
        spacing: of the raster, m.

    Returns:
        The slope; 0 where nothing is known upwind.
    """
    rows, columns = height.shape
    upwind = np.array([math.cos(wind_direction), math.sin(wind_direction)]) / spacing
    known = np.isfinite(shelter).astype(np.float64)
    filled, at = np.where(known > 0, shelter, -1e9), np.mgrid[:rows, :columns]
    steepest = np.full(height.shape, -np.inf)
    distances = np.geomspace(max(spacing, NEAREST), REACH, STEPS)
    for distance in distances:
        there = at + (distance * upwind)[:, None, None]
        # The highest within half a step, so that no thin wall lies between two of them.
        step = (distances[1] / distances[0] - 1) * distance / spacing
        highest = ndimage.maximum_filter(filled, max(1, round(step)))
        inside: np.ndarray = ndimage.map_coordinates(known, there, order=0)
        level: np.ndarray = ndimage.map_coordinates(highest, there, order=0)
        slope = np.where(inside > 0, (level - height) / distance, -np.inf)
        steepest = np.fmax(steepest, slope)
    return np.where(np.isfinite(steepest), steepest, 0.0)


def drifted(
    height: Float[np.ndarray, "h w"],
    shelter: Float[np.ndarray, "h w"],
    strength: float,
    wind_direction: float,
    spacing: float,
) -> Float[np.ndarray, "h w"]:
    """Depth of snow over that of open level ground, by shelter from the wind; 1 without wind.

    Args:
        height: of the surface, m; NaN where nothing is.
        shelter: height of what stands there, m; NaN where nothing is.
        strength: `Snow.drift`, 0 to 1.
        wind_direction: where the wind comes from, clockwise from +y, rad.
        spacing: of the raster, m.
    """
    if strength == 0:
        return np.ones(height.shape)
    slope = upwind_slope(height, shelter, wind_direction, spacing)
    factor = np.clip(1 + strength * GAIN * slope, 1 - strength, 1 + strength * (MOST - 1))
    return ndimage.gaussian_filter(factor, SMOOTH / spacing)
