"""CPU kernel in Numba: rays against waves. The twin for any device is in `ops.wave_tracing`.

Maps are of single precision, positions of double precision. Names and limits are those of the twin.
"""

import math

import numpy as np
from numba import njit, prange

from climatenerf.ops.wave_tracing import FLAT, GRAZING, NEAR, REACH, REFINED, STEP, STEPS

_BLOCK = 256  # rays that share their scratch arrays


@njit(cache=True, inline="always")
def _texel(texels, first, size, x, y, channel):
    """Interpolate one channel of one level, whose first texel is `first`; x and y in texels."""
    i, j = math.floor(x), math.floor(y)
    fx, fy = x - i, y - j
    mask = size - 1  # the size is a power of two
    i0, j0 = int(i) & mask, int(j) & mask
    i1, j1 = (i0 + 1) & mask, (j0 + 1) & mask
    row, row1 = first + j0 * size, first + j1 * size
    a = texels[row + i0, channel] * (1 - fx) + texels[row + i1, channel] * fx
    b = texels[row1 + i0, channel] * (1 - fx) + texels[row1 + i1, channel] * fx
    return a * (1 - fy) + b * fy


@njit(cache=True, inline="always")
def _value(tables, top, k, level, mix, x, y, channel):
    """One channel of one tile at x, y (m), between two levels."""
    texels, start, side = tables[0], tables[1], tables[2]
    size = 1 << (top - level)
    first = start[k] + ((4 << (2 * top)) - 4 * size * size) // 3
    scale = size / side[k]
    value = _texel(texels, first, size, x * scale, y * scale, channel) * (1 - mix)
    if mix > 0:
        first += size * size
        value += _texel(texels, first, size >> 1, 0.5 * x * scale, 0.5 * y * scale, channel) * mix
    return value


@njit(cache=True, inline="always")
def _sum(tables, top, levels, mixes, x, y, channel):
    """One channel of all tiles together at x, y (m)."""
    total = 0.0
    for k in range(levels.shape[0]):
        total += _value(tables, top, k, levels[k], mixes[k], x, y, channel)
    return total


@njit(cache=True, parallel=True)
def first_hits(tables, top, unresolved, level, rays, results):
    """Write ray lengths, slopes and removed variances; see `ops.wave_tracing.first_hits`."""
    start, side, slope_variance = tables[1], tables[2], tables[3]
    level_variance, level_covariance, highest = tables[4], tables[5], tables[6]
    rays_o, rays_d, below, pixel_angle = rays
    found, slopes, variances = results
    tiles = start.shape[0]
    count = rays_o.shape[0]
    height = 0.0
    for k in range(tiles):
        height += highest[k, 0]
    for block in prange((count + _BLOCK - 1) // _BLOCK):
        levels, mixes = np.empty(tiles, np.int64), np.empty(tiles)
        for r in range(block * _BLOCK, min((block + 1) * _BLOCK, count)):
            sign = -1.0 if below[r] else 1.0
            ox, oy = float(rays_o[r, 0]), float(rays_o[r, 1])
            dx, dy = float(rays_d[r, 0]), float(rays_d[r, 1])
            over = sign * (float(rays_o[r, 2]) - level)
            climb = sign * float(rays_d[r, 2])
            flat = -over / climb if climb < 0 else REACH
            grazing = math.sqrt(max(abs(climb), GRAZING))
            among = abs(over) < height
            distance = min(flat, NEAR) if among else flat
            footprint = max(distance, 0.0) * pixel_angle[r] / grazing
            crest, variance = 0.0, unresolved
            for k in range(tiles):
                exact = math.log2(min(max(footprint * (1 << top) / side[k], 1.0), float(1 << top)))
                at = min(int(exact), top - 1)
                mix = exact - at
                levels[k] = at
                mixes[k] = mix
                crest += highest[k, at] * (1 - mix) + highest[k, at + 1] * mix
                filtered = (1 - mix) ** 2 * level_variance[k, at]
                filtered += mix**2 * level_variance[k, at + 1]
                filtered += 2 * mix * (1 - mix) * level_covariance[k, at]
                variance += max(slope_variance[k] - filtered, 0.0)
            found[r] = math.inf
            slopes[r, 0] = slopes[r, 1] = 0.0
            variances[r] = variance
            if crest <= FLAT:
                if climb >= 0 or over <= 0:
                    continue
                t = flat
            else:
                if climb >= 0 and over >= crest:
                    continue
                safe = climb if abs(climb) >= 1e-9 else 1e-9  # a level ray leaves nowhere: x/0
                first, last = (crest - over) / safe, (-crest - over) / safe
                begin = max(min(first, last), 0.0)
                end = min(max(first, last), begin + REACH)
                if end <= 0:
                    continue
                run = math.sqrt(dx * dx + dy * dy)
                steps = math.ceil((end - begin) * run / (STEP * max(footprint, 1e-4)))
                steps = min(max(steps, 1), STEPS)
                low, f_low, high, f_high = begin, 0.0, -1.0, 0.0
                for q in range(steps + 1):
                    share = q / steps
                    t = begin + (end - begin) * (share * share if among else share)
                    h = _sum(tables, top, levels, mixes, ox + t * dx, oy + t * dy, 0)
                    f = over + climb * t - sign * h
                    if f <= 0:
                        high, f_high = t, f
                        if q == 0:
                            low, f_low = t, f
                        break
                    low, f_low = t, f
                if high < 0:
                    if climb >= 0 or end >= max(first, last) or flat <= end:
                        continue
                    low = high = flat  # the mean surface, far away
                for _ in range(REFINED if high > low else 0):
                    # 1e-12: equal heights at both ends, 0/0.
                    share = min(max(f_low / max(f_low - f_high, 1e-12), 0.0), 1.0)
                    t = low + share * (high - low)
                    h = _sum(tables, top, levels, mixes, ox + t * dx, oy + t * dy, 0)
                    f = over + climb * t - sign * h
                    if f <= 0:
                        high, f_high = t, f
                        f_low *= 0.5
                    else:
                        low, f_low = t, f
                        f_high *= 0.5
                t = high
            found[r] = t
            for axis in range(2):
                slopes[r, axis] = _sum(
                    tables, top, levels, mixes, ox + t * dx, oy + t * dy, 1 + axis
                )
