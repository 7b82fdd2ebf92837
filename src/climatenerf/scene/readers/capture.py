"""What every reader hands over, and the checks on poses and intrinsics that all of them share."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError
from climatenerf.scene.label_spaces import TRAIN_IDS
from climatenerf.scene.scene import View

# No real pose, focal length or size comes near; beyond it squares and products overflow.
_LARGEST = 1e12


@dataclass(frozen=True)
class Capture:
    """A capture as its files describe it, before pictures are checked and the world is levelled.

    Attributes:
        root: Absolute folder of the capture.
        source: Name of the reader.
        cameras: Intrinsics as the files give them.
        views: All pictures that the poses name, whether the disk has them or not.
        points: Sparse points in the input frame, or None.
        own_split: Whether the views' splits are the capture's own.
        metric: Whether the input frame is known to be in metres with z up.
        label_space: What the numbers in its label files mean; see `label_spaces.py`.
        warnings: Sentences for the user.
    """

    root: Path
    source: str
    cameras: tuple[Camera, ...]
    views: tuple[View, ...]
    points: Float[np.ndarray, "n 3"] | None = None
    own_split: bool = False
    metric: bool = False
    label_space: str = TRAIN_IDS
    warnings: tuple[str, ...] = ()


def checked_camera(camera: Camera, where: str) -> Camera:
    """The camera itself if its numbers can be used.

    Raises:
        UserError: A size or focal length is not positive, or a number is not finite.
    """
    numbers = (camera.cx, camera.cy, camera.k1, camera.k2, camera.k3, camera.k4)
    numbers += (camera.p1, camera.p2, camera.fx, camera.fy)
    if not all(math.isfinite(n) and abs(n) < _LARGEST for n in numbers):
        raise UserError(
            f"A camera in {where} has intrinsics that are not finite or far too large; calibrate "
            "again."
        )
    if camera.fx < 1e-6 or camera.fy < 1e-6:
        raise UserError(
            f"A camera in {where} has focal length {min(camera.fx, camera.fy):g} pixels; it must "
            "be above 0, so calibrate again or correct the file."
        )
    if not (0 < camera.width < _LARGEST and 0 < camera.height < _LARGEST):
        raise UserError(
            f"A camera in {where} has size {camera.width}x{camera.height} pixels; correct the file."
        )
    return camera


def checked_pose(matrix: Any, name: str, where: str) -> Float[np.ndarray, "4 4"]:
    """A 4x4 camera-to-input pose with an orthonormal rotation.

    A common scale of the three axes and up to 2 % of non-orthonormality (rounded numbers) are
    taken out; anything else is an error.

    Args:
        matrix: 3x4 or 4x4 numbers.
        name: Name of the picture, for the message.
        where: File, for the message.

    Raises:
        UserError: The pose is not finite or holds no rotation.
    """
    try:
        pose = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError):
        pose = np.empty(0)
    if pose.shape not in ((3, 4), (4, 4)):
        raise UserError(f"The pose of {name} in {where} is not a 4x4 matrix; correct the file.")
    if not np.isfinite(pose).all() or np.abs(pose).max() > _LARGEST:
        raise UserError(
            f"The pose of {name} in {where} is not finite or far too large; remove that picture or "
            "pose it again."
        )
    u, stretch, vt = np.linalg.svd(pose[:3, :3])
    mean = stretch.mean()
    if mean < 1e-12 or np.abs(stretch / mean - 1).max() > 0.02 or np.linalg.det(u @ vt) < 0:
        raise UserError(
            f"The pose of {name} in {where} holds no rotation matrix (sheared, mirrored or zero); "
            "remove that picture or pose it again."
        )
    out = np.eye(4)
    out[:3, :3] = u @ vt
    out[:3, 3] = pose[:3, 3]
    return out
