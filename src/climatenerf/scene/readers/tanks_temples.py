"""The layout of NSVF, which Tanks and Temples scenes for radiance fields come in.

`pose/STEM.txt` is the camera-to-world pose of `rgb/STEM.png` (or `images/`), 4x4, with OpenCV axes
(+x right, +y down, +z forward), in units of no known length. Stems that begin with `0_` are for
training, `1_` and `2_` for testing. `intrinsics.txt` is one pinhole camera for all: a 4x4 matrix,
on four lines or one, or else its first number is the focal length and the principal point is the
pictures' centre. `bbox.txt`, `near_and_far.txt` and `camera_path/` are not needed.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError
from climatenerf.scene.images import picture_header
from climatenerf.scene.readers.capture import Capture, checked_camera, checked_pose
from climatenerf.scene.readers.text import numbers, text_lines
from climatenerf.scene.scene import View

_SUFFIXES = (".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")
_HELDOUT = ("1_", "2_")


def is_tanks_temples(root: Path) -> bool:
    """Whether `root` has poses in this layout."""
    return any((root / "pose").glob("*.txt"))


def read_tanks_temples(root: Path) -> Capture:
    """Read `pose/*.txt`, `intrinsics.txt` and the pictures' size.

    Pictures for testing are held out; where none are, the split is not the capture's own.

    Raises:
        UserError: A file is missing or damaged, or no pose has a picture.
    """
    folder = next((f for f in (root / "rgb", root / "images") if f.is_dir()), None)
    if folder is None:
        raise UserError(f"{root} has poses but neither rgb/ nor images/; add the pictures.")
    files = {p.stem: p for p in sorted(folder.iterdir()) if p.suffix in _SUFFIXES}
    poses = {p.stem: p for p in sorted((root / "pose").glob("*.txt"))}
    posed = [files[stem] for stem in poses if stem in files]
    if not posed:
        raise UserError(
            f"No picture in {folder} has the name of a pose in {root / 'pose'}, such as"
            f" {next(iter(poses))}.png; name them alike."
        )
    header = picture_header(posed[0])
    views = tuple(
        View(
            name=(picture := files.get(stem, folder / f"{stem}.png")).name,
            path=picture,
            camera=0,
            c2w=_pose(path, picture.name),
            split="heldout" if stem.startswith(_HELDOUT) else "train",
        )
        for stem, path in poses.items()
    )
    unposed = [p.name for stem, p in files.items() if stem not in poses]
    return Capture(
        root=root,
        source="tanks-temples",
        cameras=(_camera(root / "intrinsics.txt", header.width, header.height),),
        views=views,
        own_split=any(v.split == "heldout" for v in views),
        warnings=(
            (f"{len(unposed)} pictures have no pose (first: {unposed[0]}); they are left out.",)
            if unposed
            else ()
        ),
    )


def _pose(path: Path, name: str) -> np.ndarray:
    values = [value for line in text_lines(path) for value in numbers(line, path)]
    if len(values) not in (12, 16):
        raise UserError(
            f"{path} has {len(values)} numbers instead of the 16 of a 4x4 pose; export it again."
        )
    return checked_pose(np.reshape(values, (-1, 4)), name, str(path))


def _camera(path: Path, width: int, height: int) -> Camera:
    lines = [numbers(line, path) for line in text_lines(path)]
    values = [value for line in lines for value in line]
    if not values:
        raise UserError(f"{path} is empty; it must hold the 4x4 intrinsics.")
    # A matrix begins with fx and no skew; the other kind with f alone or f, cx, cy.
    if len(values) == 16 or (len(lines[0]) == 4 and values[1] == 0):
        if len(values) not in (12, 16):
            raise UserError(
                f"{path} has {len(values)} numbers instead of the 16 of a 4x4 matrix; export it"
                " again."
            )
        if abs(values[1]) > 1e-3 * abs(values[0]):
            raise UserError(f"{path} has skew, which is not supported; undistort the pictures.")
        fx, fy, cx, cy = values[0], values[5], values[2], values[6]
    else:
        fx = fy = values[0]
        cx, cy = width / 2, height / 2
    camera = checked_camera(Camera(width, height, fx, fy, cx, cy), str(path))
    if not (0 < cx < width and 0 < cy < height):
        raise UserError(
            f"{path} has its principal point at ({cx:g}, {cy:g}), outside of the {width}x{height}"
            " pictures, so it is for another size; use the pictures that it was made for."
        )
    return camera
