"""`transforms.json` of nerfstudio, instant-ngp and the Blender scenes.

Poses are camera-to-world with OpenGL axes (x right, y up, z backward); columns 1 and 2 are negated
on reading to give OpenCV axes. The frame of the file is the input frame. It already includes
nerfstudio's `applied_transform`, which is not undone. instant-ngp's `scale` and `offset` concern
its viewer and are not applied.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from climatenerf.core import parsing
from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError
from climatenerf.scene.images import read_header
from climatenerf.scene.readers.capture import Capture, checked_camera, checked_pose
from climatenerf.scene.readers.ply import read_points
from climatenerf.scene.scene import MAX_VIEWS, View, is_file

SPLIT_FILES = ("transforms_train.json", "transforms_val.json", "transforms_test.json")
_PERSPECTIVE_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG")


def transforms_files(root: Path) -> list[Path]:
    """Return the files that describe the capture in folder `root`, or `root` if it is the file."""
    if root.is_file():
        siblings = [root.parent / n for n in SPLIT_FILES]
        return [s for s in siblings if s.is_file()] if root.name in SPLIT_FILES else [root]
    if (root / "transforms.json").is_file():
        return [root / "transforms.json"]
    return [root / n for n in SPLIT_FILES if (root / n).is_file()]


def read_transforms(root: Path) -> Capture:
    """Read `transforms.json`, or the three `transforms_{train,val,test}.json` of Blender scenes.

    A predefined split is kept: `{train,val,test}_filenames`, or the three files. Of the three
    files, test images are held out; validation images are used only if there is no test file.

    Raises:
        UserError: A file is damaged, or contains a camera or pose that is not supported.
    """
    files = transforms_files(root)
    if not files:
        raise UserError(f"{root} contains no transforms.json; give the folder of a capture.")
    base = files[0].parent
    by_name = {f.name: f for f in files}
    if SPLIT_FILES[0] in by_name and SPLIT_FILES[2] in by_name:
        by_name.pop(SPLIT_FILES[1], None)
    cameras: dict[Camera, int] = {}
    views: list[View] = []
    points, predefined_split, unlisted = None, False, 0
    for name, path in by_name.items():
        data = _load(path)
        train, heldout = _listed_split(data)
        predefined_split |= bool(train or heldout) or name in SPLIT_FILES
        for frame in data["frames"]:
            view = _view(frame, data, base, path, cameras)
            key = _normalised(frame["file_path"])
            held_out = key in heldout or name in SPLIT_FILES[1:]
            if not train or key in train or held_out:
                views.append(replace(view, split="heldout" if held_out else "train"))
            else:
                unlisted += 1
        cloud = data.get("ply_file_path")
        if isinstance(cloud, str) and is_file(base / cloud):
            points = read_points(base / cloud)
    if unlisted and not views:
        raise UserError(
            f"The lists of {files[0].name} (train_filenames, ...) name none of its frames; correct"
            " them, or remove them to hold out every 8th image."
        )
    return Capture(
        root=base,
        source="transforms",
        cameras=tuple(cameras),
        views=tuple(views),
        points=points if points is not None and len(points) else None,
        predefined_split=predefined_split,
        warnings=(
            (f"{unlisted} images are in none of the lists of {files[0].name}; they are left out.",)
            if unlisted
            else ()
        ),
    )


def _load(path: Path) -> dict[str, Any]:
    data = parsing.read_json(path, "the capture")
    frames = data.get("frames")
    if not isinstance(frames, list) or not frames:
        raise UserError(f"{path} has no list of frames; export it again.")
    if len(frames) > MAX_VIEWS:
        raise UserError(
            f"{path} has {len(frames)} frames, more than the {MAX_VIEWS} that can be read; leave"
            " some out."
        )
    for i, frame in enumerate(frames):
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise UserError(f"Frame {i} of {path} has no file_path; export it again.")
    return data


def _normalised(file_path: str) -> str:
    return file_path.replace("\\", "/").removeprefix("./")


def _listed_split(data: dict[str, Any]) -> tuple[set[str], set[str]]:
    """Return the file paths listed for training and those listed for validation or testing."""
    names = {k: data.get(f"{k}_filenames") for k in ("train", "val", "test")}
    names = {k: v if isinstance(v, list) else [] for k, v in names.items()}
    paths = {k: {_normalised(str(n)) for n in v} for k, v in names.items()}
    return paths["train"], (paths["val"] | paths["test"])


def _view(
    frame: dict[str, Any],
    data: dict[str, Any],
    base: Path,
    file: Path,
    cameras: dict[Camera, int],
) -> View:
    relative = _normalised(frame["file_path"])
    path = base / relative
    if not is_file(path) and path.suffix.lower() not in (s.lower() for s in _IMAGE_SUFFIXES):
        found = [p for s in _IMAGE_SUFFIXES if is_file(p := Path(f"{path}{s}"))]
        path = found[0] if found else Path(f"{path}.png")
    name = relative.removeprefix("images/")
    name = name if Path(name).suffix == path.suffix else name + path.suffix
    pose = checked_pose(frame.get("transform_matrix"), name, str(file))
    pose[:3, 1:3] *= -1
    mask = frame.get("mask_path")
    camera = _camera(frame, data, path, str(file))
    return View(
        name=name,
        path=path,
        camera=cameras.setdefault(camera, len(cameras)),
        c2w=pose,
        mask_path=base / _normalised(mask) if isinstance(mask, str) else None,
    )


def _camera(frame: dict[str, Any], data: dict[str, Any], path: Path, where: str) -> Camera:
    def number(key: str, default: float | None = None) -> float | None:
        value = frame.get(key, data.get(key, default))
        try:
            return None if value is None else float(value)
        except (TypeError, ValueError, OverflowError):
            raise UserError(f"{key} in {where} is not a number; correct the file.") from None

    model = str(frame.get("camera_model", data.get("camera_model", "OPENCV")))
    fisheye = model == "OPENCV_FISHEYE" or bool(frame.get("is_fisheye", data.get("is_fisheye")))
    if model not in (*_PERSPECTIVE_MODELS, "OPENCV_FISHEYE"):
        raise UserError(
            f"The camera model {model} in {where} is not supported; undistort the images "
            "(nerfstudio or colmap image_undistorter) and use the result."
        )
    width, height = number("w"), number("h")
    if width is None or height is None:
        # A missing image gets a placeholder size; it is left out later.
        header = read_header(path) if is_file(path) else None
        width, height = (header.width, header.height) if header else (1.0, 1.0)
    fx, fy = _focal_lengths(number, width, height, where)
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "k3", "p1", "p2")
    if not fisheye and number("k4", 0.0):
        raise UserError(
            f"{where} has k4 without a fisheye camera_model, which OpenCV's perspective model "
            "lacks; undistort the images or set camera_model to OPENCV_FISHEYE."
        )
    camera = Camera(
        width=int(width) if math.isfinite(width) else 0,
        height=int(height) if math.isfinite(height) else 0,
        fx=fx,
        fy=fy,
        cx=number("cx", width / 2) or 0.0,
        cy=number("cy", height / 2) or 0.0,
        fisheye=fisheye,
        **{n: number(n, 0.0) or 0.0 for n in names},
    )
    return checked_camera(camera, where)


def _focal_lengths(
    number: Callable[[str], float | None], width: float, height: float, where: str
) -> tuple[float, float]:
    """Return fx and fy, pixels, from `fl_x` and `fl_y` or from the angles of view."""
    fx, fy = number("fl_x"), number("fl_y")
    if fx is None and (angle := number("camera_angle_x")) is not None:
        fx = _focal_from_angle(width, angle, where)
        if fy is None and (angle := number("camera_angle_y")) is not None:
            fy = _focal_from_angle(height, angle, where)
    if fx is not None:
        return fx, fx if fy is None else fy
    if fy is None:
        raise UserError(
            f"{where} has neither fl_x nor camera_angle_x, so the focal length is unknown; "
            "add one of them."
        )
    return fy, fy


def _focal_from_angle(size: float, angle: float, where: str) -> float:
    if not 0 < angle < math.pi:
        raise UserError(
            f"The camera angle {angle:g} in {where} is not between 0 and pi radians, so the focal "
            "length would be 0; correct the file."
        )
    return 0.5 * size / math.tan(0.5 * angle)
