"""Ground without a network: what lies between sparse points of the ground, as far as looks agree.

The height of the ground comes from the capture's sparse points, as planes through the low ones
around each place, linked to the ground under the cameras. Which of a photo's points lie on it is
then known, and from those the ground goes on over the photo for so many metres, edges of colour
counting as further, up to half-way to any point that does not lie on it. Every doubt leads to
"unknown", as for the sky.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from climatenerf.core.cameras import Camera
from climatenerf.scene.alignment.ground_plane import find_ground
from climatenerf.scene.scene import Scene, View

# In camera heights:
_CELL = 0.5
_ON = 0.07  # from the ground, for a point that lies on it
_NEARBY = 1.2  # how far a plane reaches
_REACH = 1.0  # over a photo, from a point
_STANDING, _OVERHEAD = 0.12, 1.5  # above the ground, for a point of what stands on it
_FOOT = 0.2  # around what stands on the ground
_UNDER = 2.0  # sideways from a camera, for ground that it stands on

_AROUND = 4  # cells that a plane looks at
_STEEP = 0.8  # of the ground
_SUPPORT = 3.0  # cells that a plane must rest on
_ROUNDS = 6
_CROWD = 0.2  # standing points to one on the ground
_MIN_POINTS = 4  # of ground in a photo
_FAR = -0.05  # sine of the ray to the furthest ground, 20 camera heights away
_EDGES = 25.0  # how much longer a way is with steps of all the display range
_BORDER, _BORDERS = 0.15, 5.0  # change that is a border; reaches for one of all the display range
_HALF_WAY = 0.4  # share of the way to what is not ground
_SWEEPS = 4
_SIZE = 500  # pixels of the longer side, at most


@dataclass(frozen=True)
class GroundPoints:
    """Which sparse points of a capture are ground.

    Attributes:
        points: All of them, world metres.
        on: Those that lie on the ground.
        camera_height: Of the cameras above it, metres.
    """

    points: Float[np.ndarray, "n 3"]
    on: Bool[np.ndarray, " n"]
    camera_height: float


def ground_points(scene: Scene) -> GroundPoints | None:
    """The sparse points that lie on a levelled capture's ground; None if it is not found."""
    points = scene.points_world()
    if points is None or all(view.seen is None for view in scene.views):
        return None
    cameras = np.stack([scene.c2w_world(view)[:3, 3] for view in scene.views])
    ground = find_ground(points, cameras)
    if ground is None:
        return None
    unit = ground.camera_height
    on = _on_ground(points / unit, ground.cells / unit, cameras / unit)
    return GroundPoints(points, on, unit) if on.any() else None


