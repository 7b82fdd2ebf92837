"""CPU kernel in Numba: label votes. The slow twin is `visual_hull_reference.label_votes`."""

import numpy as np
from numba import njit, prange


@njit(cache=True, parallel=True)
def label_votes(x, radius, views, thresholds, consensus):
    """Write on which balls (x, radius) the views' masks agree, as specified by the twin.

    views: (depths inside the masks, flat; start of each view; sizes [v,2]; pinholes [v,4]; c2w).
    """
    depth, starts, sizes, pinholes, c2w = views
    min_votes, min_fraction, min_baseline = thresholds
    for i in prange(x.shape[0]):
        votes, observers, first, wide = 0, 0, 0, False
        for v in range(c2w.shape[0]):
            pose, pinhole = c2w[v], pinholes[v]
            dx, dy, dz = x[i, 0] - pose[0, 3], x[i, 1] - pose[1, 3], x[i, 2] - pose[2, 3]
            z = dx * pose[0, 2] + dy * pose[1, 2] + dz * pose[2, 2]
            if not z > radius[i]:
                continue
            across = dx * pose[0, 0] + dy * pose[1, 0] + dz * pose[2, 0]
            down = dx * pose[0, 1] + dy * pose[1, 1] + dz * pose[2, 1]
            inverse_z = np.float32(1.0) / z
            column = np.floor(pinhole[0] * across * inverse_z + pinhole[2])
            row = np.floor(pinhole[1] * down * inverse_z + pinhole[3])
            height, width = sizes[v, 0], sizes[v, 1]
            if not (column >= 0 and column < width and row >= 0 and row < height):
                continue
            observers += 1
            inside = depth[starts[v] + np.int64(row) * width + np.int64(column)]
            footprint = radius[i] * max(pinhole[0], pinhole[1]) * inverse_z
            if inside < 1 or inside - np.float32(1.0) < footprint:
                continue
            if votes == 0:
                first = v
            else:
                baseline = np.float32(0.0)
                for k in range(3):
                    baseline += (c2w[first, k, 3] - pose[k, 3]) ** 2
                wide |= baseline > min_baseline * min_baseline
            votes += 1
        consensus[i] = wide and votes >= min_votes and votes >= min_fraction * observers
