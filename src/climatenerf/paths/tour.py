"""Tours through camera poses: order, segments, smoothing, even resampling.

Poses are camera-to-world, OpenCV axes, any one unit of length, with z up.
"""

import numpy as np
from jaxtyping import Float, Int

from climatenerf.core.rotations import quaternions, rotation_matrices

ROTATION_WEIGHT = 0.1
"""A rotation by 1 rad counts as this fraction of the cameras' spread, so that it takes time too."""


def capture_order(poses: Float[np.ndarray, "n 4 4"]) -> tuple[Int[np.ndarray, "n"], bool]:
    """Return the order in which a path visits the poses.

    Args:
        poses: in name order, which is the order of capture for a walk or a drive.

    Returns:
        (indices, whether they are a tour). The given order is kept unless it is more than twice as
        long as a tour from neighbour to neighbour: then the names have no spatial order.
    """
    given = np.arange(len(poses))
    if len(poses) < 4:
        return given, False
    features = _features(poses)
    starts = np.unique(np.linspace(0, len(poses) - 1, 12).astype(int))
    tours = [_tour(features, int(start)) for start in starts]
    best = min(tours, key=lambda tour: _length(features[tour]))
    if _length(features) <= 1.2 * _length(features[best]):  # 2-opt saves far less than 40 %
        return given, False
    best = _two_opt(features, best)
    if _length(features) <= 2.0 * _length(features[best]):
        return given, False
    return (best if best[0] <= best[-1] else best[::-1]), True


def longest_segment(poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "m 4 4"]:
    """Return the segment with the most poses between jumps of a quarter of the capture's extent.

    A second camera or a second pass starts elsewhere, and no photograph shows the way there.
    """
    position = poses[:, :3, 3]
    steps = np.linalg.norm(np.diff(position, axis=0), axis=1)
    extent = np.linalg.norm(position.max(axis=0) - position.min(axis=0))
    jump = np.flatnonzero((steps > 8 * np.median(steps)) & (steps > 0.25 * extent))
    return max(np.split(poses, jump + 1), key=len)


def smooth_and_resample(
    poses: Float[np.ndarray, "n 4 4"], frames: int
) -> Float[np.ndarray, "frames 4 4"]:
    """Return a smooth path without roll through the poses, with evenly spaced frames.

    Positions and rotations (as sign-aligned quaternions) are Gaussian-smoothed over about two
    poses to either side, then roll is removed. First and last position are kept.

    Args:
        poses: in the order of the path, n ≥ 1.
        frames: number of frames, ≥ 1; a single frame is the middle of the path.
    """
    spread = _spread(poses)
    distance = _distances(poses[:, :3, 3], quaternions(poses[:, :3, :3]), spread)
    if len(poses) == 1 or distance[-1] <= 0:
        return without_roll(np.repeat(poses[:1], frames, axis=0))
    # Two poses at one distance would make the interpolation ambiguous.
    keep = np.concatenate([[True], np.diff(distance) > 1e-9 * distance[-1]])
    poses, distance = poses[keep], distance[keep]
    count = min(24 * len(poses), 20000)
    dense = np.linspace(0, distance[-1], count)
    position = _interpolated(dense, distance, poses[:, :3, 3])
    quaternion = _interpolated(dense, distance, _aligned(quaternions(poses[:, :3, :3])))
    sigma = min(2.0, len(poses) / 8) * count / max(len(poses) - 1, 1)
    position = _smoothed(position, sigma, keep_ends=True)
    quaternion = _smoothed(_unit(quaternion), sigma, keep_ends=False)
    quaternion = _unit(quaternion)
    distance = _distances(position, quaternion, spread)
    total = distance[-1]
    even = np.linspace(0, total, frames) if frames > 1 else np.array([total / 2])
    out = np.repeat(np.eye(4)[None], frames, axis=0)
    out[:, :3, 3] = _interpolated(even, distance, position)
    out[:, :3, :3] = rotation_matrices(_unit(_interpolated(even, distance, quaternion)))
    return without_roll(out)


