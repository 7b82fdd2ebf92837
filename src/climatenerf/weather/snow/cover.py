"""Where snow stays, and how much of it: slopes, crowns, eaves, lumps of a fitted field.

Rasters have one node for each fall ray of a pass; heights are world z, m, NaN where nothing is.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from scipy import ndimage

from climatenerf.weather.snow.parameters import Snow

WALL = math.cos(math.radians(75))  # cosine of the slope from which on snow only passes by
LEVEL, STEEPEST = math.radians(30), math.radians(60)  # slopes that keep all snow, and none
BANK, CLIFF = math.radians(50), math.radians(75)  # the same of natural ground
CROWN_HOLDS = 0.08  # m of snow that a crown can hold
CROWN_RETAINS = 0.678  # fraction of it that stays for hours (Hedstrom and Pomeroy 1998)
CUSHION = 0.1  # m, standard deviation of the smoothing of crowns
ONE_LAYER = 0.6  # m below the highest leaf nearby; deeper leaves carry no part of a cushion
CROWN_KEEPS, CROWN_SHEDS = 0.9, 2.0  # slopes (rise over run) of crowns that keep all and nothing
CLOSED = (0.15, 0.4)  # fraction covered by leaves at which a cushion begins, and is complete
FACE = (0.55, 0.85)  # of the leaves around, those of the highest layer: fewer lie at a steep face
HIGHEST_VEIL = 2.0  # m above the ground; what hangs higher may be a roof of a wrong class
EAVES = 0.1  # m, by which snow overhangs the lower edge of a roof
DRAWN_BACK = 0.15  # m from the edge of a fitted roof, within which it is rounded
ROOF = math.tan(math.radians(20)), math.tan(math.radians(60))  # slopes of roofs with eaves
MIN_DROP = 0.5  # m below the eaves of a roof, of what lies there
MAX_ROUNDING = 0.3  # m between a roof's plane and its rounded rim
WIDE = 1.0  # m, the least side of a roof
GAP = 5.0  # m from ground, up to which a gap in it is bridged


def slope_share(cosine: Float[np.ndarray, "*n"], snow: Snow) -> Float[np.ndarray, "*n"]:
    """Fraction of the depth that slopes keep, from the cosine of the slope.

    Of roofs and objects: all up to 30 degrees, none from 60 (EN 1991-1-3, 5.3); or the paper's
    logistic over its value on level ground, if `Snow.slope` says where half of it stays.
    """
    if snow.slope is None:
        slope = np.arccos(np.clip(cosine, 0, 1))
        return np.clip((STEEPEST - slope) / (STEEPEST - LEVEL), 0, 1)
    logit = snow.slope_sharpness * (cosine - math.cos(snow.slope))
    level = snow.slope_sharpness * (1 - math.cos(snow.slope))
    of_level = 1 + math.exp(-min(level, 60.0))  # level ground keeps all
    return np.minimum(of_level / (1 + np.exp(-np.clip(logit, -60, 60))), 1)


def ground_share(cosine: Float[np.ndarray, "*n"], snow: Snow) -> Float[np.ndarray, "*n"]:
    """Fraction of the depth that slopes of the ground keep; arguments as of `slope_share`.

    Grass and soil are rough: slopes of 45, 60 and 75 degrees hold 1.1, .45 and .15 m of snow
    (Bernhardt and Schulz 2010, SnowSlide). All stays up to 50 degrees and none from 75;
    `sliding.settled` thins deep snow further. Or by the paper's logistic, if `Snow.slope` is given.
    """
    if snow.slope is not None:
        return slope_share(cosine, snow)
    slope = np.arccos(np.clip(cosine, 0, 1))
    return np.clip((CLIFF - slope) / (CLIFF - BANK), 0, 1)


def held_by_crowns(depth: float) -> float:
    """Depth of snow (m) that stays in a closed crown when `depth` (m) falls on open ground.

    Interception saturates at what branches can hold (Hedstrom and Pomeroy 1998, equation 6).
    """
    return CROWN_RETAINS * CROWN_HOLDS * -math.expm1(-depth / CROWN_HOLDS)


class Cushions(NamedTuple):
    """Crowns as surfaces that snow can lie on."""

    height: Float[np.ndarray, "h w"]
    """Of the cushion's base, m; NaN without one."""
    keeps: Float[np.ndarray, "h w"]
    """Fraction of what a closed, level crown holds; 0 without a cushion."""


def cushions(crown: Float[np.ndarray, "h w"], spacing: float) -> Cushions:
    """Smooth the heights of leaves: snow bridges leaves and the gaps between them.

    Args:
        crown: height of the highest leaf, m; NaN without one.
        spacing: of the raster, m.
    """
    sigma = CUSHION / spacing
    leaf = np.isfinite(crown)
    lowest = -1e9  # below everything
    filled = np.where(leaf, crown, lowest)
    highest = ndimage.maximum_filter(filled, 2 * max(1, round(2 * sigma)) + 1)
    top = leaf & (filled > highest - ONE_LAYER)
    weight = ndimage.gaussian_filter(top.astype(np.float64), sigma)
    moment = ndimage.gaussian_filter(np.where(top, filled, 0.0).astype(np.float64), sigma)
    closed = np.clip((weight - CLOSED[0]) / (CLOSED[1] - CLOSED[0]), 0, 1)
    # Where no leaf is near there is no cushion; the floor avoids 0/0.
    height = np.where(closed > 0, moment / np.maximum(weight, 1e-6), np.nan)
    slope = np.hypot(*np.gradient(height, spacing))  # NaN at the rim
    keeps = (CROWN_SHEDS - slope) / (CROWN_SHEDS - CROWN_KEEPS)
    leaves = ndimage.gaussian_filter(leaf.astype(np.float64), sigma)
    upper = weight / np.maximum(leaves, 1e-6)  # without leaves 0/0
    level = np.clip((upper - FACE[0]) / (FACE[1] - FACE[0]), 0, 1)
    return Cushions(height, closed * level * np.clip(np.nan_to_num(keeps, nan=1.0), 0, 1))


