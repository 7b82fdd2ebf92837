"""Search along pixels' rays for the distance at which neighbouring pictures look alike: Numba, CPU.

Pictures are grey and of pinhole cameras, pixel centres at .5. Inverse z-depth s in 1/m: a pixel's
direction d (z = 1) at s is seen by another camera in the direction A d + s b, A and b the turn and
the shift between the two cameras' frames.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int, UInt8
from numba import njit, prange

SIDE = 2  # pixels from a window's middle to its border
STEP = 1.0  # pixels that the projection moves between two distances that are tried, or more:
MAX_STEPS = 256  # what comes near moves over all of a large picture
FINE = 8  # smaller steps to either side of the best one
APART = 3  # steps from the best one that count as another place
MIN_CONTRAST = 4.0  # standard deviation of a window, 8-bit levels
UNSEEN = 0  # the level of a pixel that a picture does not show
TILES = 3  # along each side of a picture: each has neighbours of its own
STEEP = 20.0  # times a window's reach in depth that it must be away: 1/z is taken from a series
NONE = -2.0  # a likeness that is not known
HOPELESS = 0.5  # a likeness at whole steps that no smaller step makes a good one
# NaN keeps its meaning: it stands for what a picture does not show.
_FAST = {"contract", "reassoc", "arcp", "nsz"}


class Pictures(NamedTuple):
    """Grey pictures in one row, and how they see each other (Numba takes named tuples as is)."""

    grey: UInt8[np.ndarray, "total"]
    """Levels from 1 to 255, or `UNSEEN`."""
    start: Int[np.ndarray, "v"]
    """Where each picture begins."""
    size: Int[np.ndarray, "v 2"]
    """Width and height, px."""
    intrinsics: Float32[np.ndarray, "v 4"]
    """fx, fy, cx, cy, px."""
    others: Int[np.ndarray, "v tiles k"]
    """The neighbours with which what lies in a tile is compared, -1: none. There are TILES² of
    them, row by row."""
    turn: Float32[np.ndarray, "v tiles k 3 3"]
    """A: from the picture's camera frame to a neighbour's."""
    shift: Float32[np.ndarray, "v tiles k 3"]
    """b: the picture's eye in a neighbour's frame, m."""
    most: Float32[np.ndarray, "v tiles"]
    """The largest inverse z-depth that is tried, 1/m; the least is 0."""


@njit(cache=True, parallel=True, fastmath=_FAST)
def match(
    pictures: Pictures, view: Int[np.ndarray, "n"], pixel: Float32[np.ndarray, "n 2"]
) -> Float32[np.ndarray, "n 3"]:
    """Inverse z-depth of pixels (x, y) of views, by Goesele et al. 2006, "Multi-View Stereo
    Revisited": windows are compared by normalized cross-correlation.

    Returns:
        [n 3]: inverse z-depth (1/m); likeness there, the mean of the two neighbours that are most
        alike; and the most at any other distance. Likeness is in [-1,1], or `NONE`, also where it
        is poor.
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
        per_step = pictures.most[i, tile] / (steps - 1)
        likeness = np.empty(steps, np.float32)
        best = 0
        for h in range(steps):
            likeness[h] = _alike(pictures, i, tile, x, y, h * per_step, window)
            if likeness[h] > likeness[best]:
                best = h
        if likeness[best] < HOPELESS:
            continue
        second = -1
        for h in range(steps):
            apart = abs(h - best) >= APART and likeness[h] > NONE
            if apart and (second < 0 or likeness[h] > likeness[second]):
                second = h
        found[p, 0], found[p, 1] = _refined(pictures, i, tile, x, y, best, per_step, window)
        if second >= 0:  # as finely, or it would look less alike than it is
            _, found[p, 2] = _refined(pictures, i, tile, x, y, second, per_step, window)
    return found


@njit(cache=True, fastmath=_FAST)
def _refined(pictures, i, tile, x, y, h, per_step, window):
    """Inverse z-depth of the best place within a step of step h, and the likeness there."""
    fine = np.empty(2 * FINE + 1, np.float32)
    top = FINE
    for f in range(2 * FINE + 1):
        s = max(0.0, (h + (f - FINE) / FINE) * per_step)
        fine[f] = _alike(pictures, i, tile, x, y, s, window)
        if fine[f] > fine[top]:
            top = f
    shift = 0.0
    if 0 < top < 2 * FINE and fine[top - 1] > NONE and fine[top + 1] > NONE:
        bend = fine[top - 1] - 2 * fine[top] + fine[top + 1]
        if bend < -1e-6:  # flat: 0/0
            shift = 0.5 * (fine[top - 1] - fine[top + 1]) / bend
    return np.float32(max(0.0, (h + (top - FINE + shift) / FINE) * per_step)), fine[top]


@njit(cache=True, fastmath=_FAST)
def _look(pictures, i, x, y):
    """Grey level of picture i, between its pixels; NaN where it shows nothing."""
    return _between(pictures, i, x, y) if _shows(pictures, i, x, y) else np.float32(np.nan)


@njit(cache=True, fastmath=_FAST)
def _between(pictures, i, x, y):
    """Grey level at a place that lies between middles of pixels; NaN where one is not shown."""
    width, height = pictures.size[i, 0], pictures.size[i, 1]
    x, y = np.float32(x - 0.5), np.float32(y - 0.5)
    # Rounding, and the series of 1/z, may bring a place past the first or the last.
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
    """Number of the tile of picture i, row by row, in which a pixel lies."""
    column = min(max(int(TILES * x / pictures.size[i, 0]), 0), TILES - 1)
    row = min(max(int(TILES * y / pictures.size[i, 1]), 0), TILES - 1)
    return TILES * row + column


