"""Camera paths drawn in nerfstudio's viewer (`camera_path.json`)."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from climatenerf.core.errors import UserError
from climatenerf.core.storage import read_json
from climatenerf.scene import Scene

OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class DrawnPath:
    """What the file says, brought into world metres.

    Attributes:
        c2w: Camera-to-world poses, world metres, OpenCV axes.
        vertical_fov: Vertical field of view of each frame, degrees, in (0, 180).
        size: Width and height to render, pixels; (0, 0) if the file names none.
        fps: Frames per second, or None.
        note: From which frame the poses were brought here.
    """

    c2w: Float[np.ndarray, "frames 4 4"]
    vertical_fov: Float[np.ndarray, "frames"]
    size: tuple[int, int]
    fps: float | None
    note: str


def read_drawn_path(path: Path, scene: Scene) -> DrawnPath:
    """Reads the frames of a `camera_path.json`.

    Its poses are OpenGL camera-to-world in nerfstudio's model frame. A
    `dataparser_transforms.json` in the same folder says how that frame was made from the input's
    (model = scale * transform * input) and is undone; without it the poses are taken to be in the
    capture's own frame. The note says which.

    Raises:
        UserError: the file is absent or damaged, or its camera is not a perspective one.
    """
    data = read_json(path, "camera path")
    if str(data.get("camera_type", "perspective")).lower() != "perspective":
        raise UserError(
            f"camera path: {path} is for a {data['camera_type']} camera; only perspective paths"
            " can be rendered, change it in the viewer and export again"
        )
    entries = data.get("camera_path")
    if not isinstance(entries, list) or not entries:
        raise UserError(f"camera path: {path} holds no frames; add key frames and export it again")
    input_from_model, note = _input_from_model(path, scene)
    world_from_model = scene.world_from_input @ input_from_model
    poses, fovs = [], []
    for number, entry in enumerate(entries):
        pose, fov = _entry(entry, data.get("default_fov"), f"frame {number} of {path}")
        poses.append(_moved(world_from_model, pose @ OPENGL_TO_OPENCV))
        fovs.append(fov)
    size = (_number(data.get("render_width")), _number(data.get("render_height")))
    return DrawnPath(
        c2w=np.stack(poses),
        vertical_fov=np.array(fovs),
        size=(int(size[0]), int(size[1])),
        fps=_number(data.get("fps")) or None,
        note=note,
    )


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) and 0 < value < 1e6 else 0.0


def _entry(entry: object, default_fov: object, where: str) -> tuple[np.ndarray, float]:
    try:
        if not isinstance(entry, dict):
            raise TypeError
        pose = np.array(entry.get("camera_to_world"), dtype=np.float64).reshape(4, 4)
        fov = float(entry.get("fov", default_fov))
    except (TypeError, ValueError) as error:
        raise UserError(
            f"camera path: {where} needs 16 numbers camera_to_world and a fov; export it again"
        ) from error
    if not np.isfinite(pose).all() or not np.linalg.det(pose[:3, :3]) > 1e-9:
        raise UserError(f"camera path: {where} has no finite pose with a rotation; export it again")
    if not 0 < fov < 180:
        raise UserError(f"camera path: {where} has a field of view of {fov} degrees; mend it")
    return pose, fov


def _input_from_model(path: Path, scene: Scene) -> tuple[Float[np.ndarray, "4 4"], str]:
    """The way from nerfstudio's model frame to the scene's input frame, and what it rests on."""
    beside = path.parent / "dataparser_transforms.json"
    if not beside.is_file():
        return np.eye(4), (
            f"no {beside.name} beside {path.name}: its poses are taken to be in the capture's frame"
        )
    data = read_json(beside, "camera path")
    # nerfstudio starts from the frame before `applied_transform`; the scene's is the one after it.
    own = scene.root / "transforms.json"
    meta = read_json(own, "capture") if scene.source == "transforms" and own.is_file() else {}
    try:
        rigid, applied = np.eye(4), np.eye(4)
        rigid[:3] = np.array(data["transform"], float)[:3]
        applied[:3] = np.array(meta.get("applied_transform", applied[:3]), float)[:3]
        scale = float(data["scale"]) / float(meta.get("applied_scale", 1.0))
        matrix = applied @ np.linalg.inv(rigid) @ np.diag([1 / scale] * 3 + [1.0])
    except (KeyError, TypeError, ValueError, ZeroDivisionError, np.linalg.LinAlgError) as error:
        raise UserError(
            f"camera path: {beside} is damaged ({error}); restore it, or move it away if the"
            " path is in the capture's own frame"
        ) from error
    return matrix, f"poses of {path.name} brought back from nerfstudio's frame by {beside.name}"


def _moved(similarity: Float[np.ndarray, "4 4"], c2w: np.ndarray) -> Float[np.ndarray, "4 4"]:
    """A pose in the similarity's target frame: position moved and scaled, rotation orthonormal."""
    moved = similarity @ c2w
    u, _, vt = np.linalg.svd(moved[:3, :3])
    moved[:3, :3] = u @ vt
    return moved
