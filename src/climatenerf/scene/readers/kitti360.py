"""KITTI-360 as its authors lay it out, and as PanopticNeRF packs it.

Both have `calibration/` and `data_poses/DRIVE/`; the pictures `image_0C/data_rect/FRAME.png` are in
`data_2d_raw/DRIVE/` or, in the package, in `DRIVE/`. World: metres, z up. `cam0_to_world.txt` has
the poses of the rectified camera 0; camera 1 is at poses.txt (IMU to world) times its line of
calib_cam_to_pose.txt times the inverse of R_rect_01. Camera axes: OpenCV's. A frame has a pose only
where the car moved. Labels are Cityscapes ids: `data_2d_semantics/train/DRIVE/image_0C/semantic/`,
or the package's `pspnet/DRIVE/SCENE/*_FRAME.png` for camera 0.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError
from climatenerf.scene.label_spaces import CITYSCAPES_IDS, TRAIN_IDS
from climatenerf.scene.readers.capture import Capture, checked_camera, checked_pose
from climatenerf.scene.readers.text import frame_rows, keyed_lines, matrix_of
from climatenerf.scene.scene import View

MAX_PICTURES = 400  # of a drive's thousands, that are taken without being picked
CAMERAS = ("image_00", "image_01")
_DRIVE = re.compile(r"\d{4}_\d\d_\d\d_drive_\d{4}_sync")
_FRAME = re.compile(r"\d{10}")


def kitti360_root(path: Path) -> Path | None:
    """The data set's folder if `path` is it or the picture folder of one of its drives."""
    above = (path.parent, path.parent.parent) if _DRIVE.fullmatch(path.name) else ()
    return next((p for p in (path, *above) if (p / "data_poses").is_dir()), None)


def parse_frames(frames: str | tuple[int, int]) -> tuple[int, int]:
    """First and last frame, both included, of a pair or of a text such as "1538:1601".

    Raises:
        UserError: It is neither, or the first is after the last.
    """
    if isinstance(frames, str):
        found = re.fullmatch(r"\s*(\d+)\s*:\s*(\d+)\s*", frames)
        if not found:
            raise UserError(f'--frames is "{frames}"; give the first and last, such as 1538:1601.')
        frames = int(found[1]), int(found[2])
    if frames[0] > frames[1]:
        raise UserError(f"--frames {frames[0]}:{frames[1]} ends before it begins; exchange them.")
    return frames


