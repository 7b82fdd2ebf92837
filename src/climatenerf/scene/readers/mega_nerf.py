"""The layout of Mega-NeRF: `train|val/metadata/STEM.pt` beside `train|val/rgbs/STEM.jpg`.

Each `.pt` holds `W`, `H`, `intrinsics` (fx, fy, cx, cy; pixels, the first one's centre at 0.5) and
`c2w`, 3x4: the world is *DRB* (x down, y right, z backward), the camera's axes are OpenGL's (+x
right, +y up, +z backward), for the camera too was DRB and its columns are stored as (right, -down,
backward). Positions are (real - origin_drb) / pose_scale_factor with the two in `coordinates.pt`,
real ones being in metres.

The input frame here is (right, forward, up) of that world: z up, in metres where `coordinates.pt`
tells how long the units are, and the cameras stand level in it. (Those of a capture that came from
COLMAP do not: it has an arbitrary frame and scale, which the file does not say.) Pictures are
without lens distortion.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np

from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError
from climatenerf.scene.readers.capture import Capture, checked_camera, checked_pose
from climatenerf.scene.scene import View

SPLITS: dict[str, Literal["train", "heldout"]] = {"train": "train", "val": "heldout"}
LEVEL = 0.1  # sine of 6 degrees
_SUFFIXES = (".jpg", ".JPG", ".png", ".PNG")
_UPRIGHT_FROM_DRB = np.array([[0.0, 1, 0], [0, 0, -1], [-1, 0, 0]])


def is_mega_nerf(root: Path) -> bool:
    """Whether `root` has poses in this layout."""
    return any((root / split / "metadata").is_dir() for split in SPLITS)


def read_mega_nerf(root: Path) -> Capture:
    """Read all pictures of both splits; those in `val/` are held out.

    Raises:
        UserError: A file is damaged or lacks what it must hold.
    """
    coordinates = root / "coordinates.pt"
    metric = coordinates.is_file()
    origin, scale = _coordinates(coordinates) if metric else (np.zeros(3), 1.0)
    cameras: dict[Camera, int] = {}
    views = []
    for folder, split in SPLITS.items():
        for path in sorted((root / folder / "metadata").glob("*.pt")):
            data = _load(path)
            stem = root / folder / "rgbs" / path.stem
            found = [p for s in _SUFFIXES if (p := stem.with_name(stem.name + s)).is_file()]
            picture = found[0] if found else stem.with_name(stem.name + ".jpg")
            pose = checked_pose(_array(data, "c2w", (3, 4), path), picture.name, str(path))
            pose[:3, 3] = pose[:3, 3] * scale + origin
            pose[:3] = _UPRIGHT_FROM_DRB @ pose[:3]
            pose[:3, 1:3] *= -1
            camera = _camera(data, path)
            name = f"{folder}/{picture.name}"
            index = cameras.setdefault(camera, len(cameras))
            views.append(View(name, picture, index, pose, split))
    if not views:
        raise UserError(f"{root} has metadata/ folders but no .pt in them; restore the poses.")
    return Capture(
        root=root,
        source="mega-nerf",
        cameras=tuple(cameras),
        views=tuple(views),
        own_split=any(v.split == "heldout" for v in views),
        metric=metric and _stand_level(np.stack([view.c2w for view in views])),
    )


def _stand_level(c2w: np.ndarray) -> bool:
    """Whether the right-hand axes of most cameras [n, 4, 4] are level, as a drone's gimbal is."""
    return bool(np.median(np.abs(c2w[:, 2, 0])) < LEVEL)


def _load(path: Path) -> dict[str, Any]:
    # torch comes in here, so that the other formats need not wait for it.
    import torch

    try:
        data = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged file makes torch raise nearly anything
        words = str(error).strip().split("\n")[0][:80]
        raise UserError(
            f"{path} cannot be read ({type(error).__name__}: {words}); download it again."
        ) from None
    if not isinstance(data, dict):
        raise UserError(f"{path} holds no named values, as Mega-NeRF writes; download it again.")
    return data


def _array(data: dict[str, Any], key: str, shape: tuple[int, ...], path: Path) -> np.ndarray:
    if key not in data:
        raise UserError(f"{path} has no {key}; download it again.")
    try:
        values = np.asarray(data[key], dtype=np.float64)
    except (TypeError, ValueError, RuntimeError):
        raise UserError(f"{key} in {path} is not made of numbers; download it again.") from None
    if values.shape != shape:
        raise UserError(
            f"{key} in {path} has shape {values.shape} instead of {shape}; download it again."
        )
    return values


def _coordinates(path: Path) -> tuple[np.ndarray, float]:
    """Where the origin is, DRB metres, and how many metres a unit has."""
    data = _load(path)
    origin = _array(data, "origin_drb", (3,), path)
    scale = _array(data, "pose_scale_factor", (), path)
    if not (np.isfinite(origin).all() and np.isfinite(scale) and scale > 0):
        raise UserError(
            f"{path} has an origin or scale that is not finite or not above 0; correct it, or"
            " remove the file to have the scale guessed."
        )
    return origin, float(scale)


def _camera(data: dict[str, Any], path: Path) -> Camera:
    fx, fy, cx, cy = map(float, _array(data, "intrinsics", (4,), path))
    size = [float(_array(data, key, (), path)) for key in ("W", "H")]
    if not np.isfinite(size).all():
        raise UserError(f"W or H in {path} is not finite; download it again.")
    return checked_camera(Camera(int(size[0]), int(size[1]), fx, fy, cx, cy), str(path))
