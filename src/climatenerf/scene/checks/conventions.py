"""Other conventions in which a capture's poses may be stored."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from climatenerf.scene.scene import Scene

Pose = Float[np.ndarray, "4 4"]
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_AXES = "have OpenGL's camera axes where OpenCV's belong, or the reverse"
_INVERSE = "are world-to-camera instead of camera-to-world, or the reverse"
_BOTH = "are world-to-camera with the axes of another convention"


def inverse(pose: Pose) -> Pose:
    """Return the inverse of a rotation and translation."""
    out = np.eye(4)
    out[:3, :3] = pose[:3, :3].T
    out[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return out


CONVENTIONS: tuple[tuple[str, Callable[[Pose], Pose]], ...] = (
    (_AXES, lambda pose: pose @ _OPENGL),
    (_INVERSE, inverse),
    # Readers of OpenGL formats negate the y and z columns before, hence the other three.
    (_BOTH, lambda pose: inverse(pose) @ _OPENGL),
    (_INVERSE, lambda pose: inverse(pose @ _OPENGL)),
    (_BOTH, lambda pose: inverse(pose @ _OPENGL) @ _OPENGL),
)
"""What poses have in each convention ("The poses ..."), and their conversion to this program's."""


def with_poses(scene: Scene, change: Callable[[Pose], Pose]) -> Scene:
    """Return the scene with converted poses."""
    views = (replace(view, c2w=change(view.c2w)) for view in scene.views)
    return replace(scene, views=tuple(views))
