"""A smooth camera path through key poses."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

FRAMES_BETWEEN = 24


def through(
    poses: Sequence[Float[np.ndarray, "4 4"]],
    fovs: Sequence[float],
    between: int = FRAMES_BETWEEN,
) -> tuple[Float[np.ndarray, "frames 4 4"], Float[np.ndarray, "frames"]]:
    """Return poses and fields of view on a path through key poses.

    Positions lie on a cubic spline that starts and ends without curvature; rotations turn at a
    constant rate between neighbours (slerp).

    Args:
        poses: key poses, world m.
        fovs: their fields of view, in any unit.
        between: frames from one key pose to the next.
    """
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, Slerp

    keys = np.stack(poses)
    if len(keys) == 1:
        return keys, np.array(fovs, float)
    at = np.arange(len(keys), dtype=float)
    frames = np.linspace(0, len(keys) - 1, between * (len(keys) - 1) + 1)
    found = np.tile(np.eye(4), (len(frames), 1, 1))
    found[:, :3, :3] = Slerp(at, Rotation.from_matrix(keys[:, :3, :3]))(frames).as_matrix()
    ends = "natural" if len(keys) > 2 else "not-a-knot"
    found[:, :3, 3] = CubicSpline(at, keys[:, :3, 3], bc_type=ends)(frames)
    return found, np.interp(frames, at, fovs)
