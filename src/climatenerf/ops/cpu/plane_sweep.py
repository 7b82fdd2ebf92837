"""Plane sweep along pixels' rays for the depth at which neighbouring pictures match. CPU, in Numba.

Pictures are grey and of pinhole cameras; pixel centres are at .5. Depth is the inverse z-depth s,
1/m: a neighbour sees a pixel of direction d (z = 1) at s in the direction A d + s b, where A and b
are rotation and translation between the two camera frames.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int, UInt8
from numba import njit, prange

SIDE = 2  # pixels from the middle of a window to its border
STEP = 1.0  # pixels by which the projection moves between two depths
MAX_STEPS = 256  # depths; near surfaces move across all of a large picture
FINE = 8  # fractions of a step that are tried on either side of the best one
SEPARATION = 3  # steps from the best depth from which a depth counts as different
MIN_CONTRAST = 4.0  # standard deviation of a window, 8-bit levels
UNSEEN = 0  # level of an invalid pixel
TILES = 3  # along each side of a picture; each tile has a list of neighbours
MIN_DISTANCE = 20.0  # minimum z in half extents in z of a window, for the series of 1/z
NONE = -2.0  # an invalid correlation
MIN_CORRELATION = 0.5  # at whole steps; below it no finer step gives a good match
# Without nnan: NaN marks invalid pixels.
_FAST = {"contract", "reassoc", "arcp", "nsz"}


class Pictures(NamedTuple):
    """Grey pictures in one flat array, and their neighbours (Numba accepts named tuples)."""

    grey: UInt8[np.ndarray, "total"]
    """Levels from 1 to 255, or `UNSEEN`."""
    start: Int[np.ndarray, "v"]
    """Offset of each picture in `grey`."""
    size: Int[np.ndarray, "v 2"]
    """Width and height, px."""
    intrinsics: Float32[np.ndarray, "v 4"]
    """fx, fy, cx, cy, px."""
    neighbours: Int[np.ndarray, "v tiles k"]
    """Neighbour views that a tile is compared with; -1: none. TILES² tiles, row by row."""
    rotation: Float32[np.ndarray, "v tiles k 3 3"]
    """A: rotation from the picture's camera frame to a neighbour's."""
    shift: Float32[np.ndarray, "v tiles k 3"]
    """b: translation, the picture's camera centre in a neighbour's frame, m."""
    max_inverse_depth: Float32[np.ndarray, "v tiles"]
    """Largest inverse z-depth of the sweep, 1/m; the smallest is 0."""


@njit(cache=True, parallel=True, fastmath=_FAST)
def match(
    pictures: Pictures, view: Int[np.ndarray, "n"], pixel: Float32[np.ndarray, "n 2"]
) -> Float32[np.ndarray, "n 3"]:
    """Return inverse z-depths of pixels (x, y) of views.

    Windows are compared by normalised cross-correlation (Goesele et al. 2006, "Multi-View Stereo
    Revisited").

    Returns:
        [n 3]: inverse z-depth (1/m); correlation there, the mean of the two best neighbours; and
        the best correlation at any other depth. Correlations are in [-1,1], or `NONE`, also where
        they are poor.
    """
    n = view.shape[0]
    found = np.empty((n, 3), np.float32)
    for p in prange(n):
        i, x, y = view[p], pixel[p, 0], pixel[p, 1]
        window = np.empty((2 * SIDE + 1) ** 2, np.float32)
        found[p, 0], found[p, 1], found[p, 2] = 0.0, NONE, NONE
        if not _take_window(pictures, i, x, y, window):
            continue
        tile = _tile(pictures, i, x, y)
        steps = _steps(pictures, i, tile, x, y)
        per_step = pictures.max_inverse_depth[i, tile] / (steps - 1)
        correlations = np.empty(steps, np.float32)
        best = 0
        for h in range(steps):
            correlations[h] = _correlation(pictures, i, tile, x, y, h * per_step, window)
            if correlations[h] > correlations[best]:
                best = h
        if correlations[best] < MIN_CORRELATION:
            continue
        second = -1
        for h in range(steps):
            separate = abs(h - best) >= SEPARATION and correlations[h] > NONE
            if separate and (second < 0 or correlations[h] > correlations[second]):
                second = h
        found[p, 0], found[p, 1] = _refined(pictures, i, tile, x, y, best, per_step, window)
        if second >= 0:  # refined as well, for a fair comparison
            _, found[p, 2] = _refined(pictures, i, tile, x, y, second, per_step, window)
    return found


@njit(cache=True, fastmath=_FAST)
def _refined(pictures, i, tile, x, y, h, per_step, window):
    """Return the best inverse z-depth within a step of step h, and the correlation there."""
    fine = np.empty(2 * FINE + 1, np.float32)
    top = FINE
    for f in range(2 * FINE + 1):
        s = max(0.0, (h + (f - FINE) / FINE) * per_step)
        fine[f] = _correlation(pictures, i, tile, x, y, s, window)
        if fine[f] > fine[top]:
            top = f
    shift = 0.0
    if 0 < top < 2 * FINE and fine[top - 1] > NONE and fine[top + 1] > NONE:
        curvature = fine[top - 1] - 2 * fine[top] + fine[top + 1]
        if curvature < -1e-6:  # constant: 0/0
            shift = 0.5 * (fine[top - 1] - fine[top + 1]) / curvature
    return np.float32(max(0.0, (h + (top - FINE + shift) / FINE) * per_step)), fine[top]


@njit(cache=True, fastmath=_FAST)
def _grey_at(pictures, i, x, y):
    """Return the interpolated grey level of picture i; NaN outside it."""
    return _interpolated(pictures, i, x, y) if _contains(pictures, i, x, y) else np.float32(np.nan)


@njit(cache=True, fastmath=_FAST)
def _interpolated(pictures, i, x, y):
    """Return the grey level between four pixel centres; NaN where one of them is invalid."""
    width, height = pictures.size[i, 0], pictures.size[i, 1]
    x, y = np.float32(x - 0.5), np.float32(y - 0.5)
    # Rounding, and the series of 1/z, may give a position beyond the first or last pixel.
    column = max(0, min(int(x), width - 2))
    row = max(0, min(int(y), height - 2))
    u, v = x - np.float32(column), y - np.float32(row)
    at = pictures.start[i] + row * width + column
    grey = pictures.grey
    a, b, c, d = grey[at], grey[at + 1], grey[at + width], grey[at + width + 1]
    if a == UNSEEN or b == UNSEEN or c == UNSEEN or d == UNSEEN:
        return np.float32(np.nan)
    one = np.float32(1.0)
    upper, lower = (one - u) * a + u * b, (one - u) * c + u * d
    return (one - v) * upper + v * lower


@njit(cache=True, fastmath=_FAST)
def _tile(pictures, i, x, y):
    """Return the tile of picture i, numbered row by row, that contains a pixel."""
    column = min(max(int(TILES * x / pictures.size[i, 0]), 0), TILES - 1)
    row = min(max(int(TILES * y / pictures.size[i, 1]), 0), TILES - 1)
    return TILES * row + column


@njit(cache=True, fastmath=_FAST)
def _take_window(pictures, i, x, y, window):
    """Write the window around a pixel, minus its mean and of length 1; return False if flat."""
    total, at = 0.0, 0
    for row in range(-SIDE, SIDE + 1):
        for column in range(-SIDE, SIDE + 1):
            window[at] = _grey_at(pictures, i, x + column, y + row)
            total += window[at]
            at += 1
    mean, squared = total / at, 0.0
    for k in range(at):
        window[k] -= mean
        squared += window[k] ** 2
    if not squared > at * MIN_CONTRAST**2:
        return False
    for k in range(at):
        window[k] /= np.sqrt(squared)
    return True


@njit(cache=True, fastmath=_FAST)
def _direction(pictures, i, tile, k, x, y, s):
    """Return A d + s b of a pixel of picture i, in the frame of its neighbour k."""
    fx, fy = pictures.intrinsics[i, 0], pictures.intrinsics[i, 1]
    dx, dy = (x - pictures.intrinsics[i, 2]) / fx, (y - pictures.intrinsics[i, 3]) / fy
    a, b = pictures.rotation[i, tile, k], pictures.shift[i, tile, k]
    return (
        a[0, 0] * dx + a[0, 1] * dy + a[0, 2] + s * b[0],
        a[1, 0] * dx + a[1, 1] * dy + a[1, 2] + s * b[1],
        a[2, 0] * dx + a[2, 1] * dy + a[2, 2] + s * b[2],
    )


@njit(cache=True, fastmath=_FAST)
def _steps(pictures, i, tile, x, y):
    """Return the number of depths to try, from the length of the projection of the ray."""
    length = 0.0
    for k in range(pictures.neighbours.shape[2]):
        j = pictures.neighbours[i, tile, k]
        if j < 0:
            continue
        far = _direction(pictures, i, tile, k, x, y, 0.0)
        near = _direction(pictures, i, tile, k, x, y, pictures.max_inverse_depth[i, tile])
        if far[2] <= 1e-3 or near[2] <= 1e-3:  # the ray passes the camera
            return MAX_STEPS
        fx, fy = pictures.intrinsics[j, 0], pictures.intrinsics[j, 1]
        across = fx * (near[0] / near[2] - far[0] / far[2])
        down = fy * (near[1] / near[2] - far[1] / far[2])
        length = max(length, np.sqrt(across * across + down * down))
    return min(MAX_STEPS, int(length / STEP) + 2 * SEPARATION)


@njit(cache=True, fastmath=_FAST)
def _contains(pictures, i, x, y):
    """Return whether a position lies between pixel centres of picture i."""
    width, height = pictures.size[i, 0], pictures.size[i, 1]
    inside = x >= 0.5 and y >= 0.5 and x <= width - 0.5 and y <= height - 0.5
    return inside and min(width, height) > 1


@njit(cache=True, fastmath=_FAST)
def _projected(xs, ys, zs, column, row):
    """Return x/z and y/z of a window's pixel, relative to the neighbour's principal point.

    xs and ys hold the value at the window's middle and its changes along rows and columns. zs holds
    1/z and the relative changes of z, which are so small that a series of 1/z suffices.
    """
    u, v = np.float32(column), np.float32(row)
    change = zs[1] * u + zs[2] * v
    inverse = (np.float32(1.0) - change + change * change) * zs[0]
    return (xs[0] + xs[1] * u + xs[2] * v) * inverse, (ys[0] + ys[1] * u + ys[2] * v) * inverse


@njit(cache=True, fastmath=_FAST)
def _correlation(pictures, i, tile, x, y, s, window):
    """Return the mean correlation with the two best neighbours at inverse z-depth s."""
    first, second = np.float32(NONE), np.float32(NONE)
    fx, fy = pictures.intrinsics[i, 0], pictures.intrinsics[i, 1]
    for k in range(pictures.neighbours.shape[2]):
        j = pictures.neighbours[i, tile, k]
        if j < 0:
            continue
        middle = _direction(pictures, i, tile, k, x, y, np.float32(s))
        a, lens = pictures.rotation[i, tile, k], pictures.intrinsics[j]
        turn_u, turn_v = a[2, 0] / fx, a[2, 1] / fy  # along the window's rows and columns
        extent = SIDE * (abs(turn_u) + abs(turn_v))
        # Beside or behind the camera, or tilted too far.
        if middle[2] <= max(np.float32(1e-3), MIN_DISTANCE * extent):
            continue
        xs = lens[0] * middle[0], lens[0] * a[0, 0] / fx, lens[0] * a[0, 1] / fy
        ys = lens[1] * middle[1], lens[1] * a[1, 0] / fx, lens[1] * a[1, 1] / fy
        per_z = np.float32(1.0) / middle[2]
        zs = per_z, turn_u * per_z, turn_v * per_z
        inside = True  # the corners decide for the whole window
        for row in (-SIDE, SIDE):
            for column in (-SIDE, SIDE):
                to_x, to_y = _projected(xs, ys, zs, column, row)
                inside &= _contains(pictures, j, to_x + lens[2], to_y + lens[3])
        if not inside:
            continue
        total, squared, both, at = np.float32(0), np.float32(0), np.float32(0), 0
        for row in range(-SIDE, SIDE + 1):
            for column in range(-SIDE, SIDE + 1):
                to_x, to_y = _projected(xs, ys, zs, column, row)
                grey = _interpolated(pictures, j, to_x + lens[2], to_y + lens[3])
                total += grey
                squared += grey * grey
                both += grey * window[at]
                at += 1
        variance = squared - total * total / at
        if not variance > at * MIN_CONTRAST**2:  # NaN where a pixel is invalid
            continue
        correlation = np.float32(both / np.sqrt(variance))
        if correlation > first:
            first, second = correlation, first
        elif correlation > second:
            second = correlation
    return np.float32(NONE) if second == NONE else np.float32(0.5) * (first + second)
