"""A posed capture: cameras, views, sparse points and the way from its frame to metres with z up."""

from __future__ import annotations

import json
import math
import os
import zipfile
import zlib
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError
from climatenerf.core.storage import atomic_path
from climatenerf.scene.label_spaces import TRAIN_IDS, checked_label_space
from climatenerf.scene.readers.ply import read_points, write_points

SCHEMA_VERSION = 1
FILE_NAME = "scene.json"
POINTS_NAME = "points.ply"
SEEN_NAME = "points_seen.npz"


@dataclass(frozen=True)
class View:
    """One photograph and where it was taken.

    Attributes:
        name: The picture's name as the poses give it, e.g. "0001.jpg".
        path: Absolute path of the picture.
        camera: Index into `Scene.cameras`.
        c2w: Camera-to-input-frame pose, 4x4, OpenCV axes, orthonormal rotation, input units.
        split: "train", or "heldout" for measuring only.
        label_path: 8-bit picture of ids in the scene's label space, if there is one.
        mask_path: Picture whose black pixels are to be ignored, if there is one.
        depth_path: Z-depths, as `images.load_depth` reads them, if there are any.
        seen: Which of the scene's sparse points the picture shows, if that is known.
    """

    name: str
    path: Path
    camera: int
    c2w: Float[np.ndarray, "4 4"]
    split: Literal["train", "heldout"] = "train"
    label_path: Path | None = None
    mask_path: Path | None = None
    depth_path: Path | None = None
    seen: Int[np.ndarray, " k"] | None = field(default=None, compare=False)


