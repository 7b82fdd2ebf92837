"""The layout of Mega-NeRF: `train|val/metadata/STEM.pt` beside `train|val/rgbs/STEM.jpg`.

Each `.pt` holds `W`, `H`, `intrinsics` (fx, fy, cx, cy; pixels, centre of the first pixel at 0.5)
and `c2w`, 3x4. The world of `c2w` is *DRB* (x down, y right, z backward). The camera axes are
OpenGL's (x right, y up, z backward): the camera was DRB too, and its columns are stored as (right,
-down, backward). Positions are (metric - origin_drb) / pose_scale_factor, both from
`coordinates.pt`, with metric positions in metres.

The input frame here is (right, forward, up) of that world. It is taken as metric with z up if
`coordinates.pt` gives the scale and the cameras are level in it. A capture converted from COLMAP
also has a `coordinates.pt`, but an arbitrary frame and scale; its cameras are not level. Images
have no lens distortion.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError
from climatenerf.core.listing import visible
from climatenerf.scene.readers.capture import Capture, checked_camera, checked_pose
from climatenerf.scene.scene import View

SPLITS: dict[str, Literal["train", "heldout"]] = {"train": "train", "val": "heldout"}
MAX_TILT = 0.1  # sine of 6 degrees
MAX_METADATA = 4_000_000  # bytes of one .pt; it holds some 30 numbers
_SUFFIXES = (".jpg", ".JPG", ".png", ".PNG")
_UPRIGHT_FROM_DRB = np.array([[0.0, 1, 0], [0, 0, -1], [-1, 0, 0]])


def is_mega_nerf(root: Path) -> bool:
    """Return whether `root` has poses in this layout."""
    return any((root / split / "metadata").is_dir() for split in SPLITS)


def read_mega_nerf(root: Path) -> Capture:
    """Read all images of both splits; those in `val/` are held out.

    Raises:
        UserError: A file is damaged or lacks an entry.
    """
    coordinates = root / "coordinates.pt"
    metric = coordinates.is_file()
    origin, scale = _coordinates(coordinates) if metric else (np.zeros(3), 1.0)
    cameras: dict[Camera, int] = {}
    views = []
    for folder, split in SPLITS.items():
        for path in sorted(visible((root / folder / "metadata").glob("*.pt"))):
            data = _load(path)
            stem = root / folder / "rgbs" / path.stem
            found = [p for s in _SUFFIXES if (p := stem.with_name(stem.name + s)).is_file()]
            image = found[0] if found else stem.with_name(stem.name + ".jpg")
            pose = checked_pose(_array(data, "c2w", (3, 4), path), image.name, str(path))
            pose[:3, 3] = pose[:3, 3] * scale + origin
            pose[:3] = _UPRIGHT_FROM_DRB @ pose[:3]
            pose[:3, 1:3] *= -1
            camera = _camera(data, path)
            name = f"{folder}/{image.name}"
            index = cameras.setdefault(camera, len(cameras))
            views.append(View(name, image, index, pose, split))
    if not views:
        raise UserError(f"{root} has metadata/ folders but no .pt in them; restore the poses.")
    return Capture(
        root=root,
        source="mega-nerf",
        cameras=tuple(cameras),
        views=tuple(views),
        predefined_split=any(v.split == "heldout" for v in views),
        metric=metric and _are_level(np.stack([view.c2w for view in views])),
    )


def _are_level(c2w: Float[np.ndarray, "n 4 4"]) -> bool:
    """Return whether the right axes of most cameras are horizontal, as with a drone's gimbal."""
    return bool(np.median(np.abs(c2w[:, 2, 0])) < MAX_TILT)


def _load(path: Path) -> dict[str, Any]:
    # Imported here to keep torch out of the start-up of the other formats.
    import torch

    try:
        _check_size(path)
        data = torch.load(path, map_location="cpu", weights_only=True)
    except UserError:
        raise
    except Exception as error:  # torch raises many types of exceptions for damaged files
        reason = str(error).strip().split("\n")[0][:80]
        raise UserError(
            f"{path} cannot be read ({type(error).__name__}: {reason}); download it again."
        ) from None
    if not isinstance(data, dict):
        raise UserError(f"{path} contains no dictionary of named values; download it again.")
    return data


def _check_size(path: Path) -> None:
    """Refuse a file that holds, or unpacks to, more than the metadata of a photo."""
    size = path.stat().st_size
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            size = max(size, sum(member.file_size for member in archive.infolist()))
    if size > MAX_METADATA:
        raise UserError(
            f"{path} holds {size / 1e6:.0f} MB, more than the metadata of a photo; download it"
            " again."
        )


def _array(data: dict[str, Any], key: str, shape: tuple[int, ...], path: Path) -> np.ndarray:
    if key not in data:
        raise UserError(f"{path} has no {key}; download it again.")
    try:
        values = np.asarray(data[key], dtype=np.float64)
    except (TypeError, ValueError, RuntimeError):
        raise UserError(f"{key} in {path} is not numeric; download the file again.") from None
    if values.shape != shape:
        raise UserError(
            f"{key} in {path} has shape {values.shape} instead of {shape}; download it again."
        )
    return values


def _coordinates(path: Path) -> tuple[np.ndarray, float]:
    """Return the origin, DRB metres, and the number of metres per unit."""
    data = _load(path)
    origin = _array(data, "origin_drb", (3,), path)
    scale = _array(data, "pose_scale_factor", (), path)
    if not (np.isfinite(origin).all() and np.isfinite(scale) and scale > 0):
        raise UserError(
            f"{path} has an origin that is not finite, or a scale that is not finite and above 0;"
            " correct it, or remove the file to have the scale estimated."
        )
    return origin, float(scale)


def _camera(data: dict[str, Any], path: Path) -> Camera:
    fx, fy, cx, cy = map(float, _array(data, "intrinsics", (4,), path))
    size = [float(_array(data, key, (), path)) for key in ("W", "H")]
    if not np.isfinite(size).all():
        raise UserError(f"W or H in {path} is not finite; download it again.")
    return checked_camera(Camera(int(size[0]), int(size[1]), fx, fy, cx, cy), str(path))