class Eaves(NamedTuple):
    """The lower edges of roofs."""

    overhang: Float[np.ndarray, "h w"]
    """Heights at which roofs would go on beyond their edges, m; NaN elsewhere."""
    inside: Bool[np.ndarray, "h w"]
    """Nodes of roofs, but for their edges."""
    rim: Bool[np.ndarray, "h w"]
    """Nodes of roofs at their lower edges, which are rounded in a fitted field."""
    nearest: tuple[Int[np.ndarray, "h w"], Int[np.ndarray, "h w"]]
    """Rows and columns of the nearest node inside a roof."""


def eaves(
    height: Float[np.ndarray, "h w"], solid: Bool[np.ndarray, "h w"], spacing: float
) -> Eaves:
    """Continue roofs down their slopes, to their edges and beyond.

    Snow creeps over eaves and overhangs them (EN 1991-1-3, 6.3); and thin eaves of a fitted field
    end some decimetres before the true ones.

    Args:
        height: of the surface, m; NaN without one.
        solid: where it may belong to a roof.
        spacing: of the raster, m.
    """
    back = max(1, round(DRAWN_BACK / spacing))
    grid: Any = np.indices(height.shape)
    rows, columns = grid
    # Slopes over as many nodes, on roofs that have no edge there.
    slope = [np.full(height.shape, np.nan), np.full(height.shape, np.nan)]
    run = 2 * back * spacing
    slope[0][back:-back] = (height[2 * back :] - height[: -2 * back]) / run
    slope[1][:, back:-back] = (height[:, 2 * back :] - height[:, : -2 * back]) / run
    steepness = np.hypot(*slope)
    roof = solid & (steepness > ROOF[0]) & (steepness < ROOF[1])  # NaN compares False
    side = max(1, round(WIDE / spacing) - 2 * back)
    core: Any = ndimage.binary_opening(roof, np.ones((side, side), bool))
    # Without nodes whose slopes are measured over the rounded rim.
    core = ndimage.binary_erosion(core, np.ones((2 * back + 1, 2 * back + 1), bool))
    if not core.any():
        none = np.zeros(height.shape, bool)
        return Eaves(np.full(height.shape, np.nan), none, none, (rows, columns))
    found: Any = ndimage.distance_transform_edt(~core, return_indices=True)
    distance, nearest = found
    at = tuple(nearest)
    down, across = (rows - nearest[0]) * spacing, (columns - nearest[1]) * spacing
    fall = slope[0][at] * down + slope[1][at] * across
    continued = height[at] + fall
    # Along the slope; what lies beside a gable is no eaves.
    below = fall < -0.8 * steepness[at] * distance * spacing
    near = below & (distance > 0) & (distance < 2 * back + EAVES / spacing + 0.5)
    lower = ~(height > continued - MIN_DROP)  # NaN: nothing is there
    rim = near & solid & (np.abs(height - continued) < MAX_ROUNDING)
    return Eaves(np.where(near & lower, continued, np.nan), core, rim, at)


def mean_within(
    values: Float[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"], sigma: float
) -> Float[np.ndarray, "h w"]:
    """Gaussian means (`sigma` in nodes) over the nodes of a mask; 0 far from them."""
    weight = ndimage.gaussian_filter(mask.astype(np.float64), sigma)
    total = ndimage.gaussian_filter(np.where(mask, values, 0.0).astype(np.float64), sigma)
    return total / np.maximum(weight, 1e-6)  # far from the mask both are 0: 0/0


def bridged(
    surface: Float[np.ndarray, "h w"],
    on_ground: Bool[np.ndarray, "h w"],
    within: Bool[np.ndarray, "h w"],
    spacing: float,
) -> Float[np.ndarray, "h w"]:
    """Continue the ground over gaps in which neither field nor terrain holds anything.

    Photos show far ground at a grazing angle, and its field has gaps.

    Args:
        surface: heights, m; NaN in gaps.
        on_ground: where they belong to the ground.
        within: cells that may be filled.
        spacing: of the raster, m.
    """
    known = on_ground & np.isfinite(surface)
    if not known.any() or known.all():
        return surface
    found: Any = ndimage.distance_transform_edt(~known, return_indices=True)
    distance, nearest = found
    # Heights of the nearest ground, smoothed where they meet.
    height = np.where(known, surface, 0.0)[tuple(nearest)]
    smooth = ndimage.gaussian_filter(height, 0.5 / spacing)
    gap = np.isnan(surface) & within & (distance * spacing < GAP)
    return np.where(gap, smooth, surface)


def lumps(
    hits: Float32[np.ndarray, "h w"],
    on_ground: Bool[np.ndarray, "h w"],
    ground: Float[np.ndarray, "h w"],
    tolerance: float,
) -> Bool[np.ndarray, "h w"]:
    """Where matter of a ground class hangs above the ground, or the ground has a hole.

    A fitted field has veils and pits. Snow lies on the terrain there.

    Args:
        hits: height at which a fall ray ends, m; NaN without an end.
        on_ground: whether it ends on a class of the ground.
        ground: height of the terrain, m; NaN where it is unknown.
        tolerance: m.
    """
    hanging = on_ground & (hits > ground + tolerance) & (hits < ground + HIGHEST_VEIL)
    return hanging | (np.isnan(hits) & np.isfinite(ground)) | (hits < ground - tolerance)
