"""Up, scale and ground datum of a capture, found without a hand-made file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from climatenerf.scene.alignment.ground_plane import Ground, find_ground, ground_plane
from climatenerf.scene.alignment.vanishing_point import VerticalLines, vertical_lines
from climatenerf.scene.images import picture_header
from climatenerf.scene.scene import Scene

ASSUMED_CAMERA_HEIGHT = 1.6  # m: held at eye height
DISAGREEMENT = 5.0  # degrees between methods that are worth a warning
OUTLIER = 10.0  # degrees from the agreed direction that disqualify a method
ROLL_SIGMA = 2.5  # degrees: how level a photographer holds a camera from side to side
PITCH_SIGMA = 8.0  # degrees: how much cameras look up or down on average
PLANE_SIGMA = 2.5  # degrees: how level open ground is
LINES_SIGMA = 0.6  # degrees: how upright posts and walls are, at best
GRAVITY_SIGMA = 1.0  # degrees: how well a camera's accelerometer is aligned with its picture
MIN_READINGS = 3  # of gravity
FAR_ORIGIN = 10_000  # m: 32-bit numbers resolve a millimetre up to 16 km from the origin
FOCUS_SHARE = 0.35  # camera height over distance to what is looked at, when no ground is seen


@dataclass(frozen=True)
class UpEstimate:
    """One method's idea of up.

    Attributes:
        direction: Unit vector, input frame.
        sigma: Its standard error, degrees, > 0.
        method: What it rests on.
    """

    direction: Float[np.ndarray, " 3"]
    sigma: float
    method: str


def level(
    scene: Scene,
    *,
    camera_height: float | None = None,
    metric_input: bool = False,
    gravity: Mapping[str, Sequence[float]] | None = None,
) -> Scene:
    """Find up, scale and ground of a scene and return it with `world_from_input` set.

    Up comes from up to four methods: *gravity* (what the cameras' own sensors told), *cameras*
    (their x axes are horizontal, their y axes point down on average), *ground* (plane through the
    low sparse points) and *lines* (vertical vanishing point of straight edges). Rule: gravity, or
    else the cameras, gives the first guess, and ground and lines are looked for around it. The
    method with the smallest standard error leads, but if it is more than 10 degrees from the first
    guess it must be backed by another one. What lies within 10 degrees of the
    leader is averaged with weights 1 / sigma^2. `up_report` tells how far each method is from the
    result, and a disagreement above 5 degrees is a warning.

    Scale: `metric_input`, else the height of the cameras above the ground below them, which is
    `camera_height` or assumed to be 1.6 m. The ground datum is the median ground height under the
    camera path. Without sparse points the ground is assumed to be 0.35 times the distance to what
    the cameras look at below them.

    Args:
        scene: As a reader made it; its `world_from_input` is ignored.
        camera_height: Height of the cameras above the ground, metres, > 0.
        metric_input: The input frame is in metres with z up; it is kept exactly.
        gravity: Down in the camera's axes (x right, y down, z forward) by picture name.
    """
    warnings = list(scene.warnings)
    poses = np.stack([v.c2w for v in scene.views])
    estimates = [up_from_cameras(_upright_axes(scene, poses))]
    felt = up_from_gravity(scene, gravity or {})
    if felt is not None:
        estimates.insert(0, felt)
    guess = estimates[0]
    if (plane := _up_from_ground(scene, poses, guess.direction)) is not None:
        estimates.append(plane)
    lines = vertical_lines(scene, guess.direction)
    if lines is not None and _trustworthy(lines):
        sigma = float(np.hypot(LINES_SIGMA, lines.sigma))
        estimates.append(UpEstimate(lines.up, sigma, "lines"))
    if metric_input:
        up, used = np.array([0.0, 0.0, 1.0]), "metric-input"
    else:
        up, used = combine(estimates)
    report: dict[str, object] = {"used": used}
    report |= {e.method: round(_degrees(e.direction, up), 2) for e in estimates}
    if lines is not None and not _trustworthy(lines):
        report["lines (too few to use)"] = round(_degrees(lines.up, up), 2)
    apart = {e.method: _degrees(e.direction, up) for e in estimates}
    level_name = "the input's z axis" if metric_input else "the up that is used"
    worst = max(apart, key=lambda m: apart[m])
    if apart[worst] > DISAGREEMENT:
        warnings.append(
            f"Up is uncertain: {worst} and {level_name} disagree by {apart[worst]:.0f} degrees; "
            "look at the result for tilted water."
        )
    rotation = np.eye(3) if metric_input else _rotation_to_z(up)
    positions = poses[:, :3, 3] @ rotation.T
    points = None if scene.points is None else scene.points @ rotation.T
    ground = None if points is None else find_ground(points, positions)
    height = ground.camera_height if ground else _assumed_height(poses, positions[:, 2])
    under_path = ground.under_path if ground else float(np.median(positions[:, 2])) - height
    lowest = ground.lowest if ground else under_path
    if metric_input:
        scale, source, error = 1.0, "metric-input", 0.0
        if ground is None:
            under_path = lowest = float(np.median(positions[:, 2])) - ASSUMED_CAMERA_HEIGHT
            warnings.append("No ground was found; it is assumed 1.6 m below the cameras.")
    else:
        scale = (camera_height or ASSUMED_CAMERA_HEIGHT) / height
        source = "camera-height" if camera_height else "camera-height-assumed"
        error = _scale_error(ground, camera_height)
        warnings += _scale_warnings(ground, camera_height, error)
    world = np.eye(4)
    world[:3, :3] = scale * rotation
    if not metric_input:
        origin = np.append(positions[:, :2].mean(axis=0), under_path)
        world[:3, 3] = -scale * origin
        lowest, under_path = scale * (lowest - under_path), 0.0
    elif np.abs(origin := np.round(positions[:, :2].mean(axis=0), -3)).max() > FAR_ORIGIN:
        world[:2, 3] = -origin
        warnings.append(
            f"The poses are far from their origin; the world's is put at x {origin[0]:.0f} m,"
            f" y {origin[1]:.0f} m of the input."
        )
    return replace(
        scene,
        world_from_input=world,
        scale_source=source,
        scale_error=error,
        ground_z=float(under_path),
        lowest_ground_z=float(lowest),
        up_report=report,
        warnings=tuple(warnings),
    )


def _upright_axes(scene: Scene, poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 3 2"]:
    """Right and up axes of the pictures as they are shown, input frame.

    Photos taken on edge but stored lying have poses that lie, too; EXIF knows how they were held.
    A tag can be stale, so it is believed only if the axes agree about as well as without it.
    """
    plain = np.stack([poses[:, :3, 0], -poses[:, :3, 1]], axis=-1)
    headers = [picture_header(v.path) for v in scene.views]
    shown = np.array(
        [
            h.up_in_picture(scene.cameras[v.camera])
            for h, v in zip(headers, scene.views, strict=True)
        ],
        dtype=np.float64,
    )
    x, y = poses[:, :3, 0], poses[:, :3, 1]
    up = shown[:, :1] * x + shown[:, 1:] * y
    right = -shown[:, 1:] * x + shown[:, :1] * y
    agreement = np.linalg.norm(up.mean(axis=0)), np.linalg.norm(plain[..., 1].mean(axis=0))
    return np.stack([right, up], axis=-1) if agreement[0] > agreement[1] - 0.1 else plain


def up_from_cameras(axes: Float[np.ndarray, "n 3 2"]) -> UpEstimate:
    """Up from the cameras' right and up axes, input frame.

    Minimises sum (right_i . u)^2 / roll_sigma^2 / n + |u - m|^2 / pitch_sigma^2, m being the mean
    of the up axes. Where the headings spread, the right axes alone fix u; where all cameras look
    the same way, their common pitch cannot be told from up and m decides.
    """
    x, up = axes[..., 0], axes[..., 1].mean(axis=0)
    # Cameras that point every way have no mean up; the first camera's then stands in.
    mean = up if np.linalg.norm(up) > 1e-6 else axes[0, :, 1]
    mean = mean / np.linalg.norm(mean)
    information = x.T @ x / len(x) / ROLL_SIGMA**2 + np.eye(3) / PITCH_SIGMA**2
    direction = np.linalg.solve(information, mean / PITCH_SIGMA**2)
    direction /= np.linalg.norm(direction)
    across = np.linalg.svd(direction[None])[2][1:]
    weakest = np.linalg.eigvalsh(across @ information @ across.T)[0]
    return UpEstimate(direction, float(1 / np.sqrt(weakest)), "cameras")


def up_from_gravity(scene: Scene, gravity: Mapping[str, Sequence[float]]) -> UpEstimate | None:
    """Up from what accelerometers told, in the input frame; None where they do not agree.

    The mean of those within `OUTLIER` degrees of the median direction, which most must be.
    """
    down = [v.c2w[:3, :3] @ np.asarray(gravity[v.name]) for v in scene.views if v.name in gravity]
    if len(down) < MIN_READINGS:
        return None
    up = -np.array(down)
    middle = np.median(up, axis=0)
    if np.linalg.norm(middle) < 0.5:
        return None
    apart = np.array([_degrees(u, middle / np.linalg.norm(middle)) for u in up])
    near = apart < OUTLIER
    if near.mean() < 0.5 or near.sum() < MIN_READINGS:
        return None
    mean = up[near].mean(axis=0)
    # The mean of many is sharper than one, but they share how the sensor sits in its camera.
    scatter = float(np.sqrt((apart[near] ** 2).mean() / near.sum()))
    sigma = float(np.hypot(GRAVITY_SIGMA, scatter))
    return UpEstimate(mean / np.linalg.norm(mean), sigma, "gravity")


def combine(estimates: list[UpEstimate]) -> tuple[Float[np.ndarray, " 3"], str]:
    """The agreed up and the methods it rests on; the rule is in `level`. The first guess leads."""
    first = estimates[0]
    ranked = sorted(estimates, key=lambda e: e.sigma)
    for leader in ranked:
        others = [e for e in estimates if e is not leader and e is not first]
        backed = any(_degrees(e.direction, leader.direction) < DISAGREEMENT for e in others)
        if backed or _degrees(leader.direction, first.direction) < OUTLIER:
            break
    agreeing = [e for e in ranked if _degrees(e.direction, leader.direction) < OUTLIER]
    total = np.sum([e.direction / e.sigma**2 for e in agreeing], axis=0)
    return total / np.linalg.norm(total), "+".join(e.method for e in agreeing)


def _up_from_ground(
    scene: Scene, poses: Float[np.ndarray, "n 4 4"], guess: Float[np.ndarray, " 3"]
) -> UpEstimate | None:
    if scene.points is None:
        return None
    up = guess
    # The cells were cut out with the guessed up; a second round with the plane's own is sharper.
    for _ in range(2):
        rotation = _rotation_to_z(up)
        ground = find_ground(scene.points @ rotation.T, poses[:, :3, 3] @ rotation.T)
        plane = ground_plane(ground) if ground else None
        if plane is None:
            return None
        up = rotation.T @ plane[0]
    return UpEstimate(up, PLANE_SIGMA, "ground")


def _trustworthy(lines: VerticalLines) -> bool:
    return lines.segments >= 20 and lines.images >= 4 and lines.share >= 0.3 and lines.sigma < 2


def _assumed_height(poses: Float[np.ndarray, "n 4 4"], z: Float[np.ndarray, " n"]) -> float:
    """Camera height in input units where no ground is seen, from how far the cameras look.

    The ground also stays below the lowest of the cameras, whose heights are `z`.
    """
    position, axis = poses[:, :3, 3], poses[:, :3, 2]
    across = np.eye(3) - axis[:, :, None] * axis[:, None, :]
    # A little pull to the cameras' centre keeps parallel axes from meeting at infinity.
    pull = 1e-3 * np.eye(3)
    focus = np.linalg.solve(
        across.mean(axis=0) + pull,
        np.einsum("nij,nj->ni", across, position).mean(axis=0) + pull @ position.mean(axis=0),
    )
    ahead = np.einsum("nj,nj->n", focus - position, axis)
    distance = float(np.linalg.norm(focus - position, axis=-1).mean())
    if np.median(ahead) <= 0 or not distance > 0:
        distance = float(np.linalg.norm(np.ptp(position, axis=0))) or 1.0
    return max(FOCUS_SHARE * distance, float(np.median(z) - z.min()) + 0.1 * distance)


def _scale_error(ground: Ground | None, camera_height: float | None) -> float:
    if ground is None:
        return 0.5
    return max(0.3 if camera_height is None else 0.05, round(ground.spread, 3))


def _scale_warnings(ground: Ground | None, camera_height: float | None, error: float) -> list[str]:
    if ground is None:
        return [
            "No ground was found below the cameras, so scale and ground are guesses "
            f"(+-{error:.0%}); levels in metres are to be taken with care."
        ]
    if camera_height is None:
        return [
            f"The scale is assumed: cameras {ASSUMED_CAMERA_HEIGHT} m above the ground "
            f"(+-{error:.0%}); give --camera-height, or --metric-input if the poses are in metres "
            "with z up."
        ]
    return []


def _rotation_to_z(up: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """The smallest rotation that takes the unit vector `up` to +z."""
    z = np.array([0.0, 0.0, 1.0])
    axis, cosine = np.cross(up, z), float(up @ z)
    if cosine < -1 + 1e-9:
        # Exactly upside down every horizontal axis will do.
        return np.diag([1.0, -1.0, -1.0])
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + k + k @ k / (1 + cosine)


def _degrees(a: Float[np.ndarray, " 3"], b: Float[np.ndarray, " 3"]) -> float:
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))
