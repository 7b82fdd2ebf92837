"""Heuristic labels of what stands on the ground: vegetation by colour and texture, and the rest.

Leaves are green and rough at the scale of a few pixels: the excess green index of the chromaticity
(Woebbecke et al. 1995) is positive for most pixels of a neighbourhood, whose brightness varies.
Paint is green and smooth, moss and lichen make small spots. What is not green but grows from sparse
points above the ground, as walls, stones, trunks and cars do, is labelled building, because the
class says no more to weather than that it is solid. Autumn leaves and bare crowns are missed. A
lawn may be labelled vegetation; its height tells weather that it is no crown.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.spatial import KDTree

from climatenerf.core.morphology import geodesic_distance

_GREEN = 0.06  # excess green index of leaves, of a chromaticity that sums to 1
_SOLID = 0.02  # largest index, averaged over the window, of what cannot be leaves
_NOT_TEAL = 0.04  # least difference of green and blue, which painted doors and cars lack
_NOT_BROWN = -0.045  # least difference of green and red
_DARKEST = 0.03  # mean display value below which a colour is noise
_SHARE = 0.5  # of green pixels in the window
_ROUGHNESS = 0.08  # standard deviation of brightness in the window, of its mean
_WINDOW = 0.006  # half side of the window, of the photo's longer side
_MIN_AREA = 0.002  # of the photo, of a region of leaves

_HEIGHT = 0.25  # least height of a standing point above the ground near it, camera heights
_STEEPNESS = 1.2  # least height over the distance from that ground: banks are ground
_GROWTH = 0.08  # of the photo's longer side, that the label grows from a point
_EDGE_LENGTH = 10.0  # extra length of a step, times its colour change, display values in [0,1]
_MAX_PART = 0.4  # of the way to a point that does not stand


def segment_vegetation(values: Float[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
    """Return where a photo shows leaves or grass; display values in [0,1]."""
    mean = values.mean(-1)
    red, green, blue = _chromaticity(values)
    leafy = (3 * green - 1 > _GREEN) & (green - blue > _NOT_TEAL) & (green - red > _NOT_BROWN)
    leafy &= mean > _DARKEST
    size = _window(values)
    local = ndimage.uniform_filter(mean, size)
    # The difference of two large numbers may be slightly negative.
    variance = np.maximum(ndimage.uniform_filter(mean * mean, size) - local * local, 0)
    rough = np.sqrt(variance) > _ROUGHNESS * local
    leaves = (ndimage.uniform_filter(leafy.astype(np.float32), size) > _SHARE) & rough
    leaves |= leafy & ndimage.binary_closing(leaves, iterations=2)
    region = np.zeros(leaves.shape, np.int32)
    count = int(ndimage.label(leaves, output=region))  # pyright: ignore[reportArgumentType]
    area = np.bincount(region.ravel(), minlength=count + 1)
    large = area >= _MIN_AREA * leaves.size
    large[0] = False
    return large[region]


def _chromaticity(values: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "3 h w"]:
    # 1e-3: black pixels have no chromaticity.
    return np.moveaxis(values / (values.sum(-1, keepdims=True) + 1e-3), -1, 0)


def _window(values: Float[np.ndarray, "h w 3"]) -> int:
    return 2 * max(2, round(_WINDOW * max(values.shape))) + 1


def standing_points(
    points: Float[np.ndarray, "n 3"], is_ground: Bool[np.ndarray, " n"], camera_height: float
) -> Bool[np.ndarray, " n"]:
    """Return which sparse points certainly lie above the ground, world metres with z up."""
    stands = np.zeros(len(points), bool)
    rest = np.flatnonzero(~is_ground & np.isfinite(points).all(-1))
    if not is_ground.any() or not len(rest):
        return stands
    ground = points[is_ground]
    distance, nearest = KDTree(ground[:, :2]).query(points[rest, :2])
    height = points[rest, 2] - ground[nearest, 2]
    stands[rest] = height > np.maximum(_HEIGHT * camera_height, _STEEPNESS * distance)
    return stands


def segment_standing(
    values: Float[np.ndarray, "h w 3"],
    standing: Int[np.ndarray, "n 2"],
    others: Int[np.ndarray, "m 2"],
) -> Bool[np.ndarray, "h w"]:
    """Return where a photo shows what its standing points belong to, leaves or not.

    Args:
        values: The photo, display values in [0,1].
        standing: Pixels (x, y) of sparse points that stand.
        others: Pixels of the other points that the photo shows.
    """
    if not len(standing):
        return np.zeros(values.shape[:2], bool)
    step = 1 / (_GROWTH * max(values.shape))
    costs = [
        step * (1 + _EDGE_LENGTH * np.abs(np.diff(values, axis=axis)).max(axis=-1))
        for axis in (0, 1)
    ]
    to_standing = geodesic_distance(standing, costs)
    to_other = geodesic_distance(others, costs)
    return (to_standing < 1) & (to_standing < _MAX_PART / (1 - _MAX_PART) * to_other)


def is_solid(values: Float[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
    """Return where a photo shows nothing that could be leaves, display values in [0,1]."""
    green = _chromaticity(values)[1]
    return ndimage.uniform_filter(3 * green - 1, _window(values)) < _SOLID
