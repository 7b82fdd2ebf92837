"""Geometry of a walk through camera poses: its order, its breaks, smoothing, even resampling.

Poses are camera-to-world, OpenCV axes, any one unit of length, with z up.
"""

import numpy as np
from jaxtyping import Float, Int

from climatenerf.core.rotations import quaternions, rotation_matrices

TURN_SHARE = 0.1
"""A turn by 1 rad counts as this share of the cameras' spread, so that turning takes time too."""


def capture_order(poses: Float[np.ndarray, "n 4 4"]) -> tuple[Int[np.ndarray, "n"], bool]:
    """The order in which to walk through the poses.

    Args:
        poses: in name order, which is the order of capture for a walk or a drive.

    Returns:
        (indices, whether they are a tour). The given order is kept unless it is more than twice as
        long as a tour from neighbour to neighbour: then the names say nothing about places.
    """
    given = np.arange(len(poses))
    if len(poses) < 4:
        return given, False
    features = _features(poses)
    starts = np.unique(np.linspace(0, len(poses) - 1, 12).astype(int))
    tours = [_tour(features, int(start)) for start in starts]
    best = min(tours, key=lambda tour: _length(features[tour]))
    if _length(features) <= 1.2 * _length(features[best]):  # untangling saves far less than 40 %
        return given, False
    best = _untangled(features, best)
    if _length(features) <= 2.0 * _length(features[best]):
        return given, False
    return (best if best[0] <= best[-1] else best[::-1]), True


def longest_run(poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "m 4 4"]:
    """The part with the most poses between jumps across a quarter of the whole capture.

    A second camera or a second pass starts again elsewhere; the way there was never photographed.
    """
    position = poses[:, :3, 3]
    steps = np.linalg.norm(np.diff(position, axis=0), axis=1)
    extent = np.linalg.norm(position.max(axis=0) - position.min(axis=0))
    jump = np.flatnonzero((steps > 8 * np.median(steps)) & (steps > 0.25 * extent))
    return max(np.split(poses, jump + 1), key=len)


def smooth_and_resample(
    poses: Float[np.ndarray, "n 4 4"], frames: int
) -> Float[np.ndarray, "frames 4 4"]:
    """A smooth level path through the poses with frames at even distances.

    Positions and rotations (as sign-aligned quaternions) are Gaussian-smoothed over about two
    poses to either side, then roll is removed. First and last position are kept.

    Args:
        poses: in walking order, n ≥ 1.
        frames: how many, ≥ 1; one frame is the middle of the path.
    """
    reach = _spread(poses)
    where = _travelled(poses[:, :3, 3], quaternions(poses[:, :3, :3]), reach)
    if len(poses) == 1 or where[-1] <= 0:
        return level(np.repeat(poses[:1], frames, axis=0))
    # Poses in one place twice would make the interpolation ambiguous.
    keep = np.concatenate([[True], np.diff(where) > 1e-9 * where[-1]])
    poses, where = poses[keep], where[keep]
    count = min(24 * len(poses), 20000)
    dense = np.linspace(0, where[-1], count)
    position = _interpolated(dense, where, poses[:, :3, 3])
    quaternion = _interpolated(dense, where, _aligned(quaternions(poses[:, :3, :3])))
    sigma = min(2.0, len(poses) / 8) * count / max(len(poses) - 1, 1)
    position = _smoothed(position, sigma, keep_ends=True)
    quaternion = _smoothed(_unit(quaternion), sigma, keep_ends=False)
    quaternion = _unit(quaternion)
    where = _travelled(position, quaternion, reach)
    even = np.linspace(0, where[-1], frames) if frames > 1 else np.array([where[-1] / 2])
    out = np.repeat(np.eye(4)[None], frames, axis=0)
    out[:, :3, 3] = _interpolated(even, where, position)
    out[:, :3, :3] = rotation_matrices(_unit(_interpolated(even, where, quaternion)))
    return level(out)