def without_roll(poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 4 4"]:
    """Return the poses with a horizontal x axis, at the same positions and view directions.

    Near the vertical view direction, where roll is undefined, the x axis is blended with the
    original one.
    """
    forward, original = poses[:, :3, 2], poses[:, :3, 0]
    horizontal = np.cross(forward, [0.0, 0.0, 1.0])
    slant = np.linalg.norm(horizontal, axis=1, keepdims=True)
    blend = np.clip((slant - 0.1) / 0.2, 0.0, 1.0)
    blend = blend**2 * (3 - 2 * blend)
    # 1e-9 prevents 0/0 for a vertical view direction, where blend is 0.
    right = blend * horizontal / (slant + 1e-9) + (1 - blend) * original
    right = _unit(right - np.sum(right * forward, axis=1, keepdims=True) * forward)
    out = poses.copy()
    out[:, :3, 0] = right
    out[:, :3, 1] = np.cross(forward, right)
    return out


def looking_at(
    position: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "n 4 4"]:
    """Return poses without roll at ``position`` whose optical axes meet ``target``."""
    out = np.repeat(np.eye(4)[None], len(position), axis=0)
    forward = _unit(target - position)
    # For a vertical view any x axis is right, but `without_roll` needs one that is perpendicular.
    across = np.cross(forward, np.where(np.abs(forward[:, 2:]) < 0.9, [0, 0, 1.0], [0, 1.0, 0]))
    out[:, :3, 3], out[:, :3, 2], out[:, :3, 0] = position, forward, _unit(across)
    return without_roll(out)


def _spread(poses: np.ndarray) -> float:
    """Return the standard deviation of the positions; 1 if all positions are equal."""
    spread = float(np.sqrt(poses[:, :3, 3].var(axis=0).sum()))
    return spread if spread > 0 else 1.0


def _features(poses: np.ndarray) -> np.ndarray:
    """Return points whose distances compare poses: position, and 0.2 spread times direction."""
    return np.concatenate([poses[:, :3, 3], 0.2 * _spread(poses) * poses[:, :3, 2]], axis=1)


def _length(points: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def _tour(points: np.ndarray, start: int) -> np.ndarray:
    """Visit the nearest unvisited point next, from a start point on."""
    order, unvisited = [start], np.ones(len(points), dtype=bool)
    unvisited[start] = False
    while unvisited.any():
        rest = np.flatnonzero(unvisited)
        order.append(int(rest[np.linalg.norm(points[rest] - points[order[-1]], axis=1).argmin()]))
        unvisited[order[-1]] = False
    return np.array(order)


def _two_opt(points: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Shorten a tour by 2-opt: reverse a part of it while that makes it shorter."""
    for _ in range(30):
        before = _length(points[order])
        for i in range(1, len(order) - 1):
            path = points[order]
            here = np.linalg.norm(path[i - 1] - path[i:], axis=1)
            onward = np.zeros(len(order) - i)
            onward[:-1] = np.linalg.norm(path[i] - path[i + 1 :], axis=1)
            onward[:-1] -= np.linalg.norm(np.diff(path[i:], axis=0), axis=1)
            gain = here[0] - here - onward
            j = i + int(np.argmax(gain))
            if gain[j - i] > 1e-12:
                order[i : j + 1] = order[i : j + 1][::-1]
        if _length(points[order]) > 0.999 * before:
            break
    return order


def _distances(position: np.ndarray, quaternion: np.ndarray, spread: float) -> np.ndarray:
    """Return distances from the start along the path, with rotation at ROTATION_WEIGHT."""
    step = np.linalg.norm(np.diff(position, axis=0), axis=1)
    dot = np.abs(np.sum(quaternion[1:] * quaternion[:-1], axis=1))
    angle = 2 * np.arccos(np.clip(dot, 0.0, 1.0))
    return np.concatenate([[0.0], np.cumsum(np.hypot(step, ROTATION_WEIGHT * spread * angle))])


def _interpolated(at: np.ndarray, distance: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(at, distance, column) for column in values.T], axis=1)


def _smoothed(values: np.ndarray, sigma: float, keep_ends: bool) -> np.ndarray:
    """Smooth along axis 0 by a Gaussian; ends continue by point reflection, or are mirrored."""
    radius = min(int(3 * sigma) + 1, len(values) - 1)
    weights = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma) ** 2)
    before, after = values[radius:0:-1], values[-2 : -radius - 2 : -1]
    if keep_ends:
        before, after = 2 * values[:1] - before, 2 * values[-1:] - after
    padded = np.concatenate([before, values, after])
    columns = [np.convolve(column, weights / weights.sum(), mode="valid") for column in padded.T]
    return np.stack(columns, axis=1)


def _unit(vectors: np.ndarray) -> np.ndarray:
    # 1e-12 prevents 0/0 for a vector of length 0, which has no direction.
    return vectors / (np.linalg.norm(vectors, axis=-1, keepdims=True) + 1e-12)


def _aligned(quaternions: np.ndarray) -> np.ndarray:
    """Choose the sign of each quaternion nearer to its predecessor: q and -q are one rotation."""
    signs = np.where(np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0, -1.0, 1.0)
    return quaternions * np.concatenate([[1.0], np.cumprod(signs)])[:, None]
