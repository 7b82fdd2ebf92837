"""KITTI-360 in its official layout and in the package of PanopticNeRF.

Both have `calibration/` and `data_poses/DRIVE/`. The images `image_0C/data_rect/FRAME.png` are in
`data_2d_raw/DRIVE/`, or in `DRIVE/` of the package. The world frame is in metres with z up; camera
axes are OpenCV's. `cam0_to_world.txt` holds the poses of the rectified camera 0. The pose of camera
1 is the product of poses.txt (IMU to world), its line of calib_cam_to_pose.txt, and the inverse of
R_rect_01. Frames in which the car did not move have no pose. Labels are Cityscapes ids:
`data_2d_semantics/train/DRIVE/image_0C/semantic/`, or `pspnet/DRIVE/SCENE/*_FRAME.png` of the
package for camera 0.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError, one_line
from climatenerf.core.listing import visible
from climatenerf.scene.findings import Finding
from climatenerf.scene.label_spaces import CITYSCAPES_IDS, TRAIN_IDS
from climatenerf.scene.readers.capture import Capture, checked_camera, checked_pose
from climatenerf.scene.readers.text import frame_rows, keyed_lines, parse_array
from climatenerf.scene.scene import View

MAX_IMAGES = 400  # read without a selection of frames; a drive has thousands
CAMERAS = ("image_00", "image_01")
_DRIVE = re.compile(r"\d{4}_\d\d_\d\d_drive_\d{4}_sync")
_FRAME = re.compile(r"\d{10}")


def kitti360_root(path: Path) -> Path | None:
    """Return the data set's folder if `path` is it or the image folder of a drive, else None."""
    above = (path.parent, path.parent.parent) if _DRIVE.fullmatch(path.name) else ()
    return next((p for p in (path, *above) if (p / "data_poses").is_dir()), None)


def parse_frames(frames: str | tuple[int, int]) -> tuple[int, int]:
    """Return the first and last frame, both included, of a pair or of a text such as "1538:1601".

    Raises:
        UserError: The text has another form, or the first frame is after the last.
    """
    if isinstance(frames, str):
        found = re.fullmatch(r"\s*(\d{1,10})\s*:\s*(\d{1,10})\s*", frames)
        if not found:
            raise UserError(
                f'--frames is "{one_line(frames, 60)}"; give two frames, such as 1538:1601.'
            )
        frames = int(found[1]), int(found[2])
    if frames[0] > frames[1]:
        raise UserError(f"--frames {frames[0]}:{frames[1]} ends before it begins; exchange them.")
    return frames


def read_kitti360(path: Path, frames: tuple[int, int] | None = None) -> Capture:
    """Read one drive: the images of both rectified cameras that are on disk.

    Args:
        path: Folder of the data set if it has images of one drive only, else of a drive.
        frames: First and last frame, both included; None for all, up to `MAX_IMAGES` images.

    Raises:
        UserError: A file is missing or damaged, or `path` and `frames` do not determine the images.
    """
    root = kitti360_root(path)
    if root is None:
        raise UserError(f"{path} has no data_poses/; give the folder of KITTI-360.")
    folder = _drive_folder(root, path)
    drive = folder.name
    calibration = keyed_lines(root / "calibration" / "perspective.txt")
    visible = root / "visible_id" / drive
    cameras: list[Camera] = []
    views: list[View] = []
    unposed = 0
    posed_frames: set[int] = set()
    for name in CAMERAS:
        images = {
            int(p.stem): p
            for p in sorted((folder / name / "data_rect").glob("*.png"))
            if _FRAME.fullmatch(p.stem) and (frames is None or _within(int(p.stem), frames))
        }
        if visible.is_dir():
            images = {f: p for f, p in images.items() if (visible / f"{f:010}.txt").is_file()}
        if not images:
            continue
        poses, where = _poses(root, drive, name, calibration)
        posed_frames |= set(poses)
        cameras.append(_camera(calibration, name, root))
        views += [
            View(
                name=f"{name}/{image.name}",
                path=image,
                camera=len(cameras) - 1,
                c2w=checked_pose(poses[frame], image.name, where),
                label_path=_label(root, drive, name, frame),
            )
            for frame, image in images.items()
            if frame in poses
        ]
        unposed += len(images.keys() - poses.keys())
    if not views:
        selected = f" in frames {frames[0]}:{frames[1]}" if frames else ""
        available = (
            f"; poses exist from {min(posed_frames)} to {max(posed_frames)}" if posed_frames else ""
        )
        raise UserError(
            f"{folder} has no image with a pose{selected}{available}; choose other --frames or"
            " restore the images."
        )
    if frames is None and len(views) > MAX_IMAGES:
        raise UserError(
            f"{drive} has {len(views)} images with poses, more than {MAX_IMAGES}; select some with"
            " --frames FIRST:LAST, such as --frames 1538:1601."
        )
    labelled = any(v.label_path for v in views)
    left_out = Finding(
        "photo-without-pose",
        f"{unposed} images of {drive} have no pose; they are left out",
        severity="note",
        file=str(root),
    )
    return Capture(
        root=root,
        source="kitti360",
        cameras=tuple(cameras),
        views=tuple(views),
        findings=(left_out,) if unposed else (),
        metric=True,
        label_space=CITYSCAPES_IDS if labelled else TRAIN_IDS,
    )


