"""Sweep of heights for patches of ground: at which height do the photos that show one agree? CPU.

A patch is a square of samples on the ground, level across and tilted along the ground's slope. It
is projected into all photos that show it (Collins 1996, "A Space-Sweep Approach to True Multi-Image
Matching"), so its samples meet the same points at any viewing angle, where upright windows on
grazing ground do not. Many photos are averaged, so little texture suffices.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8
from numba import njit, prange

SAMPLES = 9  # along a side of a patch
HALF = SAMPLES // 2
RAMP = SAMPLES * float(sum((m - HALF) ** 2 for m in range(SAMPLES)))  # squared length of a ramp
VIEWS = 8  # that a patch is compared in, at most: those that show it largest
MIN_VIEWS = 2
LEVELS = 4  # of the pictures' pyramid
MIN_SLOPE = 0.06  # of a ray; flatter ones smear the patch
MIN_CONTRAST = 0.5  # standard deviation of a patch, 8-bit levels
UNSEEN = 0  # level of an invalid pixel
SEPARATION = 3  # steps from the best height from which a height counts as different
NONE = -2.0  # an invalid agreement
_FAST = {"contract", "reassoc", "arcp", "nsz"}


class GroundPictures(NamedTuple):
    """Grey pinhole pictures with pyramids, in one flat array (Numba accepts named tuples)."""

    grey: UInt8[np.ndarray, "total"]
    """Levels from 1 to 255, or `UNSEEN`."""
    start: Int[np.ndarray, "v levels"]
    """Offset of each level in `grey`."""
    ground: Bool[np.ndarray, "pixels"]
    """Whether a pixel of the full size is labelled ground."""
    ground_start: Int[np.ndarray, "v"]
    """Offset of each picture in `ground`."""
    size: Int[np.ndarray, "v levels 2"]
    """Width and height of each level, px."""
    intrinsics: Float[np.ndarray, "v 4"]
    """fx, fy, cx, cy at full size, px."""
    rotation: Float[np.ndarray, "v 3 3"]
    """From world axes to camera axes."""
    centre: Float[np.ndarray, "v 3"]
    """Camera centres, world m."""


@njit(cache=True, parallel=True, fastmath=_FAST)
def sweep_heights(
    pictures: GroundPictures,
    x: Float[np.ndarray, "n 3"],
    slope: Float[np.ndarray, "n 2"],
    half_side: float,
    half_range: Float[np.ndarray, "n"],
    steps: int,
) -> Float32[np.ndarray, "n 4"]:
    """Return the height at which the photos agree best about each patch.

    Args:
        pictures: the photos.
        x: centres of the patches at the expected height, world m.
        slope: dz/dx and dz/dy of each.
        half_side: half of a patch's side, m.
        half_range: largest offset from the expected height that is tried, m.
        steps: heights on either side of it.

    Returns:
        [n 4]: offset from the expected height (m); agreement there, the mean correlation of all
        pairs of photos; the best agreement at any other height; and the second difference of the
        agreement at the best height, 1/m^2. Agreement is in [-1,1], or `NONE`.
    """
    n = len(x)
    found = np.empty((n, 4), np.float32)
    for p in prange(n):
        found[p, 0], found[p, 1], found[p, 2], found[p, 3] = 0.0, NONE, NONE, 0.0
        views, levels, count = _views(pictures, x[p], slope[p], half_side, half_range[p])
        if count < MIN_VIEWS:
            continue
        step = half_range[p] / steps
        agreement = np.empty(2 * steps + 1)
        best = 0
        for k in range(2 * steps + 1):
            z = x[p, 2] + (k - steps) * step
            agreement[k] = _agreement(pictures, views, levels, count, x[p], z, slope[p], half_side)
            if agreement[k] > agreement[best]:
                best = k
        if best == 0 or best == 2 * steps or agreement[best - 1] == NONE:
            continue
        if agreement[best + 1] == NONE:
            continue
        second = NONE
        for k in range(2 * steps + 1):
            if abs(k - best) >= SEPARATION:
                second = max(second, agreement[k])
        bend = agreement[best - 1] - 2 * agreement[best] + agreement[best + 1]
        shift = 0.0
        if bend < -1e-9:  # constant: 0/0
            shift = 0.5 * (agreement[best - 1] - agreement[best + 1]) / bend
        found[p, 0] = (best - steps + shift) * step
        found[p, 1], found[p, 2], found[p, 3] = agreement[best], second, bend / step**2
    return found


@njit(cache=True, fastmath=_FAST)
def _pixel(pictures, v, x, y, z):
    """Return the pixel of a world position at full size, and its z-depth."""
    dx = x - pictures.centre[v, 0]
    dy = y - pictures.centre[v, 1]
    dz = z - pictures.centre[v, 2]
    r = pictures.rotation[v]
    depth = r[2, 0] * dx + r[2, 1] * dy + r[2, 2] * dz
    if depth < 1e-3:  # behind the camera
        return -1.0, -1.0, depth
    across = (r[0, 0] * dx + r[0, 1] * dy + r[0, 2] * dz) / depth
    down = (r[1, 0] * dx + r[1, 1] * dy + r[1, 2] * dz) / depth
    k = pictures.intrinsics[v]
    return k[0] * across + k[2], k[1] * down + k[3], depth


@njit(cache=True, fastmath=_FAST)
def _is_ground(pictures, v, x, y, z):
    """Return whether a photo shows a position on a pixel labelled ground."""
    column, row, _ = _pixel(pictures, v, x, y, z)
    width, height = pictures.size[v, 0, 0], pictures.size[v, 0, 1]
    if not (column >= 1 and row >= 1 and column < width - 1 and row < height - 1):
        return False
    return pictures.ground[pictures.ground_start[v] + int(row) * width + int(column)]


@njit(cache=True, fastmath=_FAST)
def _views(pictures, x, slope, half_side, half_range):
    """Return the views that show a patch largest, the level of each, and their number."""
    views, levels = np.zeros(VIEWS, np.int64), np.zeros(VIEWS, np.int64)
    nearest = np.full(VIEWS, np.inf)
    count = 0
    for v in range(len(pictures.centre)):
        dx, dy = x[0] - pictures.centre[v, 0], x[1] - pictures.centre[v, 1]
        dz = x[2] - pictures.centre[v, 2]
        t = np.sqrt(dx * dx + dy * dy + dz * dz)
        # Towards the tilted patch, not the horizon.
        towards = (dz - slope[0] * dx - slope[1] * dy) / (t + 1e-9)
        if towards > -MIN_SLOPE:
            continue
        footprint = t / pictures.intrinsics[v, 0]
        if count == VIEWS and footprint >= nearest[VIEWS - 1]:
            continue
        shown = _is_ground(pictures, v, x[0], x[1], x[2])
        shown = shown and _is_ground(pictures, v, x[0], x[1], x[2] + half_range)
        shown = shown and _is_ground(pictures, v, x[0], x[1], x[2] - half_range)
        for i in (-1, 1):
            for j in (-1, 1):
                a, b = i * half_side, j * half_side
                z = x[2] + slope[0] * a + slope[1] * b
                shown = shown and _is_ground(pictures, v, x[0] + a, x[1] + b, z)
        if not shown:
            continue
        at = min(count, VIEWS - 1)
        while at > 0 and nearest[at - 1] > footprint:
            nearest[at], views[at], levels[at] = nearest[at - 1], views[at - 1], levels[at - 1]
            at -= 1
        spacing = 2 * half_side / (SAMPLES - 1)
        level = int(np.floor(np.log2(max(spacing / footprint, 1.0))))
        nearest[at], views[at], levels[at] = footprint, v, min(level, LEVELS - 1)
        count = min(count + 1, VIEWS)
    return views, levels, count


@njit(cache=True, fastmath=_FAST)
def _agreement(pictures, views, levels, count, x, z, slope, half_side):
    """Return the mean correlation of all pairs of views of a patch at height z."""
    total = np.zeros(SAMPLES * SAMPLES)
    own = np.empty(SAMPLES * SAMPLES)
    used = 0
    for k in range(count):
        v, level = views[k], levels[k]
        scale = 0.5**level
        start = pictures.start[v, level]
        width, height = pictures.size[v, level, 0], pictures.size[v, level, 1]
        mean, valid, at = 0.0, True, 0
        for i in range(SAMPLES):
            a = (2 * i / (SAMPLES - 1) - 1) * half_side
            for j in range(SAMPLES):
                b = (2 * j / (SAMPLES - 1) - 1) * half_side
                column, row, depth = _pixel(
                    pictures, v, x[0] + a, x[1] + b, z + slope[0] * a + slope[1] * b
                )
                grey = _grey(pictures.grey, start, width, height, column * scale, row * scale)
                if not grey > 0:
                    valid = False
                    break
                own[at] = grey
                mean += grey
                at += 1
            if not valid:
                break
        if not valid:
            continue
        mean /= SAMPLES * SAMPLES
        along, across = 0.0, 0.0
        for m in range(SAMPLES * SAMPLES):
            along += own[m] * (m // SAMPLES - HALF)
            across += own[m] * (m % SAMPLES - HALF)
        along, across = along / RAMP, across / RAMP
        squared = 0.0
        for m in range(SAMPLES * SAMPLES):
            own[m] -= mean + along * (m // SAMPLES - HALF) + across * (m % SAMPLES - HALF)
            squared += own[m] * own[m]
        if not squared > SAMPLES * SAMPLES * MIN_CONTRAST**2:
            continue
        norm = 1 / np.sqrt(squared)
        for m in range(SAMPLES * SAMPLES):
            total[m] += own[m] * norm
        used += 1
    if used < MIN_VIEWS or 2 * used < count:
        return NONE
    squared = 0.0
    for m in range(SAMPLES * SAMPLES):
        squared += total[m] * total[m]
    # |sum of unit vectors|^2 = their number + twice the sum over pairs.
    return (squared - used) / (used * (used - 1))


@njit(cache=True, fastmath=_FAST)
def _grey(grey, start, width, height, column, row):
    """Return the grey level between four pixel centres; 0 where one is invalid or outside."""
    column, row = column - 0.5, row - 0.5
    if not (column >= 0 and row >= 0 and column < width - 1 and row < height - 1):
        return 0.0
    i, j = int(column), int(row)
    u, w = column - i, row - j
    at = start + j * width + i
    a, b, c, d = grey[at], grey[at + 1], grey[at + width], grey[at + width + 1]
    if a == UNSEEN or b == UNSEEN or c == UNSEEN or d == UNSEEN:
        return 0.0
    return (1 - w) * ((1 - u) * a + u * b) + w * ((1 - u) * c + u * d)
