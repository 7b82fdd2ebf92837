"""The surface that catches snow: hits of fall rays, smoothed, with the cosine of their slope.

Numba kernels; world frame, m, z up.
"""

import math

import numpy as np
from jaxtyping import Float, Float32, Int
from numba import njit, prange


@njit(cache=True, parallel=True)
def depth_crossings(
    offsets: Int[np.ndarray, "n+1"],
    t: Float32[np.ndarray, "s"],
    dt: Float32[np.ndarray, "s"],
    sigma: Float32[np.ndarray, "s"],
    before: Float[np.ndarray, "n"],
    levels: Float[np.ndarray, "k"],
) -> tuple[Float[np.ndarray, "n k"], Float[np.ndarray, "n"]]:
    """Find where the optical depth of each ray reaches some levels; ln 2 is a transmittance of 1/2.

    Args:
        offsets: samples of ray r are offsets[r]:offsets[r + 1].
        t: middle of each sample, m.
        dt: length of each sample, m.
        sigma: extinction of each sample, 1/m.
        before: optical depth of each ray in front of its first sample.
        levels: optical depths, above 0.

    Returns:
        Ray lengths, m (NaN: not reached on this stretch), and the optical depth after the last
        sample.
    """
    n = offsets.shape[0] - 1
    found = np.full((n, levels.shape[0]), np.nan)
    depth = before.copy()
    for r in prange(n):
        for q in range(offsets[r], offsets[r + 1]):
            sample_depth = sigma[q] * dt[q]
            for k in range(levels.shape[0]):
                if depth[r] < levels[k] <= depth[r] + sample_depth:
                    found[r, k] = t[q] - dt[q] / 2 + (levels[k] - depth[r]) / sigma[q]
            depth[r] += sample_depth
    return found, depth


@njit(cache=True, parallel=True)
def smooth_ground(
    hits: Float32[np.ndarray, "h w 3"], fall: Float[np.ndarray, "3"], tolerance: float, base: int
) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"]]:
    """Smooth the hits and return them with the cosine of the surface's slope.

    A bilateral filter averages heights over pairs of opposite neighbours within 3 `tolerance` of
    the centre. A plane is unchanged, and steps (a kerb, the edge of a roof) stay sharp. The slope
    along each axis is the smaller of the one-sided slopes, and 0 where their signs differ. So the
    edge of a roof and the top of a wall count as horizontal.

    Args:
        hits: one for each ray of the grid, m; NaN without a hit.
        fall: fall direction, scaled to z = -1.
        tolerance: height of roughness to smooth away, m.
        base: distance in cells over which slopes are measured; snow bridges finer roughness.

    Returns:
        The hits, moved along their rays, and cosines (0 without a hit).
    """
    rows, columns = hits.shape[:2]
    smooth = hits.copy()
    for j in prange(rows):
        for i in range(columns):
            z = hits[j, i, 2]
            if math.isnan(z):
                continue
            total, moment = 1.0, 0.0
            for b in range(0, 3):
                for a in range(-2, 3):
                    if b == 0 and a <= 0:
                        continue
                    ja, jb, ia, ib = j + b, j - b, i + a, i - a
                    if jb < 0 or ja >= rows or min(ia, ib) < 0 or max(ia, ib) >= columns:
                        continue
                    ahead, behind = hits[ja, ia, 2] - z, hits[jb, ib, 2] - z
                    deviation = max(abs(ahead), abs(behind)) / tolerance
                    # With a NaN (no hit) on one side, max may return the other side.
                    if math.isnan(ahead + behind) or deviation > 3:
                        continue
                    weight = math.exp(-(a * a + b * b) / 3 - deviation * deviation / 2)
                    total += 2 * weight
                    moment += weight * (ahead + behind)
            lift = moment / total
            for axis in range(3):
                smooth[j, i, axis] = hits[j, i, axis] - fall[axis] * lift
    cosine = np.zeros((rows, columns), np.float32)
    for j in prange(rows):
        for i in range(columns):
            if math.isnan(hits[j, i, 2]):
                continue
            ux, uy, uz = _tangent(smooth, j, i, 0, base)
            vx, vy, vz = _tangent(smooth, j, i, base, 0)
            nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
            # An oblique fall can make the tangents parallel; the floor avoids 0/0.
            cosine[j, i] = abs(nz) / max(math.sqrt(nx * nx + ny * ny + nz * nz), 1e-9)
    return smooth, cosine


@njit(cache=True)
def _tangent(
    points: Float32[np.ndarray, "h w 3"], j: int, i: int, dj: int, di: int
) -> tuple[float, float, float]:
    """Return the tangent along one axis of the grid, from the side with the smaller slope."""
    rows, columns = points.shape[:2]
    best = np.inf
    tangent = (1.0, 0.0, 0.0) if di > 0 else (0.0, 1.0, 0.0)
    signs = 0.0
    for side in (-1, 1):
        length = max(dj, di)
        while length > 0:  # shorter where the surface ends sooner
            row, column = j + side * min(dj, length), i + side * min(di, length)
            inside = row >= 0 and column >= 0 and row < rows and column < columns
            if inside and not math.isnan(points[row, column, 2]):
                break
            length //= 2
        if length == 0:
            continue
        x = (points[row, column, 0] - points[j, i, 0]) * side
        y = (points[row, column, 1] - points[j, i, 1]) * side
        z = (points[row, column, 2] - points[j, i, 2]) * side
        if signs * z < 0:  # a ridge or a groove
            return (1.0, 0.0, 0.0) if di > 0 else (0.0, 1.0, 0.0)
        signs = z
        if abs(z) / length < best:
            best = abs(z) / length
            tangent = (x, y, z)
    return tangent
