"""CPU kernel in Numba: irradiance from light probes. The slow twin is in `ops.probes`."""

import math

import numpy as np
from numba import njit, prange

BEHIND = np.float32(0.02)
MIN_WEIGHT = np.float32(1e-6)  # sum of weights
BLOCK = 256  # samples of one thread in turn


@njit(cache=True, parallel=True, fastmath=True)
def irradiance(x, normal, basis, origin, spacing, shape, valid, coefficients, found):
    """Write the irradiance of surfaces, all tables of coefficients after one another."""
    columns = found.shape[1]
    width = 9 * columns
    nx, ny, nz = shape
    count = x.shape[0]
    for block in prange((count + BLOCK - 1) // BLOCK):
        mixed = np.empty(width, np.float32)
        for i in range(block * BLOCK, min((block + 1) * BLOCK, count)):
            p0 = min(max((x[i, 0] - origin[0]) / spacing[0], 0.0), nx - 1.0001)
            p1 = min(max((x[i, 1] - origin[1]) / spacing[1], 0.0), ny - 1.0001)
            p2 = min(max((x[i, 2] - origin[2]) / spacing[2], 0.0), nz - 1.0001)
            c0, c1, c2 = int(p0), int(p1), int(p2)
            f0, f1, f2 = np.float32(p0 - c0), np.float32(p1 - c1), np.float32(p2 - c2)
            weights = np.float32(0.0)
            for every in range(2):  # the second time with the probes inside matter
                if weights > MIN_WEIGHT:
                    break
                mixed[:] = 0.0
                weights = np.float32(0.0)
                for k in range(8):
                    a, b, h = k & 1, k >> 1 & 1, k >> 2 & 1
                    node = ((c2 + h) * ny + c1 + b) * nx + c0 + a
                    if not (valid[node] or every):
                        continue
                    weight = (f0 if a else 1 - f0) * (f1 if b else 1 - f1)
                    weight *= f2 if h else 1 - f2
                    tx = origin[0] + (c0 + a) * spacing[0] - x[i, 0]
                    ty = origin[1] + (c1 + b) * spacing[1] - x[i, 1]
                    tz = origin[2] + (c2 + h) * spacing[2] - x[i, 2]
                    length = max(math.sqrt(tx * tx + ty * ty + tz * tz), np.float32(1e-6))
                    facing = (tx * normal[i, 0] + ty * normal[i, 1] + tz * normal[i, 2]) / length
                    half = np.float32(0.5) * (facing + 1)
                    weight *= half * half + BEHIND
                    weights += weight
                    for j in range(width):
                        mixed[j] += weight * coefficients[node, j]
            scale = 1 / weights
            for c in range(columns):
                total = np.float32(0.0)
                for t in range(9):
                    total += basis[t, i] * mixed[t * columns + c]
                found[i, c] = max(total * scale, np.float32(0.0))