@njit(cache=True, fastmath=_FAST)
def _take_window(pictures, i, x, y, window):
    """Fills `window` with what is about a pixel, less its mean and of length 1; False if flat."""
    total, at = 0.0, 0
    for row in range(-SIDE, SIDE + 1):
        for column in range(-SIDE, SIDE + 1):
            window[at] = _look(pictures, i, x + column, y + row)
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
    """A d + s b of a pixel of picture i, in the frame of its neighbour k."""
    fx, fy = pictures.intrinsics[i, 0], pictures.intrinsics[i, 1]
    dx, dy = (x - pictures.intrinsics[i, 2]) / fx, (y - pictures.intrinsics[i, 3]) / fy
    a, b = pictures.turn[i, tile, k], pictures.shift[i, tile, k]
    return (
        a[0, 0] * dx + a[0, 1] * dy + a[0, 2] + s * b[0],
        a[1, 0] * dx + a[1, 1] * dy + a[1, 2] + s * b[1],
        a[2, 0] * dx + a[2, 1] * dy + a[2, 2] + s * b[2],
    )


@njit(cache=True, fastmath=_FAST)
def _steps(pictures, i, tile, x, y):
    """How many distances are tried, by how far the projection moves from the last to the first."""
    length = 0.0
    for k in range(pictures.others.shape[2]):
        j = pictures.others[i, tile, k]
        if j < 0:
            continue
        far = _direction(pictures, i, tile, k, x, y, 0.0)
        near = _direction(pictures, i, tile, k, x, y, pictures.most[i, tile])
        if far[2] <= 1e-3 or near[2] <= 1e-3:  # passes the camera: over all of the picture
            return MAX_STEPS
        fx, fy = pictures.intrinsics[j, 0], pictures.intrinsics[j, 1]
        across = fx * (near[0] / near[2] - far[0] / far[2])
        down = fy * (near[1] / near[2] - far[1] / far[2])
        length = max(length, np.sqrt(across * across + down * down))
    return min(MAX_STEPS, int(length / STEP) + 2 * APART)


@njit(cache=True, fastmath=_FAST)
def _shows(pictures, i, x, y):
    """Whether a place lies between middles of picture i's pixels."""
    width, height = pictures.size[i, 0], pictures.size[i, 1]
    inside = x >= 0.5 and y >= 0.5 and x <= width - 0.5 and y <= height - 0.5
    return inside and min(width, height) > 1


@njit(cache=True, fastmath=_FAST)
def _projected(xs, ys, zs, column, row):
    """Where a window's pixel comes to lie from the neighbour's centre: x/z and y/z.

    Each is a value at the window's middle and its changes along rows and columns; of z 1/z, and
    relative changes, which are so small that a series of 1/z does.
    """
    u, v = np.float32(column), np.float32(row)
    change = zs[1] * u + zs[2] * v
    inverse = (np.float32(1.0) - change + change * change) * zs[0]
    return (xs[0] + xs[1] * u + xs[2] * v) * inverse, (ys[0] + ys[1] * u + ys[2] * v) * inverse


@njit(cache=True, fastmath=_FAST)
def _alike(pictures, i, tile, x, y, s, window):
    """Mean likeness to the two neighbours that are most alike at inverse z-depth s."""
    first, second = np.float32(NONE), np.float32(NONE)
    fx, fy = pictures.intrinsics[i, 0], pictures.intrinsics[i, 1]
    for k in range(pictures.others.shape[2]):
        j = pictures.others[i, tile, k]
        if j < 0:
            continue
        middle = _direction(pictures, i, tile, k, x, y, np.float32(s))
        a, own = pictures.turn[i, tile, k], pictures.intrinsics[j]
        turn_u, turn_v = a[2, 0] / fx, a[2, 1] / fy  # along the window's rows and columns
        reach = SIDE * (abs(turn_u) + abs(turn_v))
        # Beside or behind the camera, or turned far.
        if middle[2] <= max(np.float32(1e-3), STEEP * reach):
            continue
        xs = own[0] * middle[0], own[0] * a[0, 0] / fx, own[0] * a[0, 1] / fy
        ys = own[1] * middle[1], own[1] * a[1, 0] / fx, own[1] * a[1, 1] / fy
        per_z = np.float32(1.0) / middle[2]
        zs = per_z, turn_u * per_z, turn_v * per_z
        inside = True  # with its corners, the whole window
        for row in (-SIDE, SIDE):
            for column in (-SIDE, SIDE):
                to_x, to_y = _projected(xs, ys, zs, column, row)
                inside &= _shows(pictures, j, to_x + own[2], to_y + own[3])
        if not inside:
            continue
        total, squared, both, at = np.float32(0), np.float32(0), np.float32(0), 0
        for row in range(-SIDE, SIDE + 1):
            for column in range(-SIDE, SIDE + 1):
                to_x, to_y = _projected(xs, ys, zs, column, row)
                grey = _between(pictures, j, to_x + own[2], to_y + own[3])
                total += grey
                squared += grey * grey
                both += grey * window[at]
                at += 1
        variance = squared - total * total / at
        if not variance > at * MIN_CONTRAST**2:  # NaN where not shown
            continue
        own_likeness = np.float32(both / np.sqrt(variance))
        if own_likeness > first:
            first, second = own_likeness, first
        elif own_likeness > second:
            second = own_likeness
    return np.float32(NONE) if second == NONE else np.float32(0.5) * (first + second)
