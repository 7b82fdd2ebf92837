"""A posed capture: cameras, views, sparse points and the transform to a metric, z-up world.

Frames: *camera* (OpenCV axes: x right, y down, z forward), *input* (the frame and unit of the pose
files) and *world* (metres, z up). `Scene.world_from_input` maps the second to the third.
"""

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
from climatenerf.core.storage import atomic_path, check_schema, make_folder, read_json, write_bytes
from climatenerf.scene.findings import Finding, finding_from_json
from climatenerf.scene.label_spaces import TRAIN_IDS, checked_label_space
from climatenerf.scene.readers.ply import read_points, write_points

SCHEMA_VERSION = 1
FILE_NAME = "scene.json"
POINTS_NAME = "points.ply"
OBSERVATIONS_NAME = "points_seen.npz"
MILLIMETRES = 0.001
"""Metres per unit of integer depth files, unless a capture states another scale."""


@dataclass(frozen=True)
class View:
    """One photograph with its pose.

    Attributes:
        name: Image name as the pose files give it, e.g. "0001.jpg".
        path: Absolute path of the image.
        camera: Index into `Scene.cameras`.
        c2w: Camera-to-input pose, 4x4: orthonormal rotation, position in input units.
        split: "train", or "heldout" for evaluation only.
        label_path: 8-bit image of class ids in the scene's label space, or None.
        mask_path: Image whose black pixels are ignored, or None.
        depth_path: Z-depth file as `images.load_depth` reads it, or None.
        seen: Row indices into `Scene.points` of the points observed in the image, or None if the
            capture has no such record.
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
    """A capture with its up direction, scale and ground height.

    Attributes:
        root: Absolute folder of the capture.
        source: Name of the format it was read from.
        cameras: Intrinsics, shared by the views.
        views: Photographs, sorted by name.
        points: Sparse points in the input frame, or None.
        world_from_input: Similarity from the input frame to the world (metres, z up).
        scale_source: Evidence that sets the scale: "gps", "known-length", "camera-height",
            "metric-input" or "camera-height-assumed".
        scale_error: Relative standard error of the scale, 0.3 for 30 %.
        scale_report: Scale according to the other evidence; see `alignment/scale.py`.
        georeference: Latitude and longitude of the origin, degrees, number of photos used and
            spread of their GPS positions, m. Empty without GPS; otherwise x is east and y north.
        ground_z: Height of the ground datum, m: median ground height under the camera path.
        lowest_ground_z: Height of the lowest ground near the camera path, m.
        up_report: Under "used" the methods that determine up; under each method's name its angle
            to the result, degrees.
        findings: What is odd about the capture; see `findings.py`.
        label_space: Numbering of the class ids in the label files; see `label_spaces.py`.
        depth_scale: Metres per unit of integer depth files.
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
    findings: tuple[Finding, ...] = ()
    label_space: str = TRAIN_IDS
    depth_scale: float = MILLIMETRES

    @property
    def warnings(self) -> tuple[str, ...]:
        """The findings as sentences, without notes."""
        return tuple(str(each) for each in self.findings if each.severity != "note")

    @property
    def scale(self) -> float:
        """Metres per input unit."""
        return float(np.cbrt(np.linalg.det(self.world_from_input[:3, :3])))

    def c2w_world(self, view: View) -> Float[np.ndarray, "4 4"]:
        """Return the view's camera-to-world pose: orthonormal rotation, position in metres."""
        pose = self.world_from_input @ view.c2w
        pose[:3, :3] /= self.scale
        return pose

    def points_world(self) -> Float[np.ndarray, "n 3"] | None:
        """Return the sparse points in the world frame, metres, or None if there are none."""
        if self.points is None:
            return None
        return self.points @ self.world_from_input[:3, :3].T + self.world_from_input[:3, 3]

    def of_split(self, split: str) -> tuple[View, ...]:
        """Return the views of one split, sorted by name."""
        return tuple(v for v in self.views if v.split == split)


def with_split(scene: Scene, heldout: set[str]) -> Scene:
    """Return the scene with exactly the named views held out."""
    views = tuple(
        replace(v, split="heldout" if v.name in heldout else "train") for v in scene.views
    )
    return replace(scene, views=views)


