"""Normals of solid surfaces from a depth picture.

The gradient of a fitted density is noisy. The depth of a ray is an average over its samples and
much smoother, so a plane is fitted to the depth of a few pixels.
"""

import numpy as np
from jaxtyping import Bool, Float

RADIUS = 3  # pixels to each side that a plane is fitted to
MAX_SLOPE = 4.0  # tangent to the line of sight up to which neighbours are one surface


def plane_normals(
    rays_o: Float[np.ndarray, "3"],
    rays_d: Float[np.ndarray, "h w 3"],
    depth: Float[np.ndarray, "h w"],
    pixel_angle: float,
) -> Float[np.ndarray, "h w 3"]:
    """Return unit normals, towards the eye, of planes through each pixel and its neighbours.

    Weighted total least squares: a neighbour's weight falls with its difference in depth, so that
    a plane does not span an edge.

    Args:
        rays_o: the eye, m.
        rays_d: unit directions.
        depth: ray length, m; +inf without a surface.
        pixel_angle: angle that a pixel spans, rad.

    Returns:
        Normals; 0 without a surface, towards the eye where a pixel has no neighbours.
    """
    solid = np.isfinite(depth)
    length = np.where(solid, depth, 0.0)
    points = (rays_o + length[..., None] * rays_d).astype(np.float64)
    tolerance = MAX_SLOPE * RADIUS * pixel_angle * np.maximum(length, 1e-6)  # at the eye: 0/0
    total = np.zeros(depth.shape)
    first = np.zeros((*depth.shape, 3))
    second = np.zeros((*depth.shape, 3, 3))
    for down in range(-RADIUS, RADIUS + 1):
        for right in range(-RADIUS, RADIUS + 1):
            near = _shifted(solid, down, right, False)
            difference = (_shifted(length, down, right, 0.0) - length) / tolerance
            weight = np.where(solid & near, np.exp(-(difference**2)), 0.0)
            offset = _shifted(points, down, right, 0.0) - points
            total += weight
            first += weight[..., None] * offset
            second += weight[..., None, None] * offset[..., :, None] * offset[..., None, :]
    total = np.maximum(total, 1e-9)  # no surface: 0/0
    mean = first / total[..., None]
    spread = second / total[..., None, None] - mean[..., :, None] * mean[..., None, :]
    values, axes = np.linalg.eigh(spread)
    normal = axes[..., 0]
    alone = (
        values[..., 1] < 1e-12 * np.maximum(length, 1e-6) ** 2
    )  # collinear points define no plane
    normal = np.where(alone[..., None], -rays_d, normal)
    away = (normal * rays_d).sum(-1) > 0
    normal = np.where(away[..., None], -normal, normal)
    return (normal * solid[..., None]).astype(np.float32)


def _shifted(
    values: Float[np.ndarray, "h w *c"] | Bool[np.ndarray, "h w"], down: int, right: int, fill
) -> np.ndarray:
    """Return the picture shifted: each pixel holds the value `down` and `right` of it."""
    out = np.full_like(values, fill)
    h, w = values.shape[:2]
    here = slice(max(0, -down), min(h, h - down)), slice(max(0, -right), min(w, w - right))
    there = slice(max(0, down), min(h, h + down)), slice(max(0, right), min(w, w + right))
    out[here] = values[there]
    return out
