"""Ground from sparse points: its height under the camera path, its lowest part, its plane.

Everything here works in a frame whose z axis is up, in any unit of length. No labels are used:
predicted ones call leaf litter and concrete banks vegetation, so geometry alone decides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

MAX_POINTS = 50_000
MAX_CAMERAS = 64
_NEAREST = 60  # points around a camera that give its first ground height
_NEAREST_CELLS = 20
_REACH = 12.0  # camera heights: ground further off says nothing about the place


@dataclass(frozen=True)
class Ground:
    """Ground around a camera path, in the frame and unit of the points it came from.

    Attributes:
        under_path: Median ground height under the cameras.
        camera_height: Median height of the cameras above the ground below each of them, > 0.
        spread: Relative spread of that height (half the 16 % to 84 % range over the median).
        lowest: Low (3 %) percentile of the ground heights within reach.
        cells: Low points of small cells within reach: the ground, with whatever stands on it.
    """

    under_path: float
    camera_height: float
    spread: float
    lowest: float
    cells: Float[np.ndarray, "n 3"]


def find_ground(
    points: Float[np.ndarray, "n 3"], cameras: Float[np.ndarray, "m 3"]
) -> Ground | None:
    """Ground below cameras, or None if too few points lie below them.

    Points are first thinned to the low end of each cell of a horizontal net with half a camera
    height between its lines, so that dense foliage counts no more than bare ground; then each
    camera takes the median of the cells around it, the nearer the weightier.

    Args:
        points: Sparse points, z up.
        cameras: Camera positions in the same frame.
    """
    cameras = cameras[:: max(1, len(cameras) // MAX_CAMERAS)]
    # Points at infinity (sky, mismatches) would overflow squares and cell numbers.
    points = points[np.abs(points).max(axis=-1, initial=0.0) < 1e12]
    if not len(points):
        return None
    distance = np.abs(points - cameras.mean(axis=0)).max(axis=-1)
    below = points[
        (points[:, 2] < np.median(cameras[:, 2])) & (distance < 100 * np.median(distance))
    ]
    if len(below) > MAX_POINTS:
        below = below[np.random.default_rng(0).permutation(len(below))[:MAX_POINTS]]
    if len(below) < 20:
        return None
    first = float(np.median([_drop(below, c) for c in cameras]))
    if not first > 0:
        return None
    cells = _low_cells(below, first / 2)
    gap = np.linalg.norm(cells[:, None, :2] - cameras[None, :, :2], axis=-1)
    heights = np.array(
        [_ground_at(cells, gap[:, i], first, cameras[i, 2]) for i in range(len(cameras))]
    )
    drops = cameras[:, 2] - heights
    camera_height = float(np.median(drops))
    if not camera_height > 0:
        return None
    low, high = np.percentile(drops, [16, 84])
    near = cells[gap.min(axis=1) < _REACH * camera_height]
    near = near if len(near) >= 10 else cells
    return Ground(
        under_path=float(np.median(heights)),
        camera_height=camera_height,
        spread=float(0.5 * (high - low) / camera_height),
        lowest=float(min(np.percentile(near[:, 2], 3), np.median(heights))),
        cells=near,
    )


def _drop(points: Float[np.ndarray, "n 3"], camera: Float[np.ndarray, " 3"]) -> float:
    """How far the ground is below a camera: low end of the horizontally nearest points."""
    gap = np.hypot(points[:, 0] - camera[0], points[:, 1] - camera[1])
    nearest = np.argpartition(gap, min(_NEAREST, len(gap)) - 1)[:_NEAREST]
    return float(camera[2] - np.percentile(points[nearest, 2], 20))


def _low_cells(points: Float[np.ndarray, "n 3"], size: float) -> Float[np.ndarray, "m 3"]:
    """One point a cell: its mean position and the 10th percentile of its heights.

    Cells with fewer than three points are left out while enough others remain: they are where
    stray points below the ground (mirror images, mismatches) live.
    """
    # Beyond 2^40 cells a point may share the last one; the conversion to int would overflow.
    key = np.floor(np.clip(points[:, :2] / size, -(2.0**40), 2.0**40)).astype(np.int64)
    _, cell, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    cell = cell.reshape(-1)
    order = np.lexsort((points[:, 2], cell))
    start = np.concatenate([[0], np.cumsum(count)[:-1]])
    low = points[order, 2][start + (count * 0.1).astype(np.int64)]
    x = np.bincount(cell, points[:, 0]) / count
    y = np.bincount(cell, points[:, 1]) / count
    out = np.stack([x, y, low], axis=-1)
    full = count >= 3
    return out[full] if full.sum() >= 20 else out


def _ground_at(
    cells: Float[np.ndarray, "n 3"], gap: Float[np.ndarray, " n"], reach: float, camera_z: float
) -> float:
    """Ground height at a camera: median of the nearest cells, the nearer the weightier."""
    usable = np.nonzero(cells[:, 2] < camera_z)[0]
    if not len(usable):
        return float(np.median(cells[:, 2]))
    nearest = usable[np.argsort(gap[usable])[:_NEAREST_CELLS]]
    # Falls steeply: beside a bridge or a bank the ground a few metres on is another ground.
    weight = 1.0 / (gap[nearest] ** 2 + (0.5 * reach) ** 2) ** 2
    order = np.argsort(cells[nearest, 2])
    middle = np.cumsum(weight[order]) - 0.5 * weight[order]
    return float(np.interp(0.5 * weight.sum(), middle, cells[nearest[order], 2]))


def ground_plane(
    ground: Ground, most_tilt: float = 20.0
) -> tuple[Float[np.ndarray, " 3"], float] | None:
    """Normal (z > 0) of the plane that most ground cells lie on, and their share.

    RANSAC, with cells well below the plane counting against it (nothing lies under the ground),
    then least squares on the inliers.

    Args:
        ground: From `find_ground`.
        most_tilt: Largest angle between the normal and the z axis, degrees.

    Returns:
        None if no plane holds 35 % of the cells, or its cells are all in one line.
    """
    cells, tolerance = ground.cells, 0.08 * ground.camera_height
    if len(cells) < 12:
        return None
    random = np.random.default_rng(0)
    a, b, c = cells[random.integers(len(cells), size=(3, 1500))]
    normal = np.cross(b - a, c - a)
    size = np.linalg.norm(normal, axis=-1)
    # A triple on one line spans no plane; it gets no direction and no vote.
    normal = normal / np.maximum(size, 1e-30)[:, None]
    normal *= np.where(normal[:, 2] < 0, -1.0, 1.0)[:, None]
    keep = (size > 0) & (normal[:, 2] > np.cos(np.radians(most_tilt)))
    if not keep.any():
        return None
    normal, anchor = normal[keep], a[keep]
    offset = cells @ normal.T - (anchor * normal).sum(axis=-1)
    score = (np.abs(offset) < tolerance).sum(axis=0) - (offset < -2 * tolerance).sum(axis=0)
    best = int(score.argmax())
    inlier = np.abs(offset[:, best]) < tolerance
    plane = normal[best]
    for _ in range(5):
        centre = cells[inlier].mean(axis=0)
        values, vectors = np.linalg.eigh(np.cov((cells[inlier] - centre).T))
        plane = vectors[:, 0] * (1.0 if vectors[2, 0] > 0 else -1.0)
        wide = np.sqrt(max(values[1], 0.0))
        inlier = np.abs((cells - centre) @ plane) < tolerance
        if inlier.sum() < 6:
            return None
    share = float(inlier.mean())
    tilt = np.degrees(np.arccos(np.clip(plane[2], -1, 1)))
    if share < 0.35 or wide < 0.5 * ground.camera_height or tilt > most_tilt:
        return None
    return plane, share
