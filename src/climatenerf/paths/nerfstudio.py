"""Camera paths drawn in nerfstudio's viewer (`camera_path.json`)."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from climatenerf.core import parsing
from climatenerf.core.errors import UserError, excerpt
from climatenerf.core.input_limits import MAX_FRAMES
from climatenerf.core.storage import write_json
from climatenerf.scene import Scene
from climatenerf.scene.readers.ply import MAX_POSITION
from climatenerf.scene.scene import MAX_SCALE, MAX_WORLD

OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class DrawnPath:
    """The content of the file, in world metres.

    Attributes:
        c2w: Camera-to-world poses, world metres, OpenCV axes.
        vertical_fov: Vertical field of view of each frame, degrees, in (0, 180).
        size: Width and height to render, pixels; (0, 0) if the file names none.
        fps: Frames per second, or None.
        note: Which frame the poses were taken to be in.
    """

    c2w: Float[np.ndarray, "frames 4 4"]
    vertical_fov: Float[np.ndarray, "frames"]
    size: tuple[int, int]
    fps: float | None
    note: str


def read_drawn_path(path: Path, scene: Scene) -> DrawnPath:
    """Read the frames of a `camera_path.json`.

    Its poses are OpenGL camera-to-world in nerfstudio's model frame. A
    `dataparser_transforms.json` in the same folder gives the transform from the input frame to that
    frame (model = scale * transform * input), which is inverted. Without it the poses are taken to
    be in the capture's own frame. The note states which.

    Raises:
        UserError: the file is absent or damaged, or its camera is not a perspective one.
    """
    data = parsing.read_json(path, "camera path")
    if str(data.get("camera_type", "perspective")).lower() != "perspective":
        raise UserError(
            f"camera path: {path} is for a {excerpt(data['camera_type'])} camera; only perspective"
            " paths can be rendered; change the camera in the viewer and export again"
        )
    entries = data.get("camera_path")
    if not isinstance(entries, list) or not entries:
        raise UserError(f"camera path: {path} holds no frames; add keyframes and export it again")
    if len(entries) > MAX_FRAMES:
        raise UserError(
            f"camera path: {path} holds {len(entries)} frames, more than {MAX_FRAMES}; export it"
            " with fewer"
        )
    input_from_model, note = _input_from_model(path, scene)
    world_from_model = scene.world_from_input @ input_from_model
    poses, fovs = [], []
    for number, entry in enumerate(entries):
        pose, fov = _entry(entry, data.get("default_fov"), f"frame {number} of {path}")
        moved = _transformed(world_from_model, pose @ OPENGL_TO_OPENCV)
        if not np.abs(moved[:3, 3]).max() <= MAX_WORLD:
            raise UserError(
                f"camera path: frame {number} of {path} lies {np.abs(moved[:3, 3]).max():.3g} m"
                f" from the world's origin, and 32 bits resolve no detail beyond {MAX_WORLD:g} m;"
                " export the path again"
            )
        poses.append(moved)
        fovs.append(fov)
    size = (_number(data.get("render_width")), _number(data.get("render_height")))
    return DrawnPath(
        c2w=np.stack(poses),
        vertical_fov=np.array(fovs),
        size=(int(size[0]), int(size[1])),
        fps=_number(data.get("fps")) or None,
        note=note,
    )


def write_drawn_path(path: Path, scene: Scene, drawn: DrawnPath) -> Path:
    """Write a `camera_path.json` in the capture's own frame, which `read_drawn_path` reads back.

    Args:
        path: the file; no `dataparser_transforms.json` may lie beside it.
        scene: the capture; defines the transform from metres to its frame.
        drawn: the path; its note is left out.

    Raises:
        UserError: the file cannot be written.
    """
    input_from_world = np.linalg.inv(scene.world_from_input)
    width, height = drawn.size
    entries = []
    for c2w, fov in zip(drawn.c2w, drawn.vertical_fov, strict=True):
        pose = _transformed(input_from_world, c2w) @ OPENGL_TO_OPENCV
        entries.append(
            {
                "camera_to_world": pose.reshape(-1).tolist(),
                "fov": float(fov),
                "aspect": width / max(height, 1),
            }
        )
    data = {
        "camera_type": "perspective",
        "render_width": width,
        "render_height": height,
        "fps": drawn.fps,
        "seconds": len(entries) / drawn.fps if drawn.fps else None,
        "camera_path": entries,
    }
    write_json(path, {key: value for key, value in data.items() if value is not None})
    return path


def _number(value: Any) -> float:
    return float(value) if parsing.is_number(value) and 0 < value < 1e6 else 0.0


def _entry(entry: object, default_fov: object, where: str) -> tuple[np.ndarray, float]:
    try:
        if not isinstance(entry, dict):
            raise TypeError
        pose = np.array(entry.get("camera_to_world"), dtype=np.float64).reshape(4, 4)
        fov = float(entry.get("fov", default_fov))
    except (TypeError, ValueError, OverflowError) as error:
        raise UserError(
            f"camera path: {where} needs 16 numbers camera_to_world and a fov; export it again"
        ) from error
    if not np.abs(pose).max() <= MAX_POSITION:  # also NaN
        raise UserError(
            f"camera path: {where} has a pose that is not finite or beyond {MAX_POSITION:g}, where"
            " 32 bits resolve nothing; export it again"
        )
    if not np.linalg.det(pose[:3, :3]) > 1e-9:
        raise UserError(f"camera path: {where} has no finite pose with a rotation; export it again")
    if not 0 < fov < 180:
        raise UserError(f"camera path: {where} has a field of view of {fov:g} degrees; correct it")
    return pose, fov


def _input_from_model(path: Path, scene: Scene) -> tuple[Float[np.ndarray, "4 4"], str]:
    """Return the transform from nerfstudio's model frame to the input frame, and a note on it."""
    sidecar = path.parent / "dataparser_transforms.json"
    if not sidecar.is_file():
        return np.eye(4), (
            f"there is no {sidecar.name} beside {path.name}, so its poses are taken to be in the"
            " capture's frame"
        )
    data = parsing.read_json(sidecar, "camera path")
    # nerfstudio's input frame is before `applied_transform`, and the scene's is after it.
    capture = scene.root / "transforms.json"
    from_json = scene.source == "transforms" and capture.is_file()
    meta = parsing.read_json(capture, "capture") if from_json else {}
    rigid, applied = np.eye(4), np.eye(4)
    shapes = [(3, 4), (4, 4)]
    where = f"transform in {sidecar}"
    rigid[:3] = parsing.matrix(data.get("transform"), shapes, where, MAX_POSITION)[:3]
    if "applied_transform" in meta:
        where = f"applied_transform in {capture}"
        given = parsing.matrix(meta["applied_transform"], shapes, where, MAX_POSITION)
        applied[:3] = given[:3]
    scale = parsing.number(data, "scale", str(sidecar), 1 / MAX_SCALE, MAX_SCALE)
    scale /= parsing.number(meta, "applied_scale", str(capture), 1 / MAX_SCALE, MAX_SCALE, 1.0)
    determinants = [float(np.linalg.det(each[:3, :3])) for each in (rigid, applied)]
    if not all(1e-6 < determinant < 1e6 for determinant in determinants):
        raise UserError(
            f"camera path: {sidecar} or {capture} has a transform without a rotation; restore it,"
            " or move it away if the path is in the capture's own frame"
        )
    matrix = applied @ np.linalg.inv(rigid) @ np.diag([1 / scale] * 3 + [1.0])
    return matrix, f"poses of {path.name} transformed from nerfstudio's frame by {sidecar.name}"


def _transformed(similarity: Float[np.ndarray, "4 4"], c2w: np.ndarray) -> Float[np.ndarray, "4 4"]:
    """Apply a similarity to a pose: the position is scaled, the rotation stays orthonormal."""
    moved = similarity @ c2w
    u, _, vt = np.linalg.svd(moved[:3, :3])
    moved[:3, :3] = u @ vt
    return moved
