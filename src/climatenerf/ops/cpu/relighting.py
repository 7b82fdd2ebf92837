"""CPU kernels in Numba: sunlight on samples. The slow twins are in `ops.relighting`."""

import math

import numpy as np
from numba import njit, prange


@njit(cache=True, parallel=True)
def visibility(depths, half, bias, at, found):
    """Write the sun's visibility from shadow maps of two depths a texel."""
    side = depths.shape[1] - 1
    for i in prange(at.shape[0]):
        found[i] = 1.0
        for m in range(depths.shape[0]):
            scale = np.float32(side / (2 * half[m]))
            u = (at[i, 0] + np.float32(half[m])) * scale
            v = (at[i, 1] + np.float32(half[m])) * scale
            if not (u >= 0 and u < side and v >= 0 and v < side):
                continue
            column, row = int(u), int(v)
            fu, fv = u - column, v - row
            total = np.float32(0.0)
            for k in range(4):
                a, b = k & 1, k >> 1
                passed = np.float32(1.0)
                for part in range(2):
                    behind = (at[i, 2] - depths[m, row + b, column + a, part]) / bias[m] - 1
                    passed -= np.float32(0.5) * np.float32(min(max(behind, 0.0), 1.0))
                total += (fu if a else 1 - fu) * (fv if b else 1 - fv) * passed
            found[i] = total
            break


@njit(cache=True, parallel=True, fastmath=True)
def interpolated(grids, origin, cell, x, kind, found):
    """Write trilinear values of the grid of each sample's kind."""
    _, nz, ny, nx = grids.shape
    for i in prange(x.shape[0]):
        p0 = min(max((x[i, 0] - origin[0]) / np.float32(cell), 0.0), nx - 1.0)
        p1 = min(max((x[i, 1] - origin[1]) / np.float32(cell), 0.0), ny - 1.0)
        p2 = min(max((x[i, 2] - origin[2]) / np.float32(cell), 0.0), nz - 1.0)
        c0, c1, c2 = int(p0), int(p1), int(p2)
        f0, f1, f2 = np.float32(p0 - c0), np.float32(p1 - c1), np.float32(p2 - c2)
        total = np.float32(0.0)
        for k in range(8):
            a, b, h = k & 1, k >> 1 & 1, k >> 2 & 1
            weight = (f0 if a else 1 - f0) * (f1 if b else 1 - f1) * (f2 if h else 1 - f2)
            column, row, level = min(c0 + a, nx - 1), min(c1 + b, ny - 1), min(c2 + h, nz - 1)
            total += weight * grids[kind[i], level, row, column]
        found[i] = total


@njit(cache=True, parallel=True, fastmath=True)
def expected_fractions(choices, sent, shaded, sun, beam, albedo, spread, visibility, found):
    """Write the expected fractions of the sun."""
    darkest, least = np.float32(3e-3), np.float32(1e-9)
    half, most = np.float32(0.5), np.float32(60.0)
    for i in prange(visibility.shape[0]):
        bright = math.log(max(sent[i, 0], darkest)) - albedo[i, 0]
        tint = math.log(max(sent[i, 1], darkest) / max(sent[i, 2], darkest)) - albedo[i, 1]
        total, first, second = np.float32(0.0), np.float32(0.0), np.float32(0.0)
        for k in range(choices.shape[0]):
            own, facing, in_shadow, in_sun = choices[k]
            luma = max(shaded[i, 0] + own * sun[i, 0] + facing * beam[0], least)
            red = max(shaded[i, 1] + own * sun[i, 1] + facing * beam[1], least)
            blue = max(shaded[i, 2] + own * sun[i, 2] + facing * beam[2], least)
            off = (bright - math.log(luma)) / spread[i, 0]
            tinted = (tint - math.log(red / blue)) / spread[i, 1]
            likely = math.exp(-half * min(off * off + tinted * tinted, most))
            likely *= in_shadow + (in_sun - in_shadow) * visibility[i]
            total += likely
            first += own * likely
            second += facing * likely
        found[i, 0] = first / total
        found[i, 1] = second / total
