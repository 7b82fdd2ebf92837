"""Normals of solid surfaces from a depth picture.

The fitted density is noisy from sample to sample, and so is its gradient; the depth of a ray is an
average over its samples and much smoother. A plane fitted to a few pixels of it is the surface as
it is seen.
"""

import numpy as np
from jaxtyping import Bool, Float

REACH = 3  # pixels to each side that a plane is fitted to
STEEPEST = 4.0  # tangent of the slope to the line of sight up to which neighbours are one surface


def plane_normals(
    rays_o: Float[np.ndarray, "3"],
    rays_d: Float[np.ndarray, "h w 3"],
    depth: Float[np.ndarray, "h w"],
    pixel_angle: float,
) -> Float[np.ndarray, "h w 3"]:
    """Unit normals, towards the eye, of the planes through each pixel and its like neighbours.

    Weighted total least squares: neighbours count less the more their depth differs, so that a
    plane does not reach over an edge.

    Args:
        rays_o: the eye, m.
        rays_d: unit directions.
        depth: ray length, m; +inf where nothing is.
        pixel_angle: angle a pixel spans, rad.

    Returns:
        Normals; 0 where nothing is, towards the eye where a pixel has no neighbours.
    """
    there = np.isfinite(depth)
    length = np.where(there, depth, 0.0)
    points = (rays_o + length[..., None] * rays_d).astype(np.float64)
    tolerance = STEEPEST * REACH * pixel_angle * np.maximum(length, 1e-6)  # at the eye: 0/0
    total = np.zeros(depth.shape)
    first = np.zeros((*depth.shape, 3))
    second = np.zeros((*depth.shape, 3, 3))
    for down in range(-REACH, REACH + 1):
        for right in range(-REACH, REACH + 1):
            near = _shifted(there, down, right, False)
            apart = (_shifted(length, down, right, 0.0) - length) / tolerance
            weight = np.where(there & near, np.exp(-(apart**2)), 0.0)
            offset = _shifted(points, down, right, 0.0) - points
            total += weight
            first += weight[..., None] * offset
            second += weight[..., None, None] * offset[..., :, None] * offset[..., None, :]
    total = np.maximum(total, 1e-9)  # no surface: 0/0
    mean = first / total[..., None]
    spread = second / total[..., None, None] - mean[..., :, None] * mean[..., None, :]
    values, axes = np.linalg.eigh(spread)
    normal = axes[..., 0]
    alone = values[..., 1] < 1e-12 * np.maximum(length, 1e-6) ** 2  # all in a line: no plane
    normal = np.where(alone[..., None], -rays_d, normal)
    away = (normal * rays_d).sum(-1) > 0
    normal = np.where(away[..., None], -normal, normal)
    return (normal * there[..., None]).astype(np.float32)


def _shifted(
    values: Float[np.ndarray, "h w *c"] | Bool[np.ndarray, "h w"], down: int, right: int, fill
) -> np.ndarray:
    """The picture moved so that a pixel holds what lies `down` and `right` of it."""
    out = np.full_like(values, fill)
    h, w = values.shape[:2]
    here = slice(max(0, -down), min(h, h - down)), slice(max(0, -right), min(w, w - right))
    there = slice(max(0, down), min(h, h + down)), slice(max(0, right), min(w, w + right))
    out[here] = values[there]
    return out
