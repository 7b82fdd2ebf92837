"""CPU kernel in Numba: rays against a height field. The slow twin is `heightfield_reference`.

The method is described in `ops.heightfield`.
"""

import math

import numpy as np
from numba import njit, prange

HIT = np.float32(1e-3)
GAP = np.float32(1e-3)
_ONE = np.float32(1.0)


@njit(cache=True, inline="always")
def _to_face(place, d):
    """Return the ray length from a place in a cell, [0, 1], to the cell's face along one axis."""
    if d > 0:
        return (_ONE - place) / d
    return -place / d if d < 0 else np.float32(np.inf)


@njit(cache=True, inline="always")
def _crossing_in_cell(a, b, c, length):
    """Return where a + b s + c s^2 first passes below 0 in (0, length]; +inf if nowhere."""
    none = np.float32(np.inf)
    square = b * b - 4 * a * c
    if square < 0:
        return none
    if a <= HIT and not (c < 0 and b > 0 and a - b * b / (4 * c) > HIT):
        return none
    q = np.float32(-0.5) * (b + math.copysign(np.sqrt(square), b))
    first = q / c if c != 0 else none
    second = a / q if q != 0 else none
    if a <= HIT:
        s = max(first, second)
    else:
        s = min(first if first > 0 else none, second if second > 0 else none)
    return s if s <= length else none


@njit(cache=True, parallel=True)
def first_crossing(height, rays_o, rays_d, span, slope, found):
    """Write where rays first pass from above the field to below it, +inf if nowhere."""
    rows, columns = height.shape
    for i in prange(rays_o.shape[0]):
        found[i] = np.inf
        begin, end = span[i, 0], span[i, 1]
        for axis in range(2):
            side = np.float32(columns - 1) if axis == 0 else np.float32(rows - 1)
            o, d = rays_o[i, axis], rays_d[i, axis]
            if d == 0:
                if o < 0 or o > side:
                    end = begin
            else:
                first, second = -o / d, (side - o) / d
                begin, end = max(begin, min(first, second)), min(end, max(first, second))
        dx, dy, dz = rays_d[i, 0], rays_d[i, 1], rays_d[i, 2]
        climb = np.float32(slope * math.sqrt(dx * dx + dy * dy))
        if not (begin < end and climb > dz):
            continue
        ox, oy = rays_o[i, 0] + begin * dx, rays_o[i, 1] + begin * dy
        oz = rays_o[i, 2] + begin * dz
        t, end = np.float32(0.0), end - begin
        before = np.float32(-1.0)
        for _ in range(4 * (rows + columns)):
            x = min(max(ox + t * dx, np.float32(0.0)), np.float32(columns - 1))
            y = min(max(oy + t * dy, np.float32(0.0)), np.float32(rows - 1))
            column, row = min(int(x), columns - 2), min(int(y), rows - 2)
            u, v = x - np.float32(column), y - np.float32(row)
            corner = height[row, column]
            along_x, along_y = height[row, column + 1] - corner, height[row + 1, column] - corner
            twist = height[row + 1, column + 1] - corner - along_x - along_y
            above = oz + t * dz - (corner + along_x * u + along_y * v + twist * u * v)
            if before > HIT and above <= HIT:
                found[i] = begin + t
                break
            before = above
            if above > HIT:
                step = above / (climb - dz)
            elif climb + dz > 0:
                step = max(-above, np.float32(0.0)) / (climb + dz)
            else:
                break  # it never comes out of the ground
            face = min(_to_face(u, dx), _to_face(v, dy))
            if step < face:
                rate = dz - along_x * dx - along_y * dy - twist * (u * dy + v * dx)
                s = _crossing_in_cell(above, rate, -twist * dx * dy, min(face, end - t))
                if s < np.inf:
                    found[i] = begin + t + s
                    break
                step = face + GAP
            t += step
            if not t < end:
                break
