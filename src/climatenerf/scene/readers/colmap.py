"""COLMAP sparse models, text and binary.

The formats follow COLMAP's documentation (format.html): world-to-camera poses, Hamilton quaternions
with w first, camera axes x right, y down, z forward, centre of the top-left pixel at (0.5, 0.5).
"""

from __future__ import annotations

import itertools
import struct
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError, explain
from climatenerf.core.rotations import rotation_matrices
from climatenerf.scene.readers.capture import Capture, checked_camera, checked_pose
from climatenerf.scene.readers.ply import MAX_POSITION
from climatenerf.scene.scene import View, is_file

# Model id -> (name, number of parameters), as in COLMAP's sensor/models.h.
MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
}
_ONE_FOCAL = (
    "SIMPLE_PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
)
IMAGE_FOLDERS = ("images", "images_2", "images_4", "images_8", "input", "rgb", ".")
_FEATURE = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])


class _Image(NamedTuple):
    """One entry of the images file."""

    name: str
    camera: int
    c2w: Float[np.ndarray, "4 4"]
    points: Int[np.ndarray, " k"]
    """Point id of each feature, -1 for a feature without a point."""


def model_folders(root: Path) -> list[Path]:
    """Return the folders below `root` that contain a sparse model, or `root` if it is one."""
    if _suffix(root):
        return [root]
    candidates = [root / "sparse", *_subfolders(root / "sparse")]
    candidates += [root / "colmap" / "sparse", *_subfolders(root / "colmap" / "sparse")]
    candidates += _subfolders(root)
    return [c for c in candidates if _suffix(c)]


def read_colmap(root: Path) -> Capture:
    """Read the sub-model with the most images below `root`.

    Args:
        root: Folder with `images/` and `sparse/0/`, `sparse/` or several `sparse/N/`; or a model
            folder, in which case the images are searched in it and in the two folders above.

    Raises:
        UserError: A file is damaged, the model is empty, or its camera model is not supported.
    """
    model, chosen, warnings = _largest(root)
    by_id = _read_cameras(model)
    missing = {image.camera for image in chosen} - set(by_id)
    if missing:
        raise UserError(
            f"{model} has an image with camera {min(missing)}, which its cameras file lacks; "
            "export the model again."
        )
    ids = sorted({image.camera for image in chosen})
    image_root, folder = _image_folder(root, [image.name for image in chosen])
    point_ids, points = _read_points3d(model)
    views = tuple(
        View(
            name=image.name,
            path=folder / image.name,
            camera=ids.index(image.camera),
            c2w=image.c2w,
            seen=_observed_rows(image.points, point_ids),
        )
        for image in chosen
    )
    return Capture(
        root=image_root,
        source="colmap",
        cameras=tuple(by_id[i] for i in ids),
        views=views,
        points=points if len(points) else None,
        warnings=warnings,
    )


def largest_model(root: Path) -> Path:
    """Return the model folder that `read_colmap` reads.

    Raises:
        UserError: There is no model, or it is empty or damaged.
    """
    return _largest(root)[0]


def _largest(root: Path) -> tuple[Path, list[_Image], tuple[str, ...]]:
    """Return the model folder with the most images, its images, and warnings."""
    models = model_folders(root)
    if not models:
        raise UserError(
            f"{root} contains no COLMAP model (sparse/0/cameras.bin or .txt); give the folder of a"
            " reconstruction."
        )
    poses = [(m, _read_images(m)) for m in models]
    # `max` returns the first of equal models, and the folders are sorted.
    model, chosen = max(poses, key=lambda p: len(p[1]))
    if not chosen:
        raise UserError(f"The COLMAP model {model} has no image with a pose; run the mapper again.")
    if len(models) == 1:
        return model, chosen, ()
    sizes = ", ".join(f"{m.name}: {len(p)}" for m, p in poses)
    warning = (
        f"COLMAP produced {len(models)} separate models (images in each: {sizes}); "
        f"{model.name} is used, the others are left out."
    )
    return model, chosen, (warning,)


def _suffix(folder: Path) -> str | None:
    """Return the suffix of the model files in a folder, None if it contains no model."""
    for suffix in (".bin", ".txt"):
        if all((folder / f"{stem}{suffix}").is_file() for stem in ("cameras", "images")):
            return suffix
    return None


