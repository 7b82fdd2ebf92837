"""A posed capture: cameras, views, sparse points and the transform to a metric, z-up world.

Frames: *camera* (OpenCV axes: x right, y down, z forward), *input* (the frame and unit of the pose
files) and *world* (metres, z up). `Scene.world_from_input` maps the second to the third.
"""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

from climatenerf.core import arrays, parsing
from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError, one_line
from climatenerf.core.storage import atomic_path, check_schema, make_folder, write_bytes
from climatenerf.scene.findings import Finding, finding_from_json
from climatenerf.scene.label_spaces import TRAIN_IDS, checked_label_space
from climatenerf.scene.readers.ply import MAX_POSITION, read_points, write_points

SCHEMA_VERSION = 1
FILE_NAME = "scene.json"
POINTS_NAME = "points.ply"
OBSERVATIONS_NAME = "points_seen.npz"
MILLIMETRES = 0.001
"""Metres per unit of integer depth files, unless a capture states another scale."""
MAX_VIEWS = 100_000
MAX_SIDE = 100_000  # pixels
MAX_WORLD = 1e7
"""Distance from the origin, m, at which 32 bits still resolve a metre."""
MAX_SCALE = 1e9
"""Metres per input unit, and its inverse."""
MAX_MATRIX = 1e18  # entries of `world_from_input`: greatest scale times farthest position


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
    data = parsing.read_json(path, "scene")
    check_schema(data.get("schema_version"), SCHEMA_VERSION, f"scene {path}")
    return checked_world(_scene_from_json(data, path), str(path))


def checked_world(scene: Scene, where: str) -> Scene:
    """Return the scene if 32 bits can hold the world that its transform and poses make.

    Args:
        scene: Scene aligned to the world frame.
        where: File or folder, for the message.

    Raises:
        UserError: The transform is no similarity or is mirrored, or a camera or a height is beyond
            `MAX_WORLD`.
    """
    linear = scene.world_from_input[:3, :3]
    determinant = float(np.linalg.det(linear))
    size = abs(determinant) ** (1 / 3)
    if not 1 / MAX_SCALE <= size <= MAX_SCALE:
        raise UserError(
            f"world_from_input in {where} has a scale of {size:.3g} m per unit, beyond"
            f" {1 / MAX_SCALE:g} to {MAX_SCALE:g}; read the capture again, or give its scale."
        )
    if determinant < 0 or np.abs(linear @ linear.T / size**2 - np.eye(3)).max() > 1e-3:
        raise UserError(
            f"world_from_input in {where} is mirrored or sheared, so it is no scale with a"
            " rotation; read the capture again."
        )
    centres = np.array([view.c2w[:, 3] for view in scene.views]).reshape(-1, 4)
    positions = centres @ scene.world_from_input.T
    farthest = float(np.abs(positions[:, :3]).max(initial=0.0))
    farthest = max(farthest, abs(scene.ground_z), abs(scene.lowest_ground_z))
    if not farthest <= MAX_WORLD:
        raise UserError(
            f"A camera or the ground of {where} lies {farthest:.3g} m from the world's origin, and"
            f" 32 bits resolve no detail beyond {MAX_WORLD:g} m; correct the poses or the scale."
        )
    return scene


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


def _scene_from_json(data: dict[str, Any], file: Path) -> Scene:
    where, folder = str(file), file.parent
    listed = parsing.items(data, "views", where)
    if not listed or len(listed) > MAX_VIEWS:
        raise UserError(
            f"{where} has {len(listed)} views instead of 1 to {MAX_VIEWS}; read the capture again."
        )
    root = Path(os.path.normpath(folder / parsing.text(data, "root", where)))
    first = parsing.text(listed[0], "path", f"view 0 of {where}")
    absolute = parsing.text(data, "root_absolute", where, None)
    if absolute is not None and not is_file(root / first):
        root = Path(absolute)
    listed_cameras = parsing.items(data, "cameras", where)
    cameras = tuple(_camera(c, f"camera {i} of {where}") for i, c in enumerate(listed_cameras))
    views = tuple(
        _view_from_json(v, root, len(cameras), f"view {i} of {where}") for i, v in enumerate(listed)
    )
    cloud = parsing.text(data, "points", where, None)
    points = None if cloud is None else read_points(folder / cloud)
    observations = parsing.text(data, "points_seen", where, None)
    if points is not None and observations and (folder / observations).exists():
        views = _with_observations(views, len(points), folder / observations)
    return Scene(
        root=root,
        source=parsing.text(data, "source", where),
        cameras=cameras,
        views=views,
        points=points,
        world_from_input=_matrix(data, "world_from_input", where, MAX_MATRIX),
        scale_source=parsing.text(data, "scale_source", where),
        scale_error=parsing.number(data, "scale_error", where, 0.0),
        scale_report=_scale_report(parsing.entries(data, "scale_report", where, {}), where),
        georeference={
            key: parsing.checked_number(value, f"georeference.{key} in {where}")
            for key, value in parsing.entries(data, "georeference", where, {}).items()
        },
        ground_z=parsing.number(data, "ground_z", where, -MAX_WORLD, MAX_WORLD),
        lowest_ground_z=parsing.number(data, "lowest_ground_z", where, -MAX_WORLD, MAX_WORLD),
        up_report=_up_report(parsing.entries(data, "up_report", where), where),
        findings=_findings(data, where),
        label_space=checked_label_space(
            parsing.text(data, "label_space", where, TRAIN_IDS), f"The label_space in {where}"
        ),
        depth_scale=parsing.number(data, "depth_scale", where, 1e-9, 1e3, MILLIMETRES),
    )


