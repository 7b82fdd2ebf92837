"""`transforms.json` of nerfstudio, instant-ngp and the Blender scenes.

Poses are camera-to-world with OpenGL axes (x right, y up, z backward); columns 1 and 2 are negated
on reading to give OpenCV axes. The frame of the file is the input frame. It already includes
nerfstudio's `applied_transform`, which is not undone. instant-ngp's `scale` and `offset` concern
its viewer and are not applied. Depth files are those of nerfstudio (`depth_file_path`,
`depth_unit_scale_factor`) and of NeRFCapture, Record3D and Polycam (`depth_path`,
`integer_depth_scale`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from climatenerf.core import parsing
from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError
from climatenerf.core.regular_files import check_regular
from climatenerf.scene.file_names import FileNames, folded, normalised
from climatenerf.scene.findings import Finding, counted, examples
from climatenerf.scene.image_files import PHOTO_SUFFIXES
from climatenerf.scene.images import read_header
from climatenerf.scene.readers.capture import Capture, checked_camera, checked_pose
from climatenerf.scene.readers.ply import read_points
from climatenerf.scene.scene import MAX_VIEWS, MILLIMETRES, View, is_file

SPLIT_FILES = ("transforms_train.json", "transforms_val.json", "transforms_test.json")
_PERSPECTIVE_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG", ".heic", ".HEIC")
_DEPTH_KEYS = ("depth_file_path", "depth_path")
_DEPTH_SCALES = ("depth_unit_scale_factor", "integer_depth_scale")
_READ_PATHS = {"file_path", "mask_path", "ply_file_path", *_DEPTH_KEYS}
# What tells the name of a file from another text: the end of its key, or its own end.
_FILE_KEYS = ("_path", "_file", "_filename")
_FILE_SUFFIXES = {*PHOTO_SUFFIXES, ".npy", ".npz", ".exr", ".pfm", ".hdr", ".ply", ".pcd", ".pt"}
_MAX_NAME = 1024
# Coefficients of lens models that this program lacks; zero values change nothing.
_UNREAD_NUMBERS = ("k5", "k6", "s1", "s2", "s3", "s4", "rolling_shutter_time")


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
    points, predefined_split, unlisted, depth_scale = None, False, 0, None
    files_below, transforms = FileNames(base), []
    unread: dict[str, int] = {}
    absent: list[str] = []
    for name, path in by_name.items():
        data = _load(path)
        train, heldout = _listed_split(data)
        # A listed name that no frame has exactly may differ from that of a frame in its spelling.
        exact = {normalised(frame["file_path"]) for frame in data["frames"]}
        respelled = {folded(name): name for name in (train | heldout) - exact}
        predefined_split |= bool(train or heldout) or name in SPLIT_FILES
        for frame in data["frames"]:
            view = _view(frame, data, files_below, path, cameras)
            absent += _absent_depth(frame, view, files_below)
            absent += _count_unread(frame, files_below, unread)
            _count_frame_scales(frame, data, unread)
            key = normalised(frame["file_path"])
            key = respelled.get(folded(key), key)
            held_out = key in heldout or name in SPLIT_FILES[1:]
            if not train or key in train or held_out:
                views.append(replace(view, split="heldout" if held_out else "train"))
            else:
                unlisted += 1
        absent += _count_unread(data, files_below, unread)
        depth_scale = _depth_scale(data, str(path)) or depth_scale
        if len({data[key] for key in _DEPTH_SCALES if data.get(key) is not None}) > 1:
            unread[f"{_DEPTH_SCALES[1]}, which contradicts {_DEPTH_SCALES[0]}"] = 1
        transforms += _point_transforms(data)
        cloud = data.get("ply_file_path")
        if isinstance(cloud, str):
            if (file := files_below.find(cloud)) is not None:
                points = read_points(file)
            elif cloud not in files_below.ambiguous:
                check_regular(files_below.folder / normalised(cloud))
                absent.append(cloud)
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
        findings=(
            *_named_data_findings(files[0], unlisted, absent, unread),
            *files_below.findings(),
        ),
        depth_scale=depth_scale or MILLIMETRES,
        point_transforms=tuple(transforms),
        ambiguous=files_below.ambiguous_paths(),
    )


def _named_data_findings(
    file: Path, unlisted: int, absent: list[str], unread: dict[str, int]
) -> list[Finding]:
    """Return findings about images in no list, absent files and keys that are not read."""
    out = []
    if unlisted:
        message = f"{unlisted} images are in none of the lists of {file.name}; they are left out"
        remedy = "add them to train_filenames, or remove the lists"
        out.append(Finding("photo-unlisted", message, remedy, file=str(file)))
    if absent:
        message = (
            f"{counted(len(absent), 'file')} named in {file.name} but not on disk"
            f" ({examples(absent)})"
        )
        remedy = "restore them if they matter"
        out.append(Finding("file-missing", message, remedy, file=str(file)))
    if unread:
        counts = [f"{key} ({n} times)" if n > 1 else key for key, n in unread.items()]
        message = f"{file.name} has data that is not read: {examples(counts, 6)}"
        remedy = "convert it to a key that docs/formats.md lists if it matters"
        out.append(Finding("file-unread", message, remedy, file=str(file)))
    return out


def _count_unread(table: dict[str, Any], files: FileNames, unread: dict[str, int]) -> list[str]:
    """Count the keys of a table that name a file or a lens coefficient and are not read.

    Other keys (`sharpness`, `colmap_im_id`, `aabb_scale`, time stamps) carry nothing that a fit
    could use.

    Args:
        table: A frame, or the whole file.
        files: The files of the capture.
        unread: Gets the counts.

    Returns:
        The named files that are not on disk.
    """
    absent = []
    for key, value in table.items():
        if key in _UNREAD_NUMBERS:
            found = isinstance(value, int | float) and bool(value)
        elif key in _READ_PATHS:
            found = not isinstance(value, str | None)
            key = f"{key} that is no text"
        elif not _names_a_file(key, value):
            continue
        elif not (found := files.find(value) is not None) and value not in files.ambiguous:
            absent += [] if _is_folder(files.folder / normalised(value)) else [value]
        if found:
            unread[key] = unread.get(key, 0) + 1
    return absent


def _count_frame_scales(
    frame: dict[str, Any], data: dict[str, Any], unread: dict[str, int]
) -> None:
    """Count the units of depth files that a frame has for itself and that differ from the file's.

    Args:
        frame: A frame.
        data: The whole file.
        unread: Gets the counts.
    """
    for key in _DEPTH_SCALES:
        if frame.get(key) is not None and frame[key] != data.get(key):
            name = f"{key} of single frames"
            unread[name] = unread.get(name, 0) + 1


def _names_a_file(key: str, value: Any) -> bool:
    """Return whether a value is a path rather than another text or an address."""
    if not isinstance(value, str) or not 0 < len(value) < _MAX_NAME:
        return False
    if "\0" in value or "\n" in value or "://" in value:
        return False
    return key.endswith(_FILE_KEYS) or Path(normalised(value)).suffix.lower() in _FILE_SUFFIXES


def _is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except OSError:  # a name that is too long
        return False


def _absent_depth(frame: dict[str, Any], view: View, files: FileNames) -> list[str]:
    """Return the depth file that a frame names and that is not on disk."""
    named = next((frame[key] for key in _DEPTH_KEYS if isinstance(frame.get(key), str)), None)
    if named is None or view.depth_path is not None or named in files.ambiguous:
        return []
    return [named]


def _depth_scale(data: dict[str, Any], where: str) -> float | None:
    """Return the metres per unit of integer depth files, None if the file states none."""
    for key in _DEPTH_SCALES:
        value = data.get(key)
        if value is None:
            continue
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise UserError(f"{key} in {where} is not a number; correct the file.")
        if not 1e-9 < value < 1e3:
            raise UserError(
                f"{key} in {where} is {value:g}; it must be the metres per unit of the depth files,"
                " such as 0.001, so correct it."
            )
        return float(value)
    return None


def _point_transforms(data: dict[str, Any]) -> list[Float[np.ndarray, "4 4"]]:
    """Return `applied_transform`, which the poses include and a point cloud may lack."""
    try:
        given = np.array(data.get("applied_transform"), dtype=np.float64)
    except (TypeError, ValueError):
        return []
    if given.shape not in ((3, 4), (4, 4)) or not np.isfinite(given).all():
        return []
    out = np.eye(4)
    out[: len(given)] = given
    return [out] if abs(np.linalg.det(out[:3, :3])) > 1e-6 else []


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


def _listed_split(data: dict[str, Any]) -> tuple[set[str], set[str]]:
    """Return the file paths listed for training and those listed for validation or testing."""
    names = {k: data.get(f"{k}_filenames") for k in ("train", "val", "test")}
    names = {k: v if isinstance(v, list) else [] for k, v in names.items()}
    paths = {k: {normalised(str(n)) for n in v} for k, v in names.items()}
    return paths["train"], (paths["val"] | paths["test"])


def _view(
    frame: dict[str, Any],
    data: dict[str, Any],
    files: FileNames,
    file: Path,
    cameras: dict[Camera, int],
) -> View:
    relative = normalised(frame["file_path"])
    path = files.find(relative) or files.folder / relative
    if not is_file(path) and path.suffix.lower() not in (s.lower() for s in _IMAGE_SUFFIXES):
        names = [f"{relative}{suffix}" for suffix in _IMAGE_SUFFIXES]
        found = files.find_any(names)
        name = next((name for name in names if name in files.ambiguous), names[0])
        files.note_alternatives(relative, names)
        path = found or files.folder / name
    name = relative.removeprefix("images/")
    name = name if Path(name).suffix == path.suffix else name + path.suffix
    pose = checked_pose(frame.get("transform_matrix"), name, str(file))
    pose[:3, 1:3] *= -1
    mask = frame.get("mask_path")
    depths = [frame[key] for key in _DEPTH_KEYS if isinstance(frame.get(key), str)]
    camera = _camera(frame, data, path, str(file))
    return View(
        name=name,
        path=path,
        camera=cameras.setdefault(camera, len(cameras)),
        c2w=pose,
        mask_path=_named(files, mask) if isinstance(mask, str) else None,
        depth_path=files.find(depths[0]) if depths else None,
    )


def _named(files: FileNames, name: str) -> Path:
    return files.find(name) or files.folder / normalised(name)


def _camera(frame: dict[str, Any], data: dict[str, Any], path: Path, where: str) -> Camera:
    def number(key: str, default: float | None = None) -> float | None:
        value = frame.get(key, data.get(key, default))
        try:
            if isinstance(value, bool):
                raise TypeError
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
