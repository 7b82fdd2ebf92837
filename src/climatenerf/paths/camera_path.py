"""Camera paths of movies: along the photographs, around their subject, still, or from nerfstudio.

All poses are camera-to-world in world metres with OpenCV axes (+x right, +y down, +z forward). The
fitted field is accurate near the photographs, so every path made here stays near them.
"""

import difflib
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from climatenerf.core.errors import UserError, excerpt
from climatenerf.core.input_limits import MAX_FRAMES
from climatenerf.paths.framing import (
    check_size,
    fit_to_size,
    fitted_camera,
    half_extent,
    train_views,
)
from climatenerf.paths.nerfstudio import read_drawn_path
from climatenerf.paths.tour import (
    capture_order,
    longest_segment,
    looking_at,
    smooth_and_resample,
    without_roll,
)
from climatenerf.scene import Camera, Scene, View


@dataclass(frozen=True)
class CameraPath:
    """A moving camera with one entry per frame.

    Attributes:
        c2w: Camera-to-world poses, world metres, OpenCV axes.
        cameras: Intrinsics of each frame; all of one size.
        name: Kind of path, for the sidecar.
        notes: Assumptions and omissions, as sentences for the user.
        fps: Frames per second that a path file gives, or None.
    """

    c2w: Float[np.ndarray, "frames 4 4"]
    cameras: tuple[Camera, ...]
    name: str
    notes: tuple[str, ...] = ()
    fps: float | None = None

    def __len__(self) -> int:
        return len(self.cameras)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the frames, pixels."""
        return self.cameras[0].width, self.cameras[0].height


def camera_path(
    spec: str, scene: Scene, frames: int, size: tuple[int, int] | None = None
) -> CameraPath:
    """Return the path that ``--path`` names.

    Args:
        spec: ``training``, ``orbit``, ``still``, ``still:NAME`` (a view's name, or its number from
            0 in name order), or a nerfstudio ``camera_path.json``.
        scene: the capture.
        frames: number of frames, ≥ 1; a file has its own number.
        size: (width, height) in pixels; None takes that of the photographs, or of the file.

    Raises:
        UserError: no such path, view or file, or the file is damaged.
    """
    if spec == "training":
        return smoothed_training_path(scene, frames, size)
    if spec == "orbit":
        return orbit(scene, frames, size)
    if spec == "still" or spec.startswith("still:"):
        return still(scene, spec.partition(":")[2] or None, frames, size)
    if spec.endswith(".json"):
        return from_camera_path_json(Path(spec), scene, size)
    raise UserError(
        f"there is no camera path {excerpt(spec)}; use training, orbit, still, still:VIEW or a"
        " nerfstudio camera_path.json"
    )


def smoothed_training_path(
    scene: Scene, frames: int, size: tuple[int, int] | None = None
) -> CameraPath:
    """Return a smooth path with a level horizon along the photographs, in order of capture.

    Sorted names give the order. If the names have no spatial order, the path is a tour from
    neighbour to neighbour. Where the walk breaks (a second pass elsewhere), the longest segment is
    used. Frames are evenly spaced along the path; rotation counts as distance.
    """
    _check_frames(frames)
    poses = _poses(scene)
    if len(poses) == 1:
        return still(scene, None, frames, size)
    order, toured = capture_order(poses)
    segment = longest_segment(poses[order])
    notes = []
    if toured:
        notes.append(
            "the names of the photographs have no spatial order; the path is a tour by distance"
        )
    if len(segment) < len(poses):
        notes.append(
            f"the photographs form separate walks; the path follows {len(segment)} of {len(poses)}"
        )
    c2w = smooth_and_resample(segment, frames)
    return CameraPath(c2w, (fitted_camera(scene, size),) * frames, "training", tuple(notes))


def orbit(scene: Scene, frames: int, size: tuple[int, int] | None = None) -> CameraPath:
    """Return a circle around the point that the cameras face, at their median distance and height.

    A capture that covers most of a circle gives a closed circle. One that covers an arc gives the
    arc forth and back. A capture without a common point (a drive, a row of sideways views) gives a
    small closed ellipse among the photographs instead, with a note.
    """
    _check_frames(frames)
    poses = _poses(scene)
    camera = fitted_camera(scene, size)
    phase = 2 * np.pi * np.arange(frames) / frames
    around = _circled_point(poses)
    if around is None:
        c2w = _sway(scene, poses, phase)
        note = (
            "the photographs do not surround a point; the camera moves on a small ellipse instead"
        )
        return CameraPath(c2w, (camera,) * frames, "sway", (note,))
    target, start, covered = around
    offset = poses[:, :3, 3] - target
    radius = float(np.median(np.linalg.norm(offset[:, :2], axis=1)))
    height = float(np.median(poses[:, 2, 3]))
    if covered >= 1.5 * np.pi:
        azimuth = start + phase
    else:
        azimuth = start + covered * (0.5 - 0.5 * np.cos(phase))
    circle = [radius * np.cos(azimuth), radius * np.sin(azimuth), np.full(frames, height)]
    position = np.stack(circle, axis=1) + [target[0], target[1], 0.0]
    return CameraPath(looking_at(position, target), (camera,) * frames, "orbit")


def still(
    scene: Scene, view: str | int | None, frames: int, size: tuple[int, int] | None = None
) -> CameraPath:
    """Return a path that stays in the pose of one photograph, so that only the weather changes.

    Args:
        scene: the capture.
        view: a view's name (with or without suffix) or its number from 0 in name order; None
            takes the most central training view.
        frames: number of frames, ≥ 1.
        size: (width, height) in pixels. None takes the photograph's camera with its distortion, so
            that frame and photograph coincide.

    Raises:
        UserError: there is no such view.
    """
    _check_frames(frames)
    chosen = _central_view(scene) if view is None else _named_view(scene, view)
    camera = scene.cameras[chosen.camera]
    if size is not None:
        camera = fit_to_size([half_extent(camera)], size)
    c2w = np.repeat(scene.c2w_world(chosen)[None], frames, axis=0)
    return CameraPath(c2w, (camera,) * frames, f"still:{chosen.name}")


def from_camera_path_json(
    path: Path, scene: Scene, size: tuple[int, int] | None = None
) -> CameraPath:
    """Return a path drawn in nerfstudio's viewer (see `nerfstudio.read_drawn_path`).

    Args:
        path: the file.
        scene: the capture; defines the transform from its frame to metres.
        size: (width, height) in pixels; None takes the file's. The vertical field of view is kept.

    Raises:
        UserError: the file is absent or damaged, or its camera is not a perspective one.
    """
    drawn = read_drawn_path(path, scene)
    width, height = size or drawn.size
    check_size(width, height)
    focal = 0.5 * height / np.tan(np.radians(drawn.vertical_fov) / 2)
    _check_frames(len(focal))
    cameras = tuple(Camera(width, height, f, f, width / 2, height / 2) for f in focal.tolist())
    return CameraPath(drawn.c2w, cameras, f"file:{path.name}", (drawn.note,), drawn.fps)


def _circled_point(
    poses: Float[np.ndarray, "n 4 4"],
) -> tuple[Float[np.ndarray, "3"], float, float] | None:
    """Return the point nearest to all optical axes, and the arc of azimuths that cameras cover.

    Returns:
        (point in metres, first azimuth, arc covered, radians), or None if the cameras do not
        surround a point.
    """
    position, axis = poses[:, :3, 3], poses[:, :3, 2]
    across = np.eye(3) - axis[:, :, None] * axis[:, None, :]
    normal = across.sum(axis=0)
    if np.linalg.eigvalsh(normal / len(poses))[0] < 0.02:  # axes within 8 degrees of parallel
        return None
    target = np.linalg.solve(normal, (across @ position[:, :, None]).sum(axis=0)[:, 0])
    offset = target - position
    distance = np.median(np.linalg.norm(offset, axis=1))
    miss = np.median(np.linalg.norm((across @ offset[:, :, None])[:, :, 0], axis=1))
    in_front = (np.einsum("ni,ni->n", offset, axis) > 0).mean()
    azimuth = np.sort(np.arctan2(-offset[:, 1], -offset[:, 0]))
    gaps = np.diff(azimuth, append=azimuth[0] + 2 * np.pi)
    widest = int(np.argmax(gaps))
    covered = 2 * np.pi - float(gaps[widest])
    if in_front < 0.8 or miss > 0.35 * distance or covered < math.radians(60):
        return None
    return target, float(azimuth[(widest + 1) % len(azimuth)]), covered


def _sway(
    scene: Scene, poses: Float[np.ndarray, "n 4 4"], phase: Float[np.ndarray, "frames"]
) -> Float[np.ndarray, "frames 4 4"]:
    """Return a small closed ellipse among the photographs nearest to the central one."""
    middle = scene.c2w_world(_central_view(scene))
    position = poses[:, :3, 3]
    far = np.linalg.norm(position - middle[:3, 3], axis=1)
    near = position[np.argsort(far)[: max(3, min(len(poses) // 6, 12))]]
    centre = near.mean(axis=0)
    _, spread, axes = np.linalg.svd(near - centre, full_matrices=False)
    # The standard deviation of a uniform distribution is 0.29 of its length, so 1.2 deviations stay
    # inside.
    radius = 1.2 * spread / math.sqrt(len(near))
    across = np.sin(phase)[:, None] * axes[0] * radius[0]
    if len(near) > 2:
        across = across + (1 - np.cos(phase))[:, None] / 2 * axes[1] * radius[1]
    points = scene.points_world()
    distance = 10 * float(np.linalg.norm(radius)) or 1.0
    if points is not None and len(points):
        ahead = (points - middle[:3, 3]) @ middle[:3, 2]
        if (ahead > 0).any():
            distance = max(distance, float(np.median(ahead[ahead > 0])))
    c2w = looking_at(centre + across, centre + distance * middle[:3, 2])
    return without_roll(c2w)


def _poses(scene: Scene) -> Float[np.ndarray, "n 4 4"]:
    return np.stack([scene.c2w_world(view) for view in train_views(scene)])


def _central_view(scene: Scene) -> View:
    """Return the training view nearest to all others in position and direction."""
    views = train_views(scene)
    poses = np.stack([scene.c2w_world(view) for view in views])
    position = poses[:, :3, 3]
    # A change of direction by 1 rad counts like the cameras' spread. 1e-9 m prevents 0/0 where all
    # positions are equal.
    spread = np.sqrt(position.var(axis=0).sum()) + 1e-9
    features = np.concatenate([position / spread, poses[:, :3, 2]], axis=1)
    total = [np.linalg.norm(features - one, axis=1).sum() for one in features]
    return views[int(np.argmin(total))]


def _named_view(scene: Scene, view: str | int) -> View:
    names = [v.name for v in scene.views]
    text = str(view)
    for number, name in enumerate(names):
        if text in (name, Path(name).name, Path(name).stem):
            return scene.views[number]
    if text.isdecimal() and len(text) < 10 and int(text) < len(names):
        return scene.views[int(text)]
    near = difflib.get_close_matches(text, names, n=1, cutoff=0.0) or names[:1]
    raise UserError(
        f"there is no view {excerpt(text)} among the {len(names)} photographs; give a name such as"
        f" {near[0]!r} or a number from 0 to {len(names) - 1}"
    )


def _check_frames(frames: int) -> None:
    if not 1 <= frames <= MAX_FRAMES:
        raise UserError(
            f"a movie of {excerpt(frames)} frames cannot be rendered; give --frames 1 or more"
            f" (up to {MAX_FRAMES})"
        )
