"""The ground that catches snow: where fall rays are stopped, how smooth it is and how steep."""

import math

import numpy as np
from jaxtyping import Float, Float32, Int
from numba import njit, prange


@njit(cache=True, parallel=True)
def halfway(
    offsets: Int[np.ndarray, "n+1"],
    t: Float32[np.ndarray, "s"],
    dt: Float32[np.ndarray, "s"],
    sigma: Float32[np.ndarray, "s"],
    before: Float[np.ndarray, "n"],
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Where the optical depth of each ray passes ln 2, half of its light being gone.

    Args:
        offsets: samples of ray r are offsets[r]:offsets[r + 1].
        t: middle of each sample, m.
        dt: its extent, m.
        sigma: its extinction, 1/m.
        before: optical depth that each ray has behind it already.

    Returns:
        Ray length, m (NaN: not on this stretch), and the optical depth at the end.
    """
    n = offsets.shape[0] - 1
    where = np.full(n, np.nan)
    depth = before.copy()
    for r in prange(n):
        for q in range(offsets[r], offsets[r + 1]):
            thick = sigma[q] * dt[q]
            if depth[r] < math.log(2) <= depth[r] + thick:
                where[r] = t[q] - dt[q] / 2 + (math.log(2) - depth[r]) / sigma[q]
            depth[r] += thick
    return where, depth


@njit(cache=True, parallel=True)
def smooth_ground(
    hits: Float32[np.ndarray, "h w 3"], fall: Float[np.ndarray, "3"], tolerance: float, base: int
) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"]]:
    """Smoothed hits, and the cosine of the surface's slope there.

    Heights are averaged over pairs of opposite neighbours that lie within 3 `tolerance` of the
    middle: a plane stays exactly as it is, and steps (a kerb, the rim of a roof) stay sharp. The
    slope along each axis is the smaller of those on either side, and 0 where they disagree in
    sign, so that the rim of a roof and the top of a wall count as flat.

    Args:
        hits: one for each ray of the grid, NaN where there is none.
        fall: fall direction, scaled to z = -1.
        tolerance: roughness that is smoothed away, m.
        base: cells over which the slope is taken: snow bridges what is rough below that.

    Returns:
        The hits, moved along their rays, and cosines (0 where there is no hit).
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
                    up, down = hits[ja, ia, 2] - z, hits[jb, ib, 2] - z
                    far = max(abs(up), abs(down)) / tolerance
                    # NaN, no hit, on one side: max may return the other side.
                    if math.isnan(up + down) or far > 3:
                        continue
                    share = math.exp(-(a * a + b * b) / 3 - far * far / 2)
                    total += 2 * share
                    moment += share * (up + down)
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
            # The fall's drift can fold the tangents onto each other: no area, no normal, no 0/0.
            cosine[j, i] = abs(nz) / max(math.sqrt(nx * nx + ny * ny + nz * nz), 1e-9)
    return smooth, cosine


@njit(cache=True)
def _tangent(
    points: Float32[np.ndarray, "h w 3"], j: int, i: int, dj: int, di: int
) -> tuple[float, float, float]:
    """Tangent along one axis of the grid, from the side on which the surface is flatter."""
    rows, columns = points.shape[:2]
    best = np.inf
    tangent = (1.0, 0.0, 0.0) if di > 0 else (0.0, 1.0, 0.0)
    signs = 0.0
    for side in (-1, 1):
        row, column = j + side * dj, i + side * di
        if row < 0 or column < 0 or row >= rows or column >= columns:
            continue
        x = (points[row, column, 0] - points[j, i, 0]) * side
        y = (points[row, column, 1] - points[j, i, 1]) * side
        z = (points[row, column, 2] - points[j, i, 2]) * side
        if math.isnan(z):
            continue
        if signs * z < 0:  # a ridge or a groove
            return (1.0, 0.0, 0.0) if di > 0 else (0.0, 1.0, 0.0)
        signs = z
        if abs(z) < best:
            best = abs(z)
            tangent = (x, y, z)
    return tangent
