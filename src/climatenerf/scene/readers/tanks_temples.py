"""The NSVF layout, in which Tanks and Temples scenes for radiance fields are distributed.

`pose/STEM.txt` is the camera-to-world pose of `rgb/STEM.png` (or `images/`), 4x4, with OpenCV axes
(x right, y down, z forward), in an unknown unit of length. The prefix `0_` of a stem marks training
images, `1_` and `2_` mark test images. `intrinsics.txt` is one pinhole camera for all images. It is
a 4x4 matrix, on four lines or one; otherwise its first number is the focal length and the principal
point is the image centre. `bbox.txt`, `near_and_far.txt` and `camera_path/` are not used.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError
from climatenerf.core.listing import visible
from climatenerf.scene.findings import Finding
from climatenerf.scene.image_files import PHOTO_SUFFIXES
from climatenerf.scene.images import read_header
from climatenerf.scene.readers.capture import Capture, checked_camera, checked_pose
from climatenerf.scene.readers.text import parse_numbers, text_lines
from climatenerf.scene.scene import View

_TEST_PREFIXES = ("1_", "2_")


def is_tanks_temples(root: Path) -> bool:
    """Return whether `root` has poses in this layout."""
    return any(visible((root / "pose").glob("*.txt")))


def read_tanks_temples(root: Path) -> Capture:
    """Read `pose/*.txt`, `intrinsics.txt` and the size of the images.

    Test images are held out. A capture without test images has no predefined split.

    Raises:
        UserError: A file is missing or damaged, or no pose has an image.
    """
    folder = next((f for f in (root / "rgb", root / "images") if f.is_dir()), None)
    if folder is None:
        raise UserError(f"{root} has poses but neither rgb/ nor images/; add the images.")
    files = {
        p.stem: p for p in sorted(visible(folder.iterdir())) if p.suffix.lower() in PHOTO_SUFFIXES
    }
    poses = {p.stem: p for p in sorted(visible((root / "pose").glob("*.txt")))}
    posed = [files[stem] for stem in poses if stem in files]
    if not posed:
        raise UserError(
            f"No image in {folder} has the name of a pose in {root / 'pose'}; rename the images,"
            f" such as {next(iter(poses))}.png."
        )
    header = read_header(posed[0])
    views = tuple(
        View(
            name=(image := files.get(stem, folder / f"{stem}.png")).name,
            path=image,
            camera=0,
            c2w=_pose(path, image.name),
            split="heldout" if stem.startswith(_TEST_PREFIXES) else "train",
        )
        for stem, path in poses.items()
    )
    unposed = [p.name for stem, p in files.items() if stem not in poses]
    return Capture(
        root=root,
        source="tanks-temples",
        cameras=(_camera(root / "intrinsics.txt", header.width, header.height),),
        views=views,
        predefined_split=any(v.split == "heldout" for v in views),
        findings=_unposed(root, unposed) if unposed else (),
    )


def _unposed(root: Path, names: list[str]) -> tuple[Finding]:
    message = f"{len(names)} images have no pose (first: {names[0]}); they are left out"
    return (Finding("photo-without-pose", message, severity="note", file=str(root)),)


def _pose(path: Path, name: str) -> np.ndarray:
    values = [value for line in text_lines(path) for value in parse_numbers(line, path)]
    if len(values) not in (12, 16):
        raise UserError(
            f"{path} has {len(values)} numbers instead of the 16 of a 4x4 pose; export it again."
        )
    return checked_pose(np.reshape(values, (-1, 4)), name, str(path))


def _camera(path: Path, width: int, height: int) -> Camera:
    lines = [parse_numbers(line, path) for line in text_lines(path)]
    values = [value for line in lines for value in line]
    if not values:
        raise UserError(f"{path} is empty; write the 4x4 intrinsics to it.")
    # A matrix begins with fx and zero skew; the short form with f alone or f, cx, cy.
    if len(values) == 16 or (len(lines[0]) == 4 and values[1] == 0):
        if len(values) not in (12, 16):
            raise UserError(
                f"{path} has {len(values)} numbers instead of the 16 of a 4x4 matrix; export it"
                " again."
            )
        if abs(values[1]) > 1e-3 * abs(values[0]):
            raise UserError(f"{path} has skew, which is not supported; undistort the images.")
        fx, fy, cx, cy = values[0], values[5], values[2], values[6]
    else:
        fx = fy = values[0]
        cx, cy = width / 2, height / 2
    camera = checked_camera(Camera(width, height, fx, fy, cx, cy), str(path))
    if not (0 < cx < width and 0 < cy < height):
        raise UserError(
            f"{path} has its principal point at ({cx:g}, {cy:g}), outside the {width}x{height}"
            " images, so it belongs to another image size; use the images that it was made for."
        )
    return camera
