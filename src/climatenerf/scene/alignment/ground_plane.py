"""Ground from sparse points: height under the camera path, lowest height, and plane.

The frame has its z axis up and any unit of length. Only geometry is used: predicted labels confuse
leaf litter and concrete banks with vegetation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

MAX_POINTS = 50_000
MAX_CAMERAS = 64
_NEAREST_POINTS = 60  # around a camera, for a first estimate of its height above the ground
_NEAREST_CELLS = 20  # around a camera, for the ground height below it
_MAX_DISTANCE = 12.0  # camera heights: horizontal distance from the path to ground that is used
_MAX_COORDINATE = 1e12  # squares and cell numbers of points beyond (sky, mismatches) overflow


@dataclass(frozen=True)
class Ground:
    """Ground around a camera path, in the frame and unit of the points.

    Attributes:
        under_path: Median ground height under the cameras.
        camera_height: Median height of the cameras above the ground below them, > 0.
        spread: Relative spread of that height (half the 16 % to 84 % range over the median).
        lowest: 3 % percentile of the ground heights near the path.
        cells: Low points of the grid cells near the path: ground, and surfaces of objects on it.
    """

    under_path: float
    camera_height: float
    spread: float
    lowest: float
    cells: Float[np.ndarray, "n 3"]


def find_ground(
    points: Float[np.ndarray, "n 3"], cameras: Float[np.ndarray, "m 3"]
) -> Ground | None:
    """Return the ground below cameras, or None if too few points lie below them.

    The points are first reduced to one low point per cell of a horizontal grid, so that dense
    foliage has no more weight than bare ground. Cells are half a camera height wide. The ground
    height at a camera is the median of the cells around it, weighted by proximity.

    Args:
        points: Sparse points, z up.
        cameras: Camera positions in the same frame and unit.
    """
    cameras = cameras[:: max(1, len(cameras) // MAX_CAMERAS)]
    points = points[np.abs(points).max(axis=-1, initial=0.0) < _MAX_COORDINATE]
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
    coarse_height = float(np.median([_coarse_height(below, c) for c in cameras]))
    if not coarse_height > 0:
        return None
    cells = _low_cells(below, coarse_height / 2)
    distance = np.linalg.norm(cells[:, None, :2] - cameras[None, :, :2], axis=-1)
    ground_z = np.array(
        [
            _ground_below(cells, distance[:, i], coarse_height, cameras[i, 2])
            for i in range(len(cameras))
        ]
    )
    heights = cameras[:, 2] - ground_z
    camera_height = float(np.median(heights))
    if not camera_height > 0:
        return None
    low, high = np.percentile(heights, [16, 84])
    near = cells[distance.min(axis=1) < _MAX_DISTANCE * camera_height]
    near = near if len(near) >= 10 else cells
    return Ground(
        under_path=float(np.median(ground_z)),
        camera_height=camera_height,
        spread=float(0.5 * (high - low) / camera_height),
        lowest=float(min(np.percentile(near[:, 2], 3), np.median(ground_z))),
        cells=near,
    )


def _coarse_height(points: Float[np.ndarray, "n 3"], camera: Float[np.ndarray, " 3"]) -> float:
    """Return a camera's height above the 20th percentile of the horizontally nearest points."""
    distance = np.hypot(points[:, 0] - camera[0], points[:, 1] - camera[1])
    count = min(_NEAREST_POINTS, len(distance))
    nearest = np.argpartition(distance, count - 1)[:_NEAREST_POINTS]
    return float(camera[2] - np.percentile(points[nearest, 2], 20))


def _low_cells(points: Float[np.ndarray, "n 3"], size: float) -> Float[np.ndarray, "m 3"]:
    """Return one point per cell: the mean x and y and the 10th percentile of z.

    Cells with fewer than three points are dropped if at least 20 others remain. They contain most
    of the stray points below the ground (mirror images, mismatches).

    Args:
        points: Points, z up.
        size: Side of a square cell.
    """
    # The clip at 2^40 cells avoids an overflow of the conversion to int; such points share a cell.
    key = np.floor(np.clip(points[:, :2] / size, -(2.0**40), 2.0**40)).astype(np.int64)
    _, cell, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    cell = cell.reshape(-1)
    order = np.lexsort((points[:, 2], cell))
    start = np.concatenate([[0], np.cumsum(count)[:-1]])
    low = points[order, 2][start + (count * 0.1).astype(np.int64)]
    x = np.bincount(cell, points[:, 0]) / count
    y = np.bincount(cell, points[:, 1]) / count
    out = np.stack([x, y, low], axis=-1)
    reliable = count >= 3
    return out[reliable] if reliable.sum() >= 20 else out


def _ground_below(
    cells: Float[np.ndarray, "n 3"],
    distance: Float[np.ndarray, " n"],
    camera_height: float,
    camera_z: float,
) -> float:
    """Return the ground height at a camera: weighted median of the nearest cells below it.

    Args:
        cells: Low points of the cells.
        distance: Horizontal distance of each cell from the camera.
        camera_height: Coarse height above the ground, which sets the width of the weights.
        camera_z: Height of the camera in the frame of the cells.
    """
    usable = np.nonzero(cells[:, 2] < camera_z)[0]
    if not len(usable):
        return float(np.median(cells[:, 2]))
    nearest = usable[np.argsort(distance[usable])[:_NEAREST_CELLS]]
    # A steep fall-off, because beside a bridge or a bank the ground changes within a few metres.
    weight = 1.0 / (distance[nearest] ** 2 + (0.5 * camera_height) ** 2) ** 2
    order = np.argsort(cells[nearest, 2])
    centre = np.cumsum(weight[order]) - 0.5 * weight[order]
    return float(np.interp(0.5 * weight.sum(), centre, cells[nearest[order], 2]))


def ground_plane(
    ground: Ground, max_tilt: float = 20.0
) -> tuple[Float[np.ndarray, " 3"], float] | None:
    """Return the normal (unit, z > 0) of the plane of most ground cells, and their fraction.

    The plane is found by RANSAC and refined by least squares on the inliers. Cells well below a
    plane reduce its score, because no surface lies under the ground.

    Args:
        ground: Result of `find_ground`.
        max_tilt: Largest angle between the normal and the z axis, degrees.

    Returns:
        None if no plane contains 35 % of the cells, or its cells are collinear.
    """
    cells, tolerance = ground.cells, 0.08 * ground.camera_height
    if len(cells) < 12:
        return None
    random = np.random.default_rng(0)
    a, b, c = cells[random.integers(len(cells), size=(3, 1500))]
    normal = np.cross(b - a, c - a)
    size = np.linalg.norm(normal, axis=-1)
    # 1e-30: collinear triples have no normal; `keep` excludes them.
    normal = normal / np.maximum(size, 1e-30)[:, None]
    normal *= np.where(normal[:, 2] < 0, -1.0, 1.0)[:, None]
    keep = (size > 0) & (normal[:, 2] > np.cos(np.radians(max_tilt)))
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
        width = np.sqrt(max(values[1], 0.0))
        inlier = np.abs((cells - centre) @ plane) < tolerance
        if inlier.sum() < 6:
            return None
    fraction = float(inlier.mean())
    tilt = np.degrees(np.arccos(np.clip(plane[2], -1, 1)))
    if fraction < 0.35 or width < 0.5 * ground.camera_height or tilt > max_tilt:
        return None
    return plane, fraction