@dataclass(frozen=True)
class Scene:
    """A capture together with up, scale and ground.

    Attributes:
        root: Absolute folder of the capture.
        source: Name of the reader that read it.
        cameras: Intrinsics, shared by the views.
        views: Photographs, sorted by name.
        points: Sparse points in the input frame, or None.
        world_from_input: Similarity from the input frame to the world (metres, z up).
        scale_source: Where the scale comes from: "gps", "known-length", "camera-height",
            "metric-input" or "camera-height-assumed".
        scale_error: Relative error of the scale, 0.3 for 30 %.
        scale_report: What other evidence of scale says; see `scale.py`.
        georeference: The origin's latitude and longitude, degrees, and how well GPS fits; empty
            without GPS. Then x is east and y north.
        ground_z: Height of the ground datum, metres: the median ground under the camera path.
        lowest_ground_z: Height of the lowest ground, metres.
        up_report: How up was found: "used", then the degrees between it and each other method.
        warnings: Sentences for the user.
        label_space: What the numbers in the label files mean; see `label_spaces.py`.
    """

    root: Path
    source: str
    cameras: tuple[Camera, ...]
    views: tuple[View, ...]
    points: Float[np.ndarray, "n 3"] | None = None
    world_from_input: Float[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    scale_source: str = "metric-input"
    scale_error: float = 0.0
    scale_report: dict[str, dict[str, float]] = field(default_factory=dict)
    georeference: dict[str, float] = field(default_factory=dict)
    ground_z: float = 0.0
    lowest_ground_z: float = 0.0
    up_report: dict[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    label_space: str = TRAIN_IDS

    @property
    def scale(self) -> float:
        """Metres in one input unit."""
        return float(np.cbrt(np.linalg.det(self.world_from_input[:3, :3])))

    def c2w_world(self, view: View) -> Float[np.ndarray, "4 4"]:
        """The view's camera-to-world pose: orthonormal rotation, position in metres."""
        pose = self.world_from_input @ view.c2w
        pose[:3, :3] /= self.scale
        return pose

    def points_world(self) -> Float[np.ndarray, "n 3"] | None:
        """The sparse points in metres, or None."""
        if self.points is None:
            return None
        return self.points @ self.world_from_input[:3, :3].T + self.world_from_input[:3, 3]

    def of_split(self, split: str) -> tuple[View, ...]:
        """The views of one split, in order."""
        return tuple(v for v in self.views if v.split == split)


def save_scene(scene: Scene, folder: Path | str) -> Path:
    """Write `scene.json` (and `points.ply` beside it) and return its path.

    Picture paths are stored relative to the capture's folder, and that folder both relative to
    `folder` and absolutely, so that either may be moved together with the other or alone.
    """
    folder = Path(folder).absolute()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(
            f"The folder {folder} cannot be made ({error.strerror}); choose another one."
        ) from None
    if scene.points is not None:
        write_points(folder / POINTS_NAME, scene.points)
        _save_seen(scene, folder / SEEN_NAME)
    data = {
        "schema_version": SCHEMA_VERSION,
        "source": scene.source,
        "root": os.path.relpath(scene.root, folder),
        "root_absolute": str(scene.root),
        "label_space": scene.label_space,
        "axes": "OpenCV camera-to-input",
        "cameras": [asdict(c) for c in scene.cameras],
        "views": [_view_to_json(v, scene.root) for v in scene.views],
        "points": None if scene.points is None else POINTS_NAME,
        "points_seen": SEEN_NAME if (folder / SEEN_NAME).is_file() else None,
        "world_from_input": scene.world_from_input.tolist(),
        "scale_source": scene.scale_source,
        "scale_error": scene.scale_error,
        "ground_z": scene.ground_z,
        "lowest_ground_z": scene.lowest_ground_z,
        "scale_report": scene.scale_report,
        "georeference": scene.georeference,
        "up_report": scene.up_report,
        "warnings": list(scene.warnings),
    }
    target = folder / FILE_NAME
    _write_atomically(target, json.dumps(data, indent=1))
    return target


def load_scene(folder: Path | str) -> Scene:
    """Read what `save_scene` wrote; the pictures themselves need not be there.

    Raises:
        UserError: There is no such file, it is damaged, or a newer version wrote it.
    """
    path = Path(folder).absolute()
    if path.is_dir():
        path = path / FILE_NAME
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UserError(f"There is no {FILE_NAME} in {path.parent}; give a scene folder.") from None
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(
            f"{path} cannot be read ({error}); read the capture again to make a new one."
        ) from None
    version = data.get("schema_version") if isinstance(data, dict) else None
    if not isinstance(version, int):
        raise UserError(f"{path} has no schema_version, so it is not a scene of climatenerf.")
    if version > SCHEMA_VERSION:
        raise UserError(
            f"{path} has schema version {version} but this climatenerf reads up to "
            f"{SCHEMA_VERSION}; update climatenerf or read the capture again."
        )
    try:
        return _scene_from_json(data, path.parent)
    except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
        raise UserError(
            f"{path} is damaged ({type(error).__name__}: {error}); read the capture again."
        ) from None


def _view_to_json(view: View, root: Path) -> dict[str, Any]:
    return {
        "name": view.name,
        "path": _relative(view.path, root),
        "camera": view.camera,
        "c2w": view.c2w.tolist(),
        "split": view.split,
        "label_path": _relative(view.label_path, root),
        "mask_path": _relative(view.mask_path, root),
        "depth_path": _relative(view.depth_path, root),
    }


def _relative(path: Path | None, root: Path) -> str | None:
    if path is None:
        return None
    return path.relative_to(root).as_posix() if path.is_relative_to(root) else str(path)


def _scene_from_json(data: dict[str, Any], folder: Path) -> Scene:
    root = Path(os.path.normpath(folder / data["root"]))
    if not (root / data["views"][0]["path"]).is_file() and "root_absolute" in data:
        root = Path(data["root_absolute"])

    def absolute(path: str | None) -> Path | None:
        return None if path is None else root / path

    cameras = tuple(_camera(c) for c in data["cameras"])
    views = tuple(
        View(
            name=_text(v["name"]),
            path=root / v["path"],
            camera=int(v["camera"]),
            c2w=_matrix(v["c2w"]),
            split=v["split"],
            label_path=absolute(v["label_path"]),
            mask_path=absolute(v["mask_path"]),
            depth_path=absolute(v.get("depth_path")),
        )
        for v in data["views"]
    )
    if any(not 0 <= v.camera < len(cameras) for v in views):
        raise ValueError("a view names a camera that is not listed")
    if any(v.split not in ("train", "heldout") for v in views):
        raise ValueError("a view's split is neither train nor heldout")
    points = None if data["points"] is None else read_points(folder / data["points"])
    seen = data.get("points_seen")
    if points is not None and seen and (folder / seen).exists():
        views = _with_seen(views, len(points), folder / seen)
    return Scene(
        root=root,
        source=_text(data["source"]),
        cameras=cameras,
        views=views,
        points=points,
        world_from_input=_matrix(data["world_from_input"]),
        scale_source=_text(data["scale_source"]),
        scale_error=_number(data["scale_error"]),
        scale_report={
            _text(name): {key: _number(value) for key, value in said.items()}
            for name, said in data.get("scale_report", {}).items()
        },
        georeference={k: _number(v) for k, v in data.get("georeference", {}).items()},
        ground_z=_number(data["ground_z"]),
        lowest_ground_z=_number(data["lowest_ground_z"]),
        up_report=dict(data["up_report"]),
        warnings=tuple(_text(w) for w in data["warnings"]),
        label_space=checked_label_space(
            _text(data.get("label_space", TRAIN_IDS)), f"The label_space in {folder / FILE_NAME}"
        ),
    )


def _save_seen(scene: Scene, path: Path) -> None:
    """Pairs of view and point, as two arrays; nothing if no view knows its points."""
    seen = [v.seen if v.seen is not None else np.empty(0, np.int64) for v in scene.views]
    if not any(map(len, seen)):
        path.unlink(missing_ok=True)
        return
    view = np.repeat(np.arange(len(seen)), [len(k) for k in seen])
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(
            file, view=view.astype(np.int32), point=np.concatenate(seen).astype(np.int32)
        )


def _with_seen(views: tuple[View, ...], points: int, path: Path) -> tuple[View, ...]:
    """The views with the points that each shows, as `_save_seen` wrote them."""
    try:
        with np.load(path) as data:
            view, point = data["view"].astype(np.int64), data["point"].astype(np.int64)
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile, zlib.error) as error:
        raise UserError(
            f"{path} cannot be read ({error}); delete it to go on without it."
        ) from None
    if view.shape != point.shape or (point < 0).any() or (point >= points).any():
        raise UserError(f"{path} names points that there are none of; delete it to go on.")
    return tuple(replace(v, seen=point[view == i]) for i, v in enumerate(views))


def _matrix(values: Any) -> Float[np.ndarray, "4 4"]:
    matrix = np.array(values, dtype=np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ValueError("a matrix is not 4x4 and finite")
    return matrix


def _camera(data: dict[str, Any]) -> Camera:
    camera = Camera(**data)
    numbers = {k: _number(v) for k, v in data.items() if k not in ("width", "height", "fisheye")}
    width, height = int(camera.width), int(camera.height)
    return replace(camera, **numbers, width=width, height=height, fisheye=bool(camera.fisheye))


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError(f"{value!r} should be a text")
    return value


def _number(value: Any) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise ValueError("a number is not finite")
    return number


def with_split(scene: Scene, heldout: set[str]) -> Scene:
    """The scene with exactly the named views held out."""
    views = tuple(
        replace(v, split="heldout" if v.name in heldout else "train") for v in scene.views
    )
    return replace(scene, views=views)


def _write_atomically(target: Path, text: str) -> None:
    temporary = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    try:
        temporary.write_text(text, encoding="utf-8")
        os.replace(temporary, target)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise UserError(
            f"{target} cannot be written ({error.strerror}); free some space or choose another "
            "folder."
        ) from None