def _within(frame: int, frames: tuple[int, int]) -> bool:
    return frames[0] <= frame <= frames[1]


def _drive_folder(root: Path, path: Path) -> Path:
    """Return the image folder of the only drive, or `path` if it is one."""
    if path != root:
        return path
    found = [
        folder / drive.name
        for drive in sorted((root / "data_poses").iterdir())
        for folder in (root / "data_2d_raw", root)
        if any((folder / drive.name / name / "data_rect").is_dir() for name in CAMERAS)
    ]
    if not found:
        raise UserError(
            f"{root} has poses but no images of them in data_2d_raw/DRIVE/image_00/data_rect or"
            " DRIVE/image_00/data_rect; add the images."
        )
    if len(found) > 1:
        names = ", ".join(f.name for f in found)
        raise UserError(
            f"{root} has several drives ({names}); give the folder of one, such as {found[0]}."
        )
    return found[0]


def _camera(calibration: Mapping[str, str], name: str, root: Path) -> Camera:
    path, number = root / "calibration" / "perspective.txt", name[-2:]
    size = parse_array(calibration, f"S_rect_{number}", (2,), path)
    k = parse_array(calibration, f"P_rect_{number}", (3, 4), path)
    # The pixel origin of the data set is the centre of the first pixel; ours is its corner.
    cx, cy = k[0, 2] + 0.5, k[1, 2] + 0.5
    fx, fy = float(k[0, 0]), float(k[1, 1])
    camera = Camera(int(size[0]), int(size[1]), fx, fy, float(cx), float(cy))
    return checked_camera(camera, str(path))


def _poses(
    root: Path, drive: str, name: str, calibration: Mapping[str, str]
) -> tuple[dict[int, Float[np.ndarray, "rows 4"]], str]:
    """Return the camera-to-world poses of a rectified camera by frame, and their file.

    The poses have 4 rows for camera 0 and 3 rows for camera 1, as in the files.
    """
    folder = root / "data_poses" / drive
    if name == CAMERAS[0]:
        path = folder / "cam0_to_world.txt"
        return {f: np.reshape(v, (4, 4)) for f, v in frame_rows(path, 16).items()}, str(path)
    path, extrinsics = folder / "poses.txt", root / "calibration" / "calib_cam_to_pose.txt"
    perspective = root / "calibration" / "perspective.txt"
    rectification = parse_array(calibration, f"R_rect_{name[-2:]}", (3, 3), perspective)
    to_imu = np.eye(4)
    to_imu[:3] = parse_array(keyed_lines(extrinsics), name, (3, 4), extrinsics)
    to_imu[:3, :3] = to_imu[:3, :3] @ _inverse(rectification, perspective)
    return {f: np.reshape(v, (3, 4)) @ to_imu for f, v in frame_rows(path, 12).items()}, str(path)


def _inverse(rotation: Float[np.ndarray, "3 3"], path: Path) -> Float[np.ndarray, "3 3"]:
    """Return the inverse of a rotation given with rounded digits."""
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 0.02:
        raise UserError(f"{path} has a rectification that is no rotation; download it again.")
    return np.linalg.inv(rotation)


def _label(root: Path, drive: str, name: str, frame: int) -> Path | None:
    official = root / "data_2d_semantics/train" / drive / name / "semantic" / f"{frame:010}.png"
    if official.is_file():
        return official
    predicted = (root / "pspnet" / drive).glob(f"*/*_{frame:010}.png")
    return min(visible(predicted), default=None) if name == CAMERAS[0] else None