def is_file(path: Path) -> bool:
    """Return whether there is a file; a name that no disk can hold is none."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def _findings(data: dict[str, Any], where: str) -> tuple[Finding, ...]:
    """Return the findings; earlier versions saved them as sentences."""
    if "findings" not in data:
        return tuple(finding_from_json(sentence) for sentence in _texts(data, "warnings", where))
    try:
        return tuple(map(finding_from_json, parsing.items(data, "findings", where)))
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"{where} has a finding that is damaged ({one_line(str(error), 100)}); restore it"
        ) from error


def _scale_report(report: dict[str, Any], where: str) -> dict[str, dict[str, float]]:
    out = {}
    for name in report:
        entry = parsing.entries(report, name, f"scale_report of {where}")
        location = f"scale_report.{name} of {where}"
        out[name] = {
            "times": parsing.number(entry, "times", location, 1 / MAX_SCALE, MAX_SCALE),
            "error": parsing.number(entry, "error", location, 0.0),
        }
    return out


def _up_report(report: dict[str, Any], where: str) -> dict[str, Any]:
    """Return the report on up: the methods used, as a text, and the angles of all methods."""
    location = f"up_report of {where}"
    angles = {key: parsing.number(report, key, location) for key in report if key != "used"}
    return {"used": parsing.text(report, "used", location)} | angles if "used" in report else angles


def _texts(table: dict[str, Any], key: str, where: str) -> list[str]:
    found = parsing.items(table, key, where)
    return [parsing.text({key: each}, key, where) for each in found]


def _view_from_json(data: Any, root: Path, cameras: int, where: str) -> View:
    def absolute(key: str) -> Path | None:
        path = parsing.text(data, key, where, None)
        return None if path is None else root / path

    split = parsing.text(data, "split", where)
    if split not in ("train", "heldout"):
        raise UserError(f"{where} has a split that is neither train nor heldout; correct it.")
    return View(
        name=parsing.text(data, "name", where),
        path=root / parsing.text(data, "path", where),
        camera=parsing.integer(data, "camera", where, 0, cameras - 1),
        c2w=_matrix(data, "c2w", where, MAX_POSITION),
        split=split,
        label_path=absolute("label_path"),
        mask_path=absolute("mask_path"),
        depth_path=absolute("depth_path"),
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
        data = arrays.read_npz(path)
        view, point = (data[key] for key in ("view", "point"))
        if not all(np.issubdtype(each.dtype, np.integer) for each in (view, point)):
            raise ValueError("its indices are no whole numbers")
        view, point = view.astype(np.int64).reshape(-1), point.astype(np.int64).reshape(-1)
    except arrays.ERRORS as error:
        reason = one_line(str(error), 100)
        raise UserError(
            f"{path} cannot be read ({reason}); delete it to load the scene without observations."
        ) from None
    if view.shape != point.shape or (point < 0).any() or (point >= points).any():
        raise UserError(
            f"{path} refers to points that do not exist; delete it to load the scene without"
            " observations."
        )
    return tuple(replace(v, seen=point[view == i]) for i, v in enumerate(views))


def _matrix(table: dict[str, Any], key: str, where: str, limit: float) -> Float[np.ndarray, "4 4"]:
    return parsing.matrix(table.get(key), [(4, 4)], f"{key} in {where}", limit)


def _camera(data: Any, where: str) -> Camera:
    known = {item.name for item in fields(Camera)}
    unknown = set(parsing.entries({"camera": data}, "camera", where)) - known
    if unknown:
        raise UserError(f"{where} has an unknown value {min(unknown)!r}; read the capture again.")
    width, height = (parsing.integer(data, k, where, 1, MAX_SIDE) for k in ("width", "height"))
    fx, fy, cx, cy = (parsing.number(data, key, where) for key in ("fx", "fy", "cx", "cy"))
    named = ("width", "height", "fx", "fy", "cx", "cy", "fisheye")
    distortion = {key: parsing.number(data, key, where) for key in data if key not in named}
    fisheye = parsing.flag(data, "fisheye", where, False)
    return Camera(width, height, fx, fy, cx, cy, **distortion, fisheye=fisheye)
