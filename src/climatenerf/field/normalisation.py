"""Where the scene is: the ball that the field resolves best, and how near matter may be."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class Extent:
    """Core of a scene, world metres."""

    centre: tuple[float, float, float]
    unit: float
    """Radius of the core, m: one grid unit."""
    near: float
    """Matter nearer to a camera than this (m) is not believed."""


def find_extent(c2w: Float[np.ndarray, "v 4 4"], points: Float[np.ndarray, "n 3"] | None) -> Extent:
    """Core that holds the cameras and most of what they look at.

    Args:
        c2w: cameras, OpenCV axes, world metres.
        points: sparse points, world metres, or None; without them the cameras' common point of
            interest (nearest to all optical axes) stands in.
    """
    eyes = c2w[:, :3, 3]
    if points is not None and points.shape[0] >= 50:
        depths = _depths(c2w, points)
        middle = (eyes.mean(0) + np.median(points, axis=0)) / 2
        reach = np.quantile(np.linalg.norm(points - middle, axis=1), 0.6)
        near = 0.5 * float(np.quantile(depths, 0.01)) if depths.size else np.inf
    else:
        middle = focus_point(c2w)
        reach = np.linalg.norm(eyes - middle, axis=1).mean()
        near = np.inf
    camera_reach = np.quantile(np.linalg.norm(eyes - middle, axis=1), 0.95)
    unit = float(max(reach, camera_reach / 1.25))
    x, y, z = (float(v) for v in middle)
    return Extent((x, y, z), unit, float(np.clip(near, 0.005 * unit, 0.1 * unit)))


def focus_point(c2w: Float[np.ndarray, "v 4 4"]) -> Float[np.ndarray, "3"]:
    """Point nearest to all optical axes; for parallel axes, a point ahead of the cameras."""
    eyes, forward = c2w[:, :3, 3], c2w[:, :3, 2]
    # 1e-6: cameras in one place, of which none is ahead of another.
    spread = max(float(np.linalg.norm(eyes - eyes.mean(0), axis=1).mean()), 1e-6)
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    # The small pull to a point ahead makes parallel axes solvable.
    ahead = eyes.mean(0) + 3 * spread * forward.mean(0)
    pull = 1e-2 * len(eyes)
    left = across.sum(0) + pull * np.eye(3)
    right = (across @ eyes[:, :, None]).sum(0)[:, 0] + pull * ahead
    point = np.linalg.solve(left, right)
    in_front = ((point - eyes) * forward).sum(-1) > 0
    return point if in_front.mean() > 0.6 else ahead


def _depths(
    c2w: Float[np.ndarray, "v 4 4"], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "m"]:
    """Distances ahead of the cameras of the points within a 45° cone around their axes."""
    some = points[:: max(1, points.shape[0] // 2000)]
    offset = some[None] - c2w[:: max(1, len(c2w) // 40), None, :3, 3]
    ahead = (offset * c2w[:: max(1, len(c2w) // 40), None, :3, 2]).sum(-1)
    distance = np.linalg.norm(offset, axis=-1)
    return distance[ahead > 0.7 * distance]
