"""COLMAP sparse models, text and binary.

The formats follow COLMAP's documentation (format.html): world-to-camera poses, Hamilton quaternions
with w first, camera axes x right, y down, z forward, centre of the top-left pixel at (0.5, 0.5).
"""

from __future__ import annotations

import struct
import unicodedata
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError, explain
from climatenerf.core.listing import visible
from climatenerf.core.regular_files import check_regular
from climatenerf.core.rotations import rotation_matrices
from climatenerf.core.text import decode, lines_of, read_text
from climatenerf.scene.file_names import FileNames
from climatenerf.scene.findings import Finding
from climatenerf.scene.readers.capture import Capture, checked_camera, checked_pose
from climatenerf.scene.readers.ply import MAX_POSITION
from climatenerf.scene.scene import View

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
MAX_LACKING = 0.05  # fraction of the points that images show and the model may lack
_FEATURE = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])


class _Image(NamedTuple):
    """One entry of the images file; a text model may lack the features."""

    name: str
    camera: int
    c2w: Float[np.ndarray, "4 4"]
    points: Int[np.ndarray, " k"] | None
    """Point id of each feature, -1 for a feature without a point; None if the file has no line of
    features."""


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
    model, chosen, findings = _largest(root)
    by_id = _read_cameras(model)
    missing = {image.camera for image in chosen} - set(by_id)
    if missing:
        raise UserError(
            f"{model} has an image with camera {min(missing)}, which its cameras file lacks; "
            "export the model again."
        )
    ids = sorted({image.camera for image in chosen})
    image_root, files = _image_folder(root, [image.name for image in chosen])
    point_ids, points = _read_points3d(model)
    if len(points) and not any(image.points is not None and len(image.points) for image in chosen):
        # Empty lines in place of features that were left out.
        chosen = [image._replace(points=None) for image in chosen]
    views = tuple(
        View(
            name=image.name,
            path=files.find(image.name) or files.folder / image.name,
            camera=ids.index(image.camera),
            c2w=image.c2w,
            seen=None if image.points is None else _observed_rows(image.points, point_ids),
        )
        for image in chosen
    )
    return Capture(
        root=image_root,
        source="colmap",
        cameras=tuple(by_id[i] for i in ids),
        views=views,
        points=points if len(points) else None,
        findings=(
            *findings,
            *_feature_lines(model, chosen),
            *_lacking_points(model, chosen, point_ids),
            *files.findings(),
        ),
        ambiguous=files.ambiguous_paths(),
    )


def _feature_lines(model: Path, images: list[_Image]) -> list[Finding]:
    """Return a finding if a text model has images without a line of features."""
    count = sum(image.points is None for image in images)
    if not count:
        return []
    message = (
        f"The COLMAP model {model} has no features for {count} of its {len(images)} images, so it"
        " is unknown which points they show"
    )
    remedy = "export the model with features if that is possible"
    return [Finding("model-lines", message, remedy, "note", str(model))]


def _lacking_points(model: Path, images: list[_Image], ids: Int[np.ndarray, " n"]) -> list[Finding]:
    """Return a finding if images show points that the model lacks, as after a file was cut off."""
    observed = [image.points[image.points >= 0] for image in images if image.points is not None]
    shown = np.unique(np.concatenate(observed)) if observed else np.empty(0, np.int64)
    lacking = int((~np.isin(shown, ids)).sum())
    if lacking <= MAX_LACKING * len(shown):
        return []
    message = (
        f"{lacking} of the {len(shown)} points that the images of the COLMAP model {model} show are"
        " not among its points"
    )
    if not any((model / f"points3D{suffix}").is_file() for suffix in (".bin", ".txt")):
        message += ", since it has no points3D file"
    remedy = "restore points3D.bin or points3D.txt, or export the model again"
    return [Finding("points-missing", message, remedy, file=str(model))]


def largest_model(root: Path) -> Path:
    """Return the model folder that `read_colmap` reads.

    Raises:
        UserError: There is no model, or it is empty or damaged.
    """
    return _largest(root)[0]


