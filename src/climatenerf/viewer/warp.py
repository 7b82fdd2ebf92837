"""A finished picture seen from another pose, by its own depth: what is shown while one moves.

Each pixel of the new picture looks for the point that it shows by fixed-point iteration: the depth
that the old picture has where the last guess is projected to. Nothing is left empty; what the old
picture does not show is smeared. Reflections move with the surface, which is wrong.
"""

import math

import numba
import numpy as np
from jaxtyping import Float, UInt8

from climatenerf.core.cameras import Camera

ITERATIONS = 4
FAR = 1e5  # m, at which the sky is taken to lie


def warped(
    picture: UInt8[np.ndarray, "h w 3"],
    depth: Float[np.ndarray, "h w"],
    pinhole: Camera,
    c2w: Float[np.ndarray, "4 4"],
    to: Camera,
    to_c2w: Float[np.ndarray, "4 4"],
) -> UInt8[np.ndarray, "H W 3"]:
    """Return a picture as it is seen from another pose.

    Args:
        picture: finished picture.
        depth: ray lengths of its pixels, m; +inf for the sky. May be smaller than the picture.
        pinhole: its camera, without distortion.
        c2w: its pose, world m.
        to: camera of the new picture, without distortion.
        to_c2w: pose of the new picture, world m.
    """
    small = pinhole.resized(depth.shape[1], depth.shape[0])
    out = np.empty((to.height, to.width, 3), np.uint8)
    shift = (c2w[:3, :3].T @ (to_c2w[:3, 3] - c2w[:3, 3])).astype(np.float64)
    turn = (c2w[:3, :3].T @ to_c2w[:3, :3]).astype(np.float64)
    far = np.where(np.isfinite(depth), depth, FAR).astype(np.float64)
    source = np.array([small.fx, small.fy, small.cx, small.cy])
    target = np.array([to.fx, to.fy, to.cx, to.cy])
    _warp(picture, far, source, shift, turn, target, out)
    return out


@numba.njit(nogil=True, cache=True, fastmath=True)
def _warp(picture, depth, source, shift, turn, target, out):
    rows, columns = depth.shape
    across, down = picture.shape[1] / columns, picture.shape[0] / rows
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            x = (column + 0.5 - target[2]) / target[0]
            y = (row + 0.5 - target[3]) / target[1]
            length = math.sqrt(x * x + y * y + 1)
            dx = (turn[0, 0] * x + turn[0, 1] * y + turn[0, 2]) / length
            dy = (turn[1, 0] * x + turn[1, 1] * y + turn[1, 2]) / length
            dz = (turn[2, 0] * x + turn[2, 1] * y + turn[2, 2]) / length
            t, i, j = FAR, 0, 0
            for _ in range(ITERATIONS):
                px, py, pz = shift[0] + t * dx, shift[1] + t * dy, shift[2] + t * dz
                pz = max(pz, 1e-3)  # behind the old camera
                i = int(min(max(source[1] * py / pz + source[3], 0.0), rows - 1.0))
                j = int(min(max(source[0] * px / pz + source[2], 0.0), columns - 1.0))
                # The point on the new ray that is as far from the old eye as what it shows there.
                along = shift[0] * dx + shift[1] * dy + shift[2] * dz
                away = shift[0] ** 2 + shift[1] ** 2 + shift[2] ** 2 - depth[i, j] ** 2
                t = -along + math.sqrt(max(along * along - away, 0.0))
                t = max(t, 1e-3)
            px, py, pz = shift[0] + t * dx, shift[1] + t * dy, shift[2] + t * dz
            pz = max(pz, 1e-3)
            v = (source[1] * py / pz + source[3]) * down
            u = (source[0] * px / pz + source[2]) * across
            i = int(min(max(v, 0.0), picture.shape[0] - 1.0))
            j = int(min(max(u, 0.0), picture.shape[1] - 1.0))
            for k in range(3):
                out[row, column, k] = picture[i, j, k]
