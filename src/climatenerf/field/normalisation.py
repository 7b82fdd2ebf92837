"""Normalisation of a scene: the ball that the field resolves best, and the near distance."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class Extent:
    """Core of a scene, in world metres."""

    centre: tuple[float, float, float]
    unit: float
    """Radius of the core, m: one grid unit."""
    near: float
    """Ray length at which camera rays begin, m; nothing nearer to a camera is rendered."""


def find_extent(c2w: Float[np.ndarray, "v 4 4"], points: Float[np.ndarray, "n 3"] | None) -> Extent:
    """Return the core that holds the cameras and most of what they look at.

    Args:
        c2w: cameras, OpenCV axes, world metres.
        points: sparse points, world metres. With None or fewer than 50 the centre is the point
            nearest to all optical axes.
    """
    eyes = c2w[:, :3, 3]
    if points is not None and points.shape[0] >= 50:
        depths = _depths(c2w, points)
        middle = (eyes.mean(0) + np.median(points, axis=0)) / 2
        radius = np.quantile(np.linalg.norm(points - middle, axis=1), 0.6)
        near = 0.5 * float(np.quantile(depths, 0.01)) if depths.size else np.inf
    else:
        middle = focus_point(c2w)
        radius = np.linalg.norm(eyes - middle, axis=1).mean()
        near = np.inf
    camera_radius = np.quantile(np.linalg.norm(eyes - middle, axis=1), 0.95)
    unit = float(max(radius, camera_radius / 1.25))
    x, y, z = (float(v) for v in middle)
    return Extent((x, y, z), unit, float(np.clip(near, 0.005 * unit, 0.1 * unit)))


def focus_point(c2w: Float[np.ndarray, "v 4 4"]) -> Float[np.ndarray, "3"]:
    """Return the point nearest to all optical axes; for parallel axes one ahead of the cameras."""
    eyes, forward = c2w[:, :3, 3], c2w[:, :3, 2]
    # 1e-6: cameras at one position have no spread.
    spread = max(float(np.linalg.norm(eyes - eyes.mean(0), axis=1).mean()), 1e-6)
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    # A weak pull towards a point ahead makes the system solvable for parallel axes.
    ahead = eyes.mean(0) + 3 * spread * forward.mean(0)
    pull = 1e-2 * len(eyes)
    matrix = across.sum(0) + pull * np.eye(3)
    right_side = (across @ eyes[:, :, None]).sum(0)[:, 0] + pull * ahead
    point = np.linalg.solve(matrix, right_side)
    in_front = ((point - eyes) * forward).sum(-1) > 0
    return point if in_front.mean() > 0.6 else ahead


def _depths(
    c2w: Float[np.ndarray, "v 4 4"], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "m"]:
    """Return the distances (m) of points within a 45° cone around the cameras' axes.

    At most about 2000 points and 40 cameras are taken.
    """
    subset = points[:: max(1, points.shape[0] // 2000)]
    offset = subset[None] - c2w[:: max(1, len(c2w) // 40), None, :3, 3]
    ahead = (offset * c2w[:: max(1, len(c2w) // 40), None, :3, 2]).sum(-1)
    distance = np.linalg.norm(offset, axis=-1)
    return distance[ahead > 0.7 * distance]