def level(poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 4 4"]:
    """The poses without roll: the same views and places, the cameras' x axis horizontal.

    Towards straight up or down, where no roll is right, the pose's own x axis takes over.
    """
    forward, own = poses[:, :3, 2], poses[:, :3, 0]
    horizontal = np.cross(forward, [0.0, 0.0, 1.0])
    slant = np.linalg.norm(horizontal, axis=1, keepdims=True)
    trust = np.clip((slant - 0.1) / 0.2, 0.0, 1.0)
    trust = trust**2 * (3 - 2 * trust)
    # 1e-9 prevents 0/0 where the camera looks straight up or down; trust is 0 there.
    right = trust * horizontal / (slant + 1e-9) + (1 - trust) * own
    right = _unit(right - np.sum(right * forward, axis=1, keepdims=True) * forward)
    out = poses.copy()
    out[:, :3, 0] = right
    out[:, :3, 1] = np.cross(forward, right)
    return out


def looking_at(
    position: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "n 4 4"]:
    """Level poses at ``position`` that look at ``target``."""
    out = np.repeat(np.eye(4)[None], len(position), axis=0)
    forward = _unit(target - position)
    # Straight down, x to the right is as good as any: level() needs some axis across the view.
    across = np.cross(forward, np.where(np.abs(forward[:, 2:]) < 0.9, [0, 0, 1.0], [0, 1.0, 0]))
    out[:, :3, 3], out[:, :3, 2], out[:, :3, 0] = position, forward, _unit(across)
    return level(out)


def _spread(poses: np.ndarray) -> float:
    """How far the cameras stand apart; 1 where all stand in one place and only turn."""
    spread = float(np.sqrt(poses[:, :3, 3].var(axis=0).sum()))
    return spread if spread > 0 else 1.0


def _features(poses: np.ndarray) -> np.ndarray:
    """Points whose distances compare poses: place, and view direction at a fifth of the spread."""
    return np.concatenate([poses[:, :3, 3], 0.2 * _spread(poses) * poses[:, :3, 2]], axis=1)


def _length(points: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def _tour(points: np.ndarray, start: int) -> np.ndarray:
    """From each point to the nearest one not yet seen."""
    order, left = [start], np.ones(len(points), dtype=bool)
    left[start] = False
    while left.any():
        rest = np.flatnonzero(left)
        order.append(int(rest[np.linalg.norm(points[rest] - points[order[-1]], axis=1).argmin()]))
        left[order[-1]] = False
    return np.array(order)


def _untangled(points: np.ndarray, order: np.ndarray) -> np.ndarray:
    """2-opt: turns a stretch of the tour round while that makes it shorter."""
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


def _travelled(position: np.ndarray, quaternion: np.ndarray, reach: float) -> np.ndarray:
    """Distance from the start along the path, turns counted by TURN_SHARE."""
    step = np.linalg.norm(np.diff(position, axis=0), axis=1)
    dot = np.abs(np.sum(quaternion[1:] * quaternion[:-1], axis=1))
    angle = 2 * np.arccos(np.clip(dot, 0.0, 1.0))
    return np.concatenate([[0.0], np.cumsum(np.hypot(step, TURN_SHARE * reach * angle))])


def _interpolated(at: np.ndarray, where: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(at, where, column) for column in values.T], axis=1)


def _smoothed(values: np.ndarray, sigma: float, keep_ends: bool) -> np.ndarray:
    """Gaussian along axis 0; the ends are continued by point reflection, or mirrored."""
    radius = min(int(3 * sigma) + 1, len(values) - 1)
    weights = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma) ** 2)
    before, after = values[radius:0:-1], values[-2 : -radius - 2 : -1]
    if keep_ends:
        before, after = 2 * values[:1] - before, 2 * values[-1:] - after
    padded = np.concatenate([before, values, after])
    columns = [np.convolve(column, weights / weights.sum(), mode="valid") for column in padded.T]
    return np.stack(columns, axis=1)


def _unit(vectors: np.ndarray) -> np.ndarray:
    # 1e-12 prevents 0/0 for a vector of length 0, which has no direction to keep.
    return vectors / (np.linalg.norm(vectors, axis=-1, keepdims=True) + 1e-12)


def _aligned(quaternions: np.ndarray) -> np.ndarray:
    """Each quaternion with the sign nearer to its predecessor: q and -q are one rotation."""
    signs = np.where(np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0, -1.0, 1.0)
    return quaternions * np.concatenate([[1.0], np.cumprod(signs)])[:, None]
