"""The result of every reader, and the checks of poses and intrinsics that all readers share."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError, excerpt
from climatenerf.scene.findings import Finding
from climatenerf.scene.label_spaces import TRAIN_IDS
from climatenerf.scene.readers.ply import MAX_POSITION
from climatenerf.scene.scene import MAX_SIDE, MILLIMETRES, View

# No real focal length or size comes near; above it, products of several numbers overflow.
_MAX_VALUE = 1e12


@dataclass(frozen=True)
class Capture:
    """A capture as its files describe it, before the images are checked and the world is aligned.

    Attributes:
        root: Absolute folder of the capture.
        source: Name of the format.
        cameras: Intrinsics as stored in the files.
        views: All images with poses, whether or not the image files exist.
        points: Sparse points in the input frame, or None.
        predefined_split: Whether the capture defines the split of its views.
        metric: Whether the input frame is in metres with z up.
        label_space: Numbering of the ids in its label files; see `label_spaces.py`.
        findings: What is odd about the files.
        depth_scale: Metres per unit of integer depth files.
        point_transforms: Transforms that the points may lack although the poses include them, 4x4.
        ambiguous: Paths of views whose names match several files, with these; `findings` has them.
    """

    root: Path
    source: str
    cameras: tuple[Camera, ...]
    views: tuple[View, ...]
    points: Float[np.ndarray, "n 3"] | None = None
    predefined_split: bool = False
    metric: bool = False
    label_space: str = TRAIN_IDS
    findings: tuple[Finding, ...] = ()
    depth_scale: float = MILLIMETRES
    point_transforms: tuple[Float[np.ndarray, "4 4"], ...] = ()
    ambiguous: Mapping[Path, Sequence[Path]] = field(default_factory=dict)


def checked_camera(camera: Camera, where: str) -> Camera:
    """Return the camera if its numbers are usable.

    Args:
        camera: Intrinsics as read.
        where: File, for the message.

    Raises:
        UserError: A size or focal length is not positive, or a number is not finite.
    """
    numbers = (camera.cx, camera.cy, camera.k1, camera.k2, camera.k3, camera.k4)
    numbers += (camera.p1, camera.p2, camera.fx, camera.fy)
    if not all(math.isfinite(n) and abs(n) < _MAX_VALUE for n in numbers):
        raise UserError(
            f"A camera in {where} has intrinsics that are not finite or far too large; calibrate "
            "again."
        )
    # `checks.intrinsics` takes the absolute value of a negative one.
    if min(abs(camera.fx), abs(camera.fy)) < 1e-6:
        raise UserError(
            f"A camera in {where} has focal length 0; calibrate again or correct the file."
        )
    if not (0 < camera.width <= MAX_SIDE and 0 < camera.height <= MAX_SIDE):
        size = f"{excerpt(camera.width)}x{excerpt(camera.height)}"
        raise UserError(f"A camera in {where} has size {size} pixels; correct the file.")
    return camera


def checked_pose(matrix: Any, name: str, where: str) -> Float[np.ndarray, "4 4"]:
    """Return a 4x4 camera-to-input pose with an orthonormal rotation.

    A common scale of the three axes and up to 2 % of non-orthonormality (rounded digits) are
    removed; anything else is an error.

    Args:
        matrix: 3x4 or 4x4 numbers.
        name: Name of the image, for the message.
        where: File, for the message.

    Raises:
        UserError: The pose is not a finite matrix or contains no rotation.
    """
    try:
        pose = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        pose = np.empty(0)
    if pose.shape not in ((3, 4), (4, 4)):
        raise UserError(f"The pose of {name} in {where} is not a 4x4 matrix; correct the file.")
    if not np.isfinite(pose).all() or np.abs(pose).max() > _MAX_VALUE:
        raise UserError(
            f"The pose of {name} in {where} is not finite or far too large; remove that image or "
            "compute its pose again."
        )
    if np.abs(pose[:3, 3]).max() > MAX_POSITION:
        raise UserError(
            f"The pose of {name} in {where} is far too large: {np.abs(pose[:3, 3]).max():.3g} units"
            f" from the origin, and 32 bits resolve nothing beyond {MAX_POSITION:g}; remove that"
            " image or compute its pose again."
        )
    u, stretch, vt = np.linalg.svd(pose[:3, :3])
    mean = stretch.mean()
    if mean < 1e-12 or np.abs(stretch / mean - 1).max() > 0.02 or np.linalg.det(u @ vt) < 0:
        raise UserError(
            f"The pose of {name} in {where} contains no rotation matrix (sheared, mirrored or "
            "zero); remove that image or compute its pose again."
        )
    out = np.eye(4)
    out[:3, :3] = u @ vt
    out[:3, 3] = pose[:3, 3]
    return out