def _largest(root: Path) -> tuple[Path, list[_Image], tuple[Finding, ...]]:
    """Return the model folder with the most images, its images, and findings."""
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
    message = (
        f"COLMAP produced {len(models)} separate models (images in each: {sizes}); "
        f"{model.name} is used, the others are left out"
    )
    remedy = "take more photos between the parts"
    return model, chosen, (Finding("model-parts", message, remedy, file=str(model)),)


def _suffix(folder: Path) -> str | None:
    """Return the suffix of the model files in a folder, None if it contains no model."""
    for suffix in (".bin", ".txt"):
        if all((folder / f"{stem}{suffix}").is_file() for stem in ("cameras", "images")):
            return suffix
    return None


def _subfolders(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    found = [p for p in visible(folder.iterdir()) if p.is_dir()]
    return sorted(found, key=lambda p: (len(p.name), p.name))


def _image_folder(root: Path, names: list[str]) -> tuple[Path, FileNames]:
    """Return the capture's folder and the folder in it that has most of the named images."""
    roots = [root, root.parent, root.parent.parent] if _suffix(root) else [root]
    best, best_count = (roots[0], FileNames(roots[0] / "images")), 0
    for base in roots:
        for sub in IMAGE_FOLDERS:
            files = FileNames(base / sub)
            count = sum(files.find(n) is not None for n in names) if files.folder.is_dir() else 0
            if count > best_count:
                best, best_count = (base, files), count
            if count == len(names):
                return best
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
            check_regular(path)
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
        return _checked_name(decode(raw, f"The image name {raw[:60]!r} in {self.path}"), self.path)


def _checked_name(name: str, path: Path) -> str:
    """Return a name that a file can have: any characters except control characters."""
    if not name or any(unicodedata.category(c) == "Cc" for c in name):
        raise UserError(
            f"{path} has the image name {name[:60]!r}, which is empty or holds control characters;"
            " it is truncated or damaged, so export the COLMAP model again."
        )
    return name


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
        text = read_text(path)
    except OSError as error:
        raise explain(error, path) from None
    lines = (line.strip(" \t") for line in lines_of(text))
    return [line for line in lines if not line.startswith("#")]


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
    """Read pairs of lines, an image and its features, which may be an empty line.

    Tools that write or edit such files by hand add empty lines or leave the features out, so every
    line is recognised by its words instead of its position.
    """
    lines = iter([*_lines(path), ""])
    out: list[_Image] = []
    line = next(lines)
    try:
        while True:
            if not line:
                line = next(lines)
                continue
            image = _image_line(line, path)
            line, following = next(lines), line
            if _is_image_line(line):
                out.append(image)
                continue
            out.append(image._replace(points=_features(line, following, path)))
            line = next(lines)
    except StopIteration:
        return out


def _is_image_line(line: str) -> bool:
    """Return whether a line describes an image: ten words, of which the last is no number."""
    words = line.split(maxsplit=9)
    if len(words) < 10 or not (words[0].isdecimal() and words[8].isdecimal()):
        return False
    if not all(map(_is_number, words[1:8])):
        return False
    return not (_is_number(words[9].split()[-1]) and len(line.split()) % 3 == 0)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _image_line(line: str, path: Path) -> _Image:
    words = line.split(maxsplit=9)
    try:
        numbers = [float(w) for w in words[1:8]]
        camera, name = int(words[8]), words[9]
    except (ValueError, IndexError, OverflowError):
        raise _line_error(path, line) from None
    name = _checked_name(name, path)
    return _Image(name, camera, _pose(numbers[:4], numbers[4:], name, str(path)), None)


def _features(line: str, image: str, path: Path) -> Int[np.ndarray, " k"]:
    """Return the point ids of a line of features, which are triples (x, y, point id)."""
    words = line.split()
    try:
        if len(words) % 3:
            raise ValueError
        return np.array([int(w) for w in words[2::3]], np.int64)
    except (ValueError, OverflowError):
        raise UserError(
            f"{path} has after the image {image.split()[-1]!r} a line that is neither its features"
            f" (x, y, point id) nor another image: {line[:60]!r}; export the COLMAP model again."
        ) from None
