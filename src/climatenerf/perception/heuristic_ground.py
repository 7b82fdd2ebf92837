"""Heuristic ground labels without a network: pixels between the sparse points of the ground.

The ground's height comes from the capture's sparse points: planes through the lowest points around
each position, linked to the ground below the cameras. That classifies a photo's points. From its
ground points the label grows over the photo by a limited distance, in which colour edges count as
extra length, and at most part of the way to a point that is not ground. As for the sky, every
doubtful pixel stays unknown.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from climatenerf.core.cameras import Camera
from climatenerf.core.morphology import geodesic_distance
from climatenerf.perception.heuristic_standing import standing_points
from climatenerf.scene.alignment.ground_plane import find_ground
from climatenerf.scene.scene import Scene, View

# Lengths in camera heights:
_CELL = 0.5  # side of a horizontal cell
_ON_GROUND = 0.07  # largest height above the ground of a point that is ground
_PLANE_RADIUS = 1.2  # scale of the Gaussian weight of a cell in another cell's plane
_GROWTH = 1.0  # distance over a photo that the label grows from a point
_OBSTACLE, _OVERHEAD = 0.12, 1.5  # heights between which a point belongs to an obstacle
_OBSTACLE_CELL = 0.2  # side of the cells in which obstacle and ground points are counted
_BELOW_CAMERA = 2.0  # horizontal distance from a camera within which the ground carries it
_CAMERA_CLEARANCE = 0.3  # least height of a camera above ground that carries it

_RANGE = 4  # cells to each side that a plane uses
_MAX_SLOPE = 0.8  # of the ground
_MIN_SUPPORT = 3.0  # sum of weights of the cells of a plane
_ITERATIONS = 6  # of reweighted least squares
_OBSTACLE_RATIO = 0.2  # obstacle points over ground points nearby that make a point doubtful
_MIN_POINTS = 4  # of ground in a photo
_MAX_SINE = -0.05  # of a ray's elevation: the farthest ground is 20 camera heights away
_EDGE_LENGTH = 25.0  # extra length of a step, times its colour change, display values in [0,1]
_EDGE_THRESHOLD, _EDGE_COST = 0.15, 5.0  # colour change of a border; its cost per change beyond
_MAX_PART = 0.4  # of the way to a point that is not ground
_MAX_SIZE = 500  # px of the longer side at which the label is grown


@dataclass(frozen=True)
class GroundPoints:
    """Classification of a capture's sparse points.

    Attributes:
        points: All sparse points, world metres.
        is_ground: Which of them lie on the ground.
        stands: Which of them certainly lie above it.
        camera_height: Median height of the cameras above the ground, metres.
    """

    points: Float[np.ndarray, "n 3"]
    is_ground: Bool[np.ndarray, " n"]
    stands: Bool[np.ndarray, " n"]
    camera_height: float


def classify_ground_points(scene: Scene) -> GroundPoints | None:
    """Classify the sparse points of a capture with z up; None if no ground is found."""
    points = scene.points_world()
    if points is None or all(view.seen is None for view in scene.views):
        return None
    cameras = np.stack([scene.c2w_world(view)[:3, 3] for view in scene.views])
    ground = find_ground(points, cameras)
    if ground is None:
        return None
    height = ground.camera_height
    is_ground = _on_ground(points / height, ground.cells / height, cameras / height)
    if not is_ground.any():
        return None
    return GroundPoints(points, is_ground, standing_points(points, is_ground, height), height)


def observed_pixels(
    view: View, scene: Scene, camera: Camera, points: Float[np.ndarray, "n 3"]
) -> tuple[Int[np.ndarray, "m 2"], Int[np.ndarray, " m"]]:
    """Return the pixels (x, y) of the sparse points that a photo observes, and their indices.

    Args:
        view: The photo.
        scene: The capture with z up.
        camera: The photo's camera at the working size.
        points: All sparse points, world metres.
    """
    if view.seen is None or not len(view.seen):
        return np.zeros((0, 2), np.int64), np.zeros(0, np.int64)
    pose = scene.c2w_world(view)
    pixels = camera.project((points[view.seen] - pose[:3, 3]) @ pose[:3, :3])
    pixels = np.floor(np.where(np.isfinite(pixels), pixels, -1).clip(-1, 1e6)).astype(np.int64)
    inside = ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(axis=-1)
    return pixels[inside], np.asarray(view.seen)[inside]


def segment_ground(
    view: View,
    scene: Scene,
    camera: Camera,
    ground: GroundPoints,
    rays: Float[np.ndarray, "h w 3"],
    values: Float[np.ndarray, "h w 3"],
) -> Bool[np.ndarray, "h w"]:
    """Return where a photo certainly shows ground.

    Args:
        view: The photo.
        scene: The capture with z up.
        camera: The photo's camera at the working size h w.
        ground: The capture's classified points.
        rays: Unit directions of the pixels' rays, world axes.
        values: The photo, display values in [0,1].
    """
    height, width, _ = values.shape
    nothing = np.zeros((height, width), bool)
    if view.seen is None or not len(view.seen):
        return nothing
    # Half the resolution or less is enough: the label's border is a few pixels inside the ground.
    step = -(-max(height, width) // _MAX_SIZE)
    rays, values = rays[::step, ::step], values[::step, ::step]
    pose = scene.c2w_world(view)
    pixels, seen = observed_pixels(view, scene, camera, ground.points)
    pixels //= step
    points, is_ground = ground.points[seen], ground.is_ground[seen]
    if is_ground.sum() < _MIN_POINTS:
        return nothing
    eye_height = float(np.median(pose[2, 3] - points[is_ground, 2]))
    below = rays[..., 2] < _MAX_SINE
    if eye_height <= 0.1 * ground.camera_height or not below.any():
        return nothing
    # Horizontal offset at which each ray meets level ground, in units of the growth distance.
    offset = rays[..., :2] * (eye_height / np.maximum(-rays[..., 2:], -_MAX_SINE))
    offset = np.where(below[..., None], offset, 1e3 * eye_height)
    offset = offset / (_GROWTH * ground.camera_height)
    costs = []
    for axis in (0, 1):
        length = np.linalg.norm(np.diff(offset, axis=axis), axis=-1)
        change = np.abs(np.diff(values, axis=axis)).max(axis=-1)
        # Texture lengthens a step in proportion; a border costs the same at any distance.
        border = _EDGE_COST * np.maximum(change - _EDGE_THRESHOLD, 0)
        costs.append(length * (1 + _EDGE_LENGTH * change) + border)
    to_ground = geodesic_distance(pixels[is_ground], costs)
    to_other = geodesic_distance(pixels[~is_ground], costs)
    found = below & (to_ground < 1) & (to_ground < _MAX_PART / (1 - _MAX_PART) * to_other)
    return found.repeat(step, axis=0).repeat(step, axis=1)[:height, :width]


def _on_ground(
    points: Float[np.ndarray, "n 3"],
    cells: Float[np.ndarray, "m 3"],
    cameras: Float[np.ndarray, "k 3"],
) -> Bool[np.ndarray, " n"]:
    """Return which points lie on the ground; all lengths in camera heights.

    Args:
        points: The points.
        cells: Low points of small cells, from `find_ground`.
        cameras: Camera centres.
    """
    cells, keys = _lowest_per_cell(cells)
    near, far = _pairs(keys, keys, _RANGE)
    gap = cells[far, :2] - cells[near, :2]
    length = np.hypot(gap[:, 0], gap[:, 1])
    # Initial weights: no ground is higher than its neighbours allow at the largest slope.
    envelope = np.full(len(cells), np.inf)
    np.minimum.at(envelope, near, cells[far, 2] + _MAX_SLOPE * length)
    weight = (cells[:, 2] - envelope < 2 * _ON_GROUND).astype(np.float64)
    closeness = np.exp(-((length / _PLANE_RADIUS) ** 2))
    planes, support = np.zeros((len(cells), 3)), np.zeros(len(cells))
    for _ in range(_ITERATIONS):
        planes, support = _fit_planes(near, gap, cells[far, 2], closeness * weight[far], len(cells))
        residual = (cells[:, 2] - planes[:, 0]) / _ON_GROUND
        # Few outliers lie below the ground, so negative residuals count half.
        weight = 1 / (1 + np.where(residual > 0, residual, 0.5 * residual) ** 4)
    good = np.hypot(planes[:, 1], planes[:, 2]) < _MAX_SLOPE
    good &= (support > _MIN_SUPPORT) & (np.abs(cells[:, 2] - planes[:, 0]) < _ON_GROUND)
    good &= _linked_to_cameras(cells, good, near, far, length, cameras)
    cells, keys, planes = cells[good], keys[good], planes[good]
    is_ground = np.zeros(len(points), bool)
    if not len(cells):
        return is_ground
    usable = np.flatnonzero(np.abs(points).max(axis=-1) < 1e6)
    point, cell = _pairs(_keys(points[usable]), keys, 1)
    offset = points[usable[point]] - cells[cell]
    offset[:, 2] += cells[cell, 2] - planes[cell, 0]
    height = offset[:, 2] - (offset[:, :2] * planes[cell, 1:]).sum(axis=-1)
    # Each point's height above the plane of its nearest cell.
    order = np.lexsort((np.hypot(offset[:, 0], offset[:, 1]), point))
    point, height = point[order], height[order]
    first = np.concatenate([[True], point[1:] != point[:-1]]) if len(point) else np.zeros(0, bool)
    point, height = usable[point[first]], height[first]
    is_ground[point] = np.abs(height) < _ON_GROUND
    # The foot of a hedge or a wheel is at ground height, but belongs to an obstacle.
    is_obstacle = (height > _OBSTACLE) & (height < _OVERHEAD)
    is_ground[point] &= ~_near_obstacles(points[point], is_ground[point], is_obstacle)
    return is_ground


def _near_obstacles(
    points: Float[np.ndarray, "n 3"],
    is_ground: Bool[np.ndarray, " n"],
    is_obstacle: Bool[np.ndarray, " n"],
) -> Bool[np.ndarray, " n"]:
    """Return which points have many obstacle points nearby compared with ground points."""
    cells, cell = np.unique(_keys(points, _OBSTACLE_CELL), axis=0, return_inverse=True)
    cell = cell.reshape(-1)
    near, far = _pairs(cells, cells, 1)
    obstacles, ground = (
        np.bincount(near, np.bincount(cell, kind, len(cells))[far], len(cells))
        for kind in (is_obstacle, is_ground)
    )
    return (obstacles > _OBSTACLE_RATIO * ground)[cell]


def _fit_planes(
    near: Int[np.ndarray, " p"],
    gap: Float[np.ndarray, "p 2"],
    height: Float[np.ndarray, " p"],
    weight: Float[np.ndarray, " p"],
    count: int,
) -> tuple[Float[np.ndarray, "count 3"], Float[np.ndarray, " count"]]:
    """Fit a plane to the neighbours of each cell by weighted least squares.

    Args:
        near: Cell of each pair of neighbours.
        gap: Horizontal offset from the cell to its neighbour.
        height: Of the neighbour.
        weight: Of the neighbour.
        count: Number of cells.

    Returns:
        Height, slope along x and slope along y at each cell; and the sum of its weights.
    """

    def total(values):
        return np.bincount(near, weight * values, minlength=count)

    terms = (np.ones_like(gap[:, 0]), gap[:, 0], gap[:, 1])
    normal = np.stack([np.stack([total(a * b) for b in terms], axis=-1) for a in terms], axis=-1)
    target = np.stack([total(a * height) for a in terms], axis=-1)
    support = normal[:, 0, 0]
    # 0.1: ridge term towards a level plane, as collinear cells do not determine both slopes.
    # 1e-9: a cell without weight has a singular system.
    normal = normal + np.diag([1e-9, 0.1, 0.1])
    return np.linalg.solve(normal, target[..., None])[..., 0], support


def _linked_to_cameras(
    cells: Float[np.ndarray, "m 3"],
    good: Bool[np.ndarray, " m"],
    near: Int[np.ndarray, " p"],
    far: Int[np.ndarray, " p"],
    length: Float[np.ndarray, " p"],
    cameras: Float[np.ndarray, "k 3"],
) -> Bool[np.ndarray, " m"]:
    """Return the good cells that walkable steps connect to ground below a camera.

    Args:
        cells: Low points, camera heights.
        good: Cells that may be ground.
        near: First cell of each pair of neighbours.
        far: Second cell.
        length: Horizontal distance between them.
        cameras: Camera centres.
    """
    from scipy import sparse
    from scipy.sparse import csgraph

    below = np.zeros(len(cells), bool)
    for camera in cameras:
        gap = np.hypot(*(cells[:, :2] - camera[:2]).T)
        below |= good & (gap < _BELOW_CAMERA) & (cells[:, 2] < camera[2] - _CAMERA_CLEARANCE)
    rise = np.abs(cells[far, 2] - cells[near, 2])
    step = good[near] & good[far] & (length < 4 * _CELL) & (rise < _ON_GROUND + _MAX_SLOPE * length)
    graph = sparse.coo_array((step[step], (near[step], far[step])), shape=(len(cells), len(cells)))
    count, component = csgraph.connected_components(graph, directed=False)
    linked = np.zeros(count, bool)
    linked[component[below]] = True
    return linked[component]


def _keys(x: Float[np.ndarray, "n _"], size: float = _CELL) -> Int[np.ndarray, "n 2"]:
    """Return the horizontal cell (x, y) of each position."""
    return np.floor(x[:, :2] / size).astype(np.int64)


def _lowest_per_cell(
    points: Float[np.ndarray, "n 3"],
) -> tuple[Float[np.ndarray, "m 3"], Int[np.ndarray, "m 2"]]:
    """Return the lowest point of each cell, and the cells."""
    keys = _keys(points)
    order = np.lexsort((points[:, 2], keys[:, 1], keys[:, 0]))
    points, keys = points[order], keys[order]
    first = np.ones(len(keys), bool)
    first[1:] = (keys[1:] != keys[:-1]).any(axis=-1)
    return points[first], keys[first]


def _pairs(
    near: Int[np.ndarray, "n 2"], far: Int[np.ndarray, "m 2"], distance: int
) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"]]:
    """Return the indices of all pairs of cells at most `distance` cells apart along each axis.

    Args:
        near: Cells, which may repeat.
        far: Distinct cells.
        distance: Cells.
    """
    wide = 2**31
    ordered = far[:, 0] * wide + far[:, 1]
    order = np.argsort(ordered)
    ordered = ordered[order]
    first, second = [], []
    for x in range(-distance, distance + 1):
        for y in range(-distance, distance + 1):
            wanted = (near[:, 0] + x) * wide + near[:, 1] + y
            index = np.searchsorted(ordered, wanted).clip(max=len(ordered) - 1)
            hit = np.flatnonzero(ordered[index] == wanted)
            first.append(hit)
            second.append(order[index[hit]])
    return np.concatenate(first), np.concatenate(second)