def find_ground_in(
    view: View,
    scene: Scene,
    camera: Camera,
    known: GroundPoints,
    rays: Float[np.ndarray, "h w 3"],
    values: Float[np.ndarray, "h w 3"],
) -> Bool[np.ndarray, "h w"]:
    """True where a photo surely shows ground.

    Args:
        view: Which photo.
        scene: The levelled capture.
        camera: The photo's camera at the size in which it is looked at.
        known: The capture's ground.
        rays: Unit directions of the pixels' rays, world axes.
        values: The photo, display values 0 to 1.
    """
    height, width, _ = values.shape
    nothing = np.zeros((height, width), bool)
    if view.seen is None or not len(view.seen):
        return nothing
    # Looked at with every second pixel or fewer: the ground's edge is no matter of pixels.
    every = -(-max(height, width) // _SIZE)
    rays, values = rays[::every, ::every], values[::every, ::every]
    pose = scene.c2w_world(view)
    points, on = known.points[view.seen], known.on[view.seen]
    pixels = camera.project((points - pose[:3, 3]) @ pose[:3, :3])
    pixels = np.floor(np.where(np.isfinite(pixels), pixels, -1).clip(-1, 1e6)).astype(np.int64)
    inside = ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(axis=-1)
    pixels //= every
    if (on & inside).sum() < _MIN_POINTS:
        return nothing
    drop = float(np.median(pose[2, 3] - points[on & inside, 2]))
    below = rays[..., 2] < _FAR
    if drop <= 0.1 * known.camera_height or not below.any():
        return nothing
    # Where the rays would meet level ground, in the unit of the reach.
    place = rays[..., :2] * (drop / np.maximum(-rays[..., 2:], -_FAR))
    place = np.where(below[..., None], place, 1e3 * drop)
    place = place / (_REACH * known.camera_height)
    steps = []
    for axis in (0, 1):
        length = np.linalg.norm(np.diff(place, axis=axis), axis=-1)
        change = np.abs(np.diff(values, axis=axis)).max(axis=-1)
        # Texture makes a way longer in proportion; a border costs as much near by as far away.
        border = _BORDERS * np.maximum(change - _BORDER, 0)
        steps.append(length * (1 + _EDGES * change) + border)
    ground = _distance(pixels[on & inside], steps)
    other = _distance(pixels[~on & inside], steps)
    found = below & (ground < 1) & (ground < _HALF_WAY / (1 - _HALF_WAY) * other)
    return found.repeat(every, axis=0).repeat(every, axis=1)[:height, :width]


def _distance(
    seeds: Int[np.ndarray, "n 2"], steps: list[Float[np.ndarray, "_ _"]]
) -> Float[np.ndarray, "h w"]:
    """Length of the shortest way along rows and columns to a seed (x, y), given each step's."""
    down, across = (np.cumsum(s, axis=i, dtype=np.float64) for i, s in enumerate(steps))
    down = np.pad(down, ((1, 0), (0, 0)))
    across = np.pad(across, ((0, 0), (1, 0)))
    distance = np.full(down.shape, 1e6)
    distance[seeds[:, 1], seeds[:, 0]] = 0
    for _ in range(_SWEEPS):
        for axis, along in ((1, across), (0, down)):
            onward = along + np.minimum.accumulate(distance - along, axis=axis)
            flipped = np.flip(distance + along, axis)
            back = np.flip(np.minimum.accumulate(flipped, axis=axis), axis) - along
            distance = np.minimum(onward, back)
    return distance


def _on_ground(
    points: Float[np.ndarray, "n 3"],
    cells: Float[np.ndarray, "m 3"],
    cameras: Float[np.ndarray, "k 3"],
) -> Bool[np.ndarray, " n"]:
    """Which points lie on the ground; all lengths in camera heights.

    Args:
        points: The points.
        cells: Low points of small cells, from `find_ground`.
        cameras: The cameras' positions.
    """
    cells, keys = _one_a_cell(cells)
    near, far = _pairs(keys, keys, _AROUND)
    gap = cells[far, :2] - cells[near, :2]
    length = np.hypot(gap[:, 0], gap[:, 1])
    # What lies lower than this envelope allows stands on something.
    envelope = np.full(len(cells), np.inf)
    np.minimum.at(envelope, near, cells[far, 2] + _STEEP * length)
    weight = (cells[:, 2] - envelope < 2 * _ON).astype(np.float64)
    closeness = np.exp(-((length / _NEARBY) ** 2))
    planes, support = np.zeros((len(cells), 3)), np.zeros(len(cells))
    for _ in range(_ROUNDS):
        planes, support = _planes(near, gap, cells[far, 2], closeness * weight[far], len(cells))
        over = (cells[:, 2] - planes[:, 0]) / _ON
        # Nothing lies below the ground, so what is above counts less.
        weight = 1 / (1 + np.where(over > 0, over, 0.5 * over) ** 4)
    flat = np.hypot(planes[:, 1], planes[:, 2]) < _STEEP
    good = flat & (support > _SUPPORT) & (np.abs(cells[:, 2] - planes[:, 0]) < _ON)
    good &= _linked(cells, good, near, far, length, cameras)
    cells, keys, planes = cells[good], keys[good], planes[good]
    on = np.zeros(len(points), bool)
    if not len(cells):
        return on
    usable = np.flatnonzero(np.abs(points).max(axis=-1) < 1e6)
    point, cell = _pairs(_keys(points[usable]), keys, 1)
    offset = points[usable[point]] - cells[cell]
    offset[:, 2] += cells[cell, 2] - planes[cell, 0]
    over = offset[:, 2] - (offset[:, :2] * planes[cell, 1:]).sum(axis=-1)
    # By the nearest cell's plane.
    order = np.lexsort((np.hypot(offset[:, 0], offset[:, 1]), point))
    point, over = point[order], over[order]
    first = np.concatenate([[True], point[1:] != point[:-1]]) if len(point) else np.zeros(0, bool)
    point, over = usable[point[first]], over[first]
    on[point] = np.abs(over) < _ON
    # The foot of a hedge or a wheel lies no higher than the ground, but things stand there.
    standing = (over > _STANDING) & (over < _OVERHEAD)
    on[point] &= ~_crowded(points[point], on[point], standing)
    return on


def _crowded(points, on, standing):
    """Points with enough standing ones around them, compared with those on the ground."""
    places, place = np.unique(_keys(points, _FOOT), axis=0, return_inverse=True)
    place = place.reshape(-1)
    near, far = _pairs(places, places, 1)
    around = [
        np.bincount(near, np.bincount(place, which, len(places))[far], len(places))
        for which in (standing, on)
    ]
    return (around[0] > _CROWD * around[1])[place]


def _planes(near, gap, height, weight, count):
    """Height and slopes of the ground at each of `count` cells, and how many cells bear it."""

    def total(values):
        return np.bincount(near, weight * values, minlength=count)

    x, y = gap[:, 0], gap[:, 1]
    one = np.ones_like(x)
    terms = (one, x, y)
    left = np.stack([np.stack([total(a * b) for b in terms], axis=-1) for a in terms], axis=-1)
    right = np.stack([total(a * height) for a in terms], axis=-1)
    support = left[:, 0, 0]
    # A light pull to level: a few cells in a line do not tell how the ground leans.
    # 1e-9: a cell that nothing bears has no equation at all.
    left = left + np.diag([1e-9, 0.1, 0.1])
    return np.linalg.solve(left, right[..., None])[..., 0], support


def _linked(cells, good, near, far, length, cameras):
    """Cells from which steps of little height lead to ground below a camera."""
    reached = np.zeros(len(cells), bool)
    for camera in cameras:
        gap = np.hypot(*(cells[:, :2] - camera[:2]).T)
        reached |= good & (gap < _UNDER) & (cells[:, 2] < camera[2] - 0.3)
    rise = np.abs(cells[far, 2] - cells[near, 2])
    way = good[near] & good[far] & (length < 4 * _CELL) & (rise < _ON + _STEEP * length)
    near, far = near[way], far[way]
    while True:
        before = np.count_nonzero(reached)
        reached[far[reached[near]]] = True
        if np.count_nonzero(reached) == before:
            return reached


def _keys(places: Float[np.ndarray, "n _"], size: float = _CELL) -> Int[np.ndarray, "n 2"]:
    return np.floor(places[:, :2] / size).astype(np.int64)


def _one_a_cell(cells):
    """The lowest of what is in one cell."""
    keys = _keys(cells)
    order = np.lexsort((cells[:, 2], keys[:, 1], keys[:, 0]))
    cells, keys = cells[order], keys[order]
    first = np.ones(len(keys), bool)
    first[1:] = (keys[1:] != keys[:-1]).any(axis=-1)
    return cells[first], keys[first]


def _pairs(near, far, reach):
    """All pairs of cells, by their numbers, that are at most so many cells apart.

    Args:
        near: Cells, as many in one place as may be.
        far: Cells, each another.
        reach: Cells.
    """
    wide = 2**31
    ordered = far[:, 0] * wide + far[:, 1]
    order = np.argsort(ordered)
    ordered = ordered[order]
    a, b = [], []
    for x in range(-reach, reach + 1):
        for y in range(-reach, reach + 1):
            wanted = (near[:, 0] + x) * wide + near[:, 1] + y
            place = np.searchsorted(ordered, wanted).clip(max=len(ordered) - 1)
            hit = np.flatnonzero(ordered[place] == wanted)
            a.append(hit)
            b.append(order[place[hit]])
    return np.concatenate(a), np.concatenate(b)