def read_kitti360(path: Path, frames: tuple[int, int] | None = None) -> Capture:
    """Read one drive: both rectified cameras, as far as their pictures are there.

    Args:
        path: Folder of the data set if it has pictures of one drive only, else of a drive.
        frames: First and last frame, both included; None for all, if those are not too many.

    Raises:
        UserError: A file is missing or damaged, or it is not clear which pictures are meant.
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
    known: set[int] = set()
    for name in CAMERAS:
        pictures = {
            int(p.stem): p
            for p in sorted((folder / name / "data_rect").glob("*.png"))
            if _FRAME.fullmatch(p.stem) and (frames is None or _within(int(p.stem), frames))
        }
        if visible.is_dir():
            pictures = {f: p for f, p in pictures.items() if (visible / f"{f:010}.txt").is_file()}
        if not pictures:
            continue
        poses, where = _poses(root, drive, name, calibration)
        known |= set(poses)
        cameras.append(_camera(calibration, name, root))
        views += [
            View(
                name=f"{name}/{picture.name}",
                path=picture,
                camera=len(cameras) - 1,
                c2w=checked_pose(poses[frame], picture.name, where),
                label_path=_label(root, drive, name, frame),
            )
            for frame, picture in pictures.items()
            if frame in poses
        ]
        unposed += len(pictures.keys() - poses.keys())
    if not views:
        poses_there = f"; poses are known from {min(known)} to {max(known)}" if known else ""
        chosen = f" in frames {frames[0]}:{frames[1]}" if frames else ""
        raise UserError(
            f"{folder} has no picture with a pose{chosen}{poses_there}; choose other --frames or"
            " restore the pictures."
        )
    if frames is None and len(views) > MAX_PICTURES:
        raise UserError(
            f"{drive} has {len(views)} pictures with poses, more than a scene is made of; pick some"
            " with --frames FIRST:LAST, such as --frames 1538:1601."
        )
    labelled = any(v.label_path for v in views)
    left_out = f"{unposed} pictures of {drive} have no pose and are left out."
    return Capture(
        root=root,
        source="kitti360",
        cameras=tuple(cameras),
        views=tuple(views),
        warnings=(left_out,) if unposed else (),
        metric=True,
        label_space=CITYSCAPES_IDS if labelled else TRAIN_IDS,
    )


def _within(frame: int, frames: tuple[int, int]) -> bool:
    return frames[0] <= frame <= frames[1]


def _drive_folder(root: Path, path: Path) -> Path:
    """The picture folder of the drive that is meant."""
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
            f"{root} has poses but no pictures of theirs in data_2d_raw/DRIVE/image_00/data_rect or"
            " DRIVE/image_00/data_rect; add them."
        )
    if len(found) > 1:
        names = ", ".join(f.name for f in found)
        raise UserError(f"{root} has several drives ({names}); give the folder of one: {found[0]}")
    return found[0]


def _camera(calibration: Mapping[str, str], name: str, root: Path) -> Camera:
    path, number = root / "calibration" / "perspective.txt", name[-2:]
    size = matrix_of(calibration, f"S_rect_{number}", (2,), path)
    k = matrix_of(calibration, f"P_rect_{number}", (3, 4), path)
    # The data set counts pixels from the centre of the first one, this package from its corner.
    cx, cy = k[0, 2] + 0.5, k[1, 2] + 0.5
    fx, fy = float(k[0, 0]), float(k[1, 1])
    camera = Camera(int(size[0]), int(size[1]), fx, fy, float(cx), float(cy))
    return checked_camera(camera, str(path))


def _poses(
    root: Path, drive: str, name: str, calibration: Mapping[str, str]
) -> tuple[dict[int, Float[np.ndarray, "4 4"]], str]:
    """Camera-to-world poses of a rectified camera by frame, and the file that they come from."""
    folder = root / "data_poses" / drive
    if name == CAMERAS[0]:
        path = folder / "cam0_to_world.txt"
        return {f: np.reshape(v, (4, 4)) for f, v in frame_rows(path, 16).items()}, str(path)
    path, mounting = folder / "poses.txt", root / "calibration" / "calib_cam_to_pose.txt"
    perspective = root / "calibration" / "perspective.txt"
    turn = matrix_of(calibration, f"R_rect_{name[-2:]}", (3, 3), perspective)
    to_imu = np.eye(4)
    to_imu[:3] = matrix_of(keyed_lines(mounting), name, (3, 4), mounting)
    to_imu[:3, :3] = to_imu[:3, :3] @ _inverse(turn, perspective)
    return {f: np.reshape(v, (3, 4)) @ to_imu for f, v in frame_rows(path, 12).items()}, str(path)


def _inverse(turn: Float[np.ndarray, "3 3"], path: Path) -> Float[np.ndarray, "3 3"]:
    """The inverse of a rotation, whose rounded digits must be one."""
    if np.abs(turn @ turn.T - np.eye(3)).max() > 0.02:
        raise UserError(f"{path} has a rectification that is no rotation; download it again.")
    return np.linalg.inv(turn)


def _label(root: Path, drive: str, name: str, frame: int) -> Path | None:
    own = root / "data_2d_semantics/train" / drive / name / "semantic" / f"{frame:010}.png"
    if own.is_file():
        return own
    predicted = (root / "pspnet" / drive).glob(f"*/*_{frame:010}.png")
    return min(predicted, default=None) if name == CAMERAS[0] else None
