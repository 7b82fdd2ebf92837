"""CPU kernel in Numba: label votes. The slow twin is `reference.label_votes`."""

import numpy as np
from numba import njit, prange


@njit(cache=True, parallel=True)
def label_votes(x, radius, views, least, agreed):
    """Which places enough views see before nothing but sky, or ground: see `reference.label_votes`.

    Args: views: their maps in one row, each from starts [v] on and of sizes [v, 2], pinholes, c2w.
    """
    reach, starts, sizes, pinholes, c2w = views
    least_voices, least_share, apart = least
    for i in prange(x.shape[0]):
        voices, watching, first, spread = 0, 0, 0, False
        for v in range(c2w.shape[0]):
            pose, pinhole = c2w[v], pinholes[v]
            dx, dy, dz = x[i, 0] - pose[0, 3], x[i, 1] - pose[1, 3], x[i, 2] - pose[2, 3]
            z = dx * pose[0, 2] + dy * pose[1, 2] + dz * pose[2, 2]
            if not z > radius[i]:
                continue
            across = dx * pose[0, 0] + dy * pose[1, 0] + dz * pose[2, 0]
            down = dx * pose[0, 1] + dy * pose[1, 1] + dz * pose[2, 1]
            per_metre = np.float32(1.0) / z
            column = np.floor(pinhole[0] * across * per_metre + pinhole[2])
            row = np.floor(pinhole[1] * down * per_metre + pinhole[3])
            height, width = sizes[v, 0], sizes[v, 1]
            if not (column >= 0 and column < width and row >= 0 and row < height):
                continue
            watching += 1
            within = reach[starts[v] + np.int64(row) * width + np.int64(column)]
            footprint = radius[i] * max(pinhole[0], pinhole[1]) * per_metre
            if within < 1 or within - np.float32(1.0) < footprint:
                continue
            if voices == 0:
                first = v
            else:
                far = np.float32(0.0)
                for k in range(3):
                    far += (c2w[first, k, 3] - pose[k, 3]) ** 2
                spread |= far > apart * apart
            voices += 1
        agreed[i] = spread and voices >= least_voices and voices >= least_share * watching