def _subfolders(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    found = [p for p in folder.iterdir() if p.is_dir()]
    return sorted(found, key=lambda p: (len(p.name), p.name))


def _image_folder(root: Path, names: list[str]) -> tuple[Path, Path]:
    """Return the capture's folder and the folder in it that has most of the named images."""
    roots = [root, root.parent, root.parent.parent] if _suffix(root) else [root]
    best, best_count = (roots[0], roots[0] / "images"), 0
    for base in roots:
        for sub in IMAGE_FOLDERS:
            folder = base / sub
            count = sum(is_file(folder / n) for n in names) if folder.is_dir() else 0
            if count > best_count:
                best, best_count = (base, folder), count
    return best


def camera_from_params(
    model: str, width: int, height: int, params: list[float], where: str
) -> Camera:
    """Return a camera from COLMAP's model name and parameter list.

    Args:
        model: Name such as "OPENCV".
        width: Image width, pixels.
        height: Image height, pixels.
        params: Parameters in COLMAP's order.
        where: File, for the message.

    Raises:
        UserError: The model is unknown or not supported, or has the wrong number of parameters.
    """
    needed = {name: n for name, n in MODELS.values()}.get(model)
    if needed is not None and len(params) != needed:
        raise UserError(
            f"A {model} camera in {where} has {len(params)} parameters instead of {needed}; "
            "export the model again."
        )
    k: dict[str, float] = {}
    if model in _ONE_FOCAL:
        fx = fy = params[0]
        cx, cy = params[1:3]
        k.update(zip(("k1", "k2"), params[3:], strict=False))
    elif model == "PINHOLE":
        fx, fy, cx, cy = params
    elif model == "OPENCV_FISHEYE":
        fx, fy, cx, cy = params[:4]
        k.update(zip(("k1", "k2", "k3", "k4"), params[4:], strict=True))
    elif model == "OPENCV" or (model == "FULL_OPENCV" and not any(params[9:])):
        fx, fy, cx, cy = params[:4]
        k.update(zip(("k1", "k2", "p1", "p2", "k3"), params[4:9], strict=False))
    else:
        raise UserError(
            f"The camera model {model} in {where} is not supported; undistort the images "
            "(colmap image_undistorter) and use the result."
        )
    camera = Camera(int(width), int(height), fx, fy, cx, cy, fisheye="FISHEYE" in model)
    return checked_camera(replace(camera, **k), where)


def _pose(q: list[float], t: list[float], name: str, where: str) -> Float[np.ndarray, "4 4"]:
    if not np.isfinite(q).all() or not np.isfinite(t).all() or np.abs([*q, *t]).max() > 1e12:
        raise UserError(
            f"The pose of {name} in {where} is not finite or far too large; remove that image or "
            "compute its pose again."
        )
    if np.linalg.norm(q) < 1e-6:
        raise UserError(
            f"The pose of {name} in {where} has a zero quaternion; compute its pose again."
        )
    rotation = rotation_matrices(np.array(q))
    c2w = np.eye(4)
    c2w[:3, :3] = rotation.T
    c2w[:3, 3] = -rotation.T @ np.array(t)
    return checked_pose(c2w, name, where)


class _Cursor:
    """Reads little-endian values from a file; errors name the file."""

    def __init__(self, path: Path):
        self.path = path
        try:
            self.data = path.read_bytes()
        except OSError as error:
            raise explain(error, path) from None
        self.offset = 0

    def damaged(self) -> UserError:
        return UserError(f"{self.path} is truncated or damaged; export the COLMAP model again.")

    def take(self, form: str) -> tuple:
        """Return values in a format of the `struct` module, without its byte order."""
        form = "<" + form
        try:
            values = struct.unpack_from(form, self.data, self.offset)
        except struct.error:
            raise self.damaged() from None
        self.offset += struct.calcsize(form)
        return values

    def skip(self, size: int) -> None:
        """Advance by `size` bytes."""
        self.offset += size
        if self.offset > len(self.data):
            raise self.damaged()

    def name(self) -> str:
        """Return a zero-terminated name."""
        end = self.data.find(b"\0", self.offset)
        if end < 0:
            raise self.damaged()
        raw, self.offset = self.data[self.offset : end], end + 1
        try:
            text = raw.decode("utf-8")
        except UnicodeDecodeError:
            raise self.damaged() from None
        if not text or not text.isprintable():
            raise self.damaged()
        return text


def _read_cameras(model: Path) -> dict[int, Camera]:
    path = model / f"cameras{_suffix(model)}"
    if path.suffix == ".txt":
        return _cameras_text(path)
    cursor = _Cursor(path)
    out = {}
    for _ in range(cursor.take("Q")[0]):
        key, kind, width, height = cursor.take("IiQQ")
        if kind not in MODELS:
            if not 0 <= kind < 64:
                raise cursor.damaged()
            raise UserError(
                f"The camera model with id {kind} in {path} is not supported; undistort the "
                "images (colmap image_undistorter) and use the result."
            )
        name, count = MODELS[kind]
        params = list(cursor.take(f"{count}d"))
        out[key] = camera_from_params(name, width, height, params, str(path))
    return out


def _read_images(model: Path) -> list[_Image]:
    path = model / f"images{_suffix(model)}"
    if path.suffix == ".txt":
        return _images_text(path)
    cursor = _Cursor(path)
    out = []
    for _ in range(cursor.take("Q")[0]):
        values = cursor.take("I7dI")
        name = cursor.name()
        count, start = cursor.take("Q")[0], cursor.offset
        cursor.skip(24 * count)
        observed = np.frombuffer(cursor.data, _FEATURE, count, start)["point"]
        pose = _pose(list(values[1:5]), list(values[5:8]), name, str(path))
        out.append(_Image(name, values[8], pose, observed.astype(np.int64)))
    return out


def _observed_rows(
    observed: Int[np.ndarray, " k"], ids: Int[np.ndarray, " n"]
) -> Int[np.ndarray, " m"]:
    """Return the sorted rows of the points with the observed ids; id -1 has no row."""
    if not len(ids):
        return np.empty(0, np.int64)
    order = np.argsort(ids)
    position = np.searchsorted(ids, observed, sorter=order).clip(max=len(ids) - 1)
    row = order[position]
    return np.unique(row[ids[row] == observed])


def _read_points3d(model: Path) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """Return ids and positions, input frame, of the points up to `MAX_POSITION`."""
    path = model / f"points3D{_suffix(model)}"
    if not path.is_file():
        return np.empty(0, np.int64), np.empty((0, 3))
    if path.suffix == ".txt":
        rows = [line.split()[:4] for line in _lines(path) if line]
        try:
            ids = np.array([int(r[0]) for r in rows], np.int64)
            points = np.array([[float(v) for v in r[1:]] for r in rows]).reshape(-1, 3)
        except (ValueError, OverflowError):
            raise UserError(f"{path} is damaged; export the COLMAP model again.") from None
    else:
        cursor = _Cursor(path)
        count = cursor.take("Q")[0]
        if count * 51 > len(cursor.data):  # 51 bytes: a point without its track
            raise cursor.damaged()
        ids, points = np.empty(count, np.int64), np.empty((count, 3))
        for i in range(count):
            values = cursor.take("q3d3BdQ")
            ids[i], points[i] = values[0], values[1:4]
            cursor.skip(8 * values[8])
    usable = (np.abs(points) <= MAX_POSITION).all(axis=1)  # NaN is not
    return ids[usable], points[usable]


def _lines(path: Path) -> list[str]:
    """Return the lines without comments; an empty line means an image without features."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise explain(error, path) from None
    except UnicodeDecodeError as error:
        raise UserError(
            f"{path} cannot be read as text ({error}); export the COLMAP model again."
        ) from None
    return [line.strip() for line in text.splitlines() if not line.startswith("#")]


def _line_error(path: Path, line: str) -> UserError:
    return UserError(
        f"{path} has an unreadable line: {line[:60]!r}; export the COLMAP model again."
    )


def _cameras_text(path: Path) -> dict[int, Camera]:
    out = {}
    for line in filter(None, _lines(path)):
        words = line.split()
        try:
            key, width, height = int(words[0]), int(words[2]), int(words[3])
            params = [float(w) for w in words[4:]]
        except (ValueError, IndexError):
            raise _line_error(path, line) from None
        out[key] = camera_from_params(words[1], width, height, params, str(path))
    return out


def _images_text(path: Path) -> list[_Image]:
    lines = _lines(path)
    while lines and not lines[0]:
        lines.pop(0)
    out = []
    for line, features in itertools.zip_longest(lines[::2], lines[1::2], fillvalue=""):
        if not line:
            continue
        words = line.split(maxsplit=9)
        try:
            numbers = [float(w) for w in words[1:8]]
            camera, name = int(words[8]), words[9]
            observed = np.array([int(w) for w in features.split()[2::3]], np.int64)
        except (ValueError, IndexError, OverflowError):
            raise _line_error(path, line) from None
        pose = _pose(numbers[:4], numbers[4:], name, str(path))
        out.append(_Image(name, camera, pose, observed))
    return out