def save_scene(scene: Scene, folder: Path | str) -> Path:
    """Write `scene.json`, and the sparse points beside it, atomically.

    Image paths are stored relative to the capture's folder. That folder is stored both relative to
    `folder` and absolute, so both folders can be moved together, and `folder` can be moved alone.

    Returns:
        Path of `scene.json`.

    Raises:
        UserError: The folder or a file cannot be written.
    """
    folder = make_folder(Path(folder).absolute())
    if scene.points is not None:
        write_points(folder / POINTS_NAME, scene.points)
        _save_observations(scene, folder / OBSERVATIONS_NAME)
    has_observations = (folder / OBSERVATIONS_NAME).is_file()
    data = {
        "schema_version": SCHEMA_VERSION,
        "source": scene.source,
        "root": os.path.relpath(scene.root, folder),
        "root_absolute": str(scene.root),
        "label_space": scene.label_space,
        "depth_scale": scene.depth_scale,
        "axes": "OpenCV camera-to-input",
        "cameras": [asdict(c) for c in scene.cameras],
        "views": [_view_to_json(v, scene.root) for v in scene.views],
        "points": None if scene.points is None else POINTS_NAME,
        "points_seen": OBSERVATIONS_NAME if has_observations else None,
        "world_from_input": scene.world_from_input.tolist(),
        "scale_source": scene.scale_source,
        "scale_error": scene.scale_error,
        "ground_z": scene.ground_z,
        "lowest_ground_z": scene.lowest_ground_z,
        "scale_report": scene.scale_report,
        "georeference": scene.georeference,
        "up_report": scene.up_report,
        "findings": [each.as_json() for each in scene.findings],
        "warnings": list(scene.warnings),  # for versions that read no findings
    }
    target = folder / FILE_NAME
    write_bytes(target, json.dumps(data, indent=1).encode())
    return target


def load_scene(folder: Path | str) -> Scene:
    """Read a scene that `save_scene` wrote; the images themselves may be absent.

    Args:
        folder: Folder that holds `scene.json`, or the file itself.

    Raises:
        UserError: The file is absent or damaged, or a newer version wrote it.
    """
    path = Path(folder).absolute()
    if path.is_dir():
        path = path / FILE_NAME
    data = read_json(path, "scene")
    check_schema(data.get("schema_version"), SCHEMA_VERSION, f"scene {path}")
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
    cameras = tuple(_camera(c) for c in data["cameras"])
    views = tuple(_view_from_json(v, root) for v in data["views"])
    if any(not 0 <= v.camera < len(cameras) for v in views):
        raise ValueError("a view names a camera that is not listed")
    if any(v.split not in ("train", "heldout") for v in views):
        raise ValueError("a view's split is neither train nor heldout")
    points = None if data["points"] is None else read_points(folder / data["points"])
    observations = data.get("points_seen")
    if points is not None and observations and (folder / observations).exists():
        views = _with_observations(views, len(points), folder / observations)
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
            _text(name): {key: _number(value) for key, value in entry.items()}
            for name, entry in data.get("scale_report", {}).items()
        },
        georeference={k: _number(v) for k, v in data.get("georeference", {}).items()},
        ground_z=_number(data["ground_z"]),
        lowest_ground_z=_number(data["lowest_ground_z"]),
        up_report=dict(data["up_report"]),
        findings=tuple(finding_from_json(f) for f in data.get("findings", data["warnings"])),
        label_space=checked_label_space(
            _text(data.get("label_space", TRAIN_IDS)), f"The label_space in {folder / FILE_NAME}"
        ),
        depth_scale=_number(data.get("depth_scale", MILLIMETRES)),
    )


def _view_from_json(data: dict[str, Any], root: Path) -> View:
    def absolute(path: str | None) -> Path | None:
        return None if path is None else root / path

    return View(
        name=_text(data["name"]),
        path=root / data["path"],
        camera=int(data["camera"]),
        c2w=_matrix(data["c2w"]),
        split=data["split"],
        label_path=absolute(data["label_path"]),
        mask_path=absolute(data["mask_path"]),
        depth_path=absolute(data.get("depth_path")),
    )


def _save_observations(scene: Scene, path: Path) -> None:
    """Write (view, point) index pairs as two int32 arrays, or remove the file if there are none."""
    seen = [v.seen if v.seen is not None else np.empty(0, np.int64) for v in scene.views]
    if not any(map(len, seen)):
        path.unlink(missing_ok=True)
        return
    view = np.repeat(np.arange(len(seen)), [len(k) for k in seen])
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(
            file, view=view.astype(np.int32), point=np.concatenate(seen).astype(np.int32)
        )


def _with_observations(views: tuple[View, ...], points: int, path: Path) -> tuple[View, ...]:
    """Return the views with `seen` set from a file that `_save_observations` wrote."""
    try:
        with np.load(path) as data:
            view, point = data["view"].astype(np.int64), data["point"].astype(np.int64)
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile, zlib.error) as error:
        raise UserError(
            f"{path} cannot be read ({error}); delete it to load the scene without observations."
        ) from None
    if view.shape != point.shape or (point < 0).any() or (point >= points).any():
        raise UserError(
            f"{path} refers to points that do not exist; delete it to load the scene without"
            " observations."
        )
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
        raise ValueError(f"{value!r} is not a string")
    return value


def _number(value: Any) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise ValueError("a number is not finite")
    return number
