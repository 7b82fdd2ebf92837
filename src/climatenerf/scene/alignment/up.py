"""Estimation of the up direction from accelerometers, camera axes, ground points and edges."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from climatenerf.scene.alignment.ground_plane import find_ground, ground_plane
from climatenerf.scene.alignment.vanishing_point import VanishingPoint, find_vanishing_point
from climatenerf.scene.findings import Finding
from climatenerf.scene.images import read_header
from climatenerf.scene.scene import Scene

DISAGREEMENT = 5.0  # degrees between methods that are worth a warning
SIGMAS = 1.5  # the same in standard errors of a method
OUTLIER = 10.0  # degrees from the combined direction that exclude a method
ROLL_SIGMA = 2.5  # degrees: roll of a hand-held camera
PITCH_SIGMA = 8.0  # degrees: mean pitch of the cameras
PLANE_SIGMA = 2.5  # degrees: slope of open ground
LINES_SIGMA = 0.6  # degrees: plumbness of posts and walls
GRAVITY_SIGMA = 1.0  # degrees: alignment of an accelerometer with its camera
MIN_READINGS = 3  # of accelerometers


@dataclass(frozen=True)
class UpEstimate:
    """Up direction according to one method.

    Attributes:
        direction: Unit vector, input frame.
        sigma: Standard error of the direction, degrees, > 0.
        method: "gravity", "cameras", "ground" or "lines".
    """

    direction: Float[np.ndarray, " 3"]
    sigma: float
    method: str


@dataclass(frozen=True)
class Up:
    """Up direction combined from all methods.

    Attributes:
        direction: Unit vector, input frame.
        report: As `Scene.up_report`.
        findings: The disagreement of the methods, if there is one.
    """

    direction: Float[np.ndarray, " 3"]
    report: dict[str, object]
    findings: tuple[Finding, ...]


def estimate_up(
    scene: Scene, gravity: Mapping[str, Sequence[float]], *, input_is_upright: bool = False
) -> Up:
    """Estimate the up direction of a scene.

    Up to four methods contribute: *gravity* (accelerometer readings), *cameras* (their x axes are
    horizontal and their y axes point down on average), *ground* (plane through the low sparse
    points) and *lines* (vertical vanishing point of straight edges). Gravity, or the cameras if
    there is none, gives the initial direction; ground and lines are searched around it. `combine`
    merges the estimates. A method more than 5 degrees from the result gives a warning.

    Args:
        scene: Poses and points in the input frame; the images are read from disk.
        gravity: Direction of gravity in camera axes (x right, y down, z forward), unit vector, by
            image name.
        input_is_upright: Up is the input's z axis; the estimates are only compared with it.

    Raises:
        UserError: An image cannot be read.
    """
    poses = np.stack([v.c2w for v in scene.views])
    estimates = [up_from_cameras(_upright_axes(scene, poses))]
    if (measured := up_from_gravity(scene, gravity)) is not None:
        estimates.insert(0, measured)
    initial = estimates[0].direction
    if (plane := _up_from_ground(scene, poses, initial)) is not None:
        estimates.append(plane)
    lines = find_vanishing_point(scene, initial)
    reliable = lines is not None and _is_reliable(lines)
    if lines is not None and reliable:
        sigma = float(np.hypot(LINES_SIGMA, lines.sigma))
        estimates.append(UpEstimate(lines.up, sigma, "lines"))
    if input_is_upright:
        up, used, name = np.array([0.0, 0.0, 1.0]), "metric-input", "the input's z axis"
    else:
        up, used = combine(estimates)
        name = "the chosen up direction"
    angles = {e.method: _angle(e.direction, up) for e in estimates}
    report: dict[str, object] = {"used": used}
    report |= {method: round(angle, 2) for method, angle in angles.items()}
    if lines is not None and not reliable:
        report["lines (too few to use)"] = round(_angle(lines.up, up), 2)
    # The angle in standard errors, of which the cameras' pitch has many degrees.
    excess = {e.method: _angle(e.direction, up) / allowed_angle(e.sigma) for e in estimates}
    worst = max(excess, key=lambda method: excess[method])
    if excess[worst] <= 1:
        return Up(up, report, ())
    finding = Finding(
        "up-uncertain",
        f"Up is uncertain: {worst} and {name} disagree by {angles[worst]:.0f} degrees",
        "check the result for tilted water",
    )
    return Up(up, report, (finding,))


def allowed_angle(sigma: float) -> float:
    """Return the angle, degrees, from the chosen up that a method of this error may have."""
    return max(DISAGREEMENT, SIGMAS * sigma)


def up_from_cameras(axes: Float[np.ndarray, "n 3 2"]) -> UpEstimate:
    """Estimate up from the cameras' right and up axes, input frame.

    Minimise sum (right_i . u)^2 / roll_sigma^2 / n + |u - m|^2 / pitch_sigma^2, m being the mean of
    the up axes. If the headings differ, the right axes alone determine u. If all cameras look in
    the same direction, their common pitch is not observable and m determines u.
    """
    x, up = axes[..., 0], axes[..., 1].mean(axis=0)
    # Up axes in all directions have a zero mean; the first camera's up axis replaces it.
    mean = up if np.linalg.norm(up) > 1e-6 else axes[0, :, 1]
    mean = mean / np.linalg.norm(mean)
    information = x.T @ x / len(x) / ROLL_SIGMA**2 + np.eye(3) / PITCH_SIGMA**2
    direction = np.linalg.solve(information, mean / PITCH_SIGMA**2)
    direction /= np.linalg.norm(direction)
    tangent = np.linalg.svd(direction[None])[2][1:]
    weakest = np.linalg.eigvalsh(tangent @ information @ tangent.T)[0]
    return UpEstimate(direction, float(1 / np.sqrt(weakest)), "cameras")


def up_from_gravity(scene: Scene, gravity: Mapping[str, Sequence[float]]) -> UpEstimate | None:
    """Estimate up from accelerometer readings, as the mean of those near the median direction.

    Args:
        scene: Poses in the input frame.
        gravity: Direction of gravity in camera axes, unit vector, by image name.

    Returns:
        None if there are fewer than `MIN_READINGS`, or fewer than half are within `OUTLIER` degrees
        of the median.
    """
    down = [v.c2w[:3, :3] @ np.asarray(gravity[v.name]) for v in scene.views if v.name in gravity]
    if len(down) < MIN_READINGS:
        return None
    up = -np.array(down)
    median = np.median(up, axis=0)
    if np.linalg.norm(median) < 0.5:
        return None
    angles = np.array([_angle(u, median / np.linalg.norm(median)) for u in up])
    near = angles < OUTLIER
    if near.mean() < 0.5 or near.sum() < MIN_READINGS:
        return None
    mean = up[near].mean(axis=0)
    # Averaging reduces the scatter, but not the misalignment of sensor and camera.
    scatter = float(np.sqrt((angles[near] ** 2).mean() / near.sum()))
    sigma = float(np.hypot(GRAVITY_SIGMA, scatter))
    return UpEstimate(mean / np.linalg.norm(mean), sigma, "gravity")


def combine(estimates: list[UpEstimate]) -> tuple[Float[np.ndarray, " 3"], str]:
    """Merge estimates of up; the first is the initial direction.

    The estimate with the smallest sigma is the reference. If it is 10 degrees or more from the
    initial direction, another estimate must confirm it within 5 degrees; otherwise the next one is
    tried. Estimates within 10 degrees of the reference are averaged with weights 1 / sigma^2.

    Returns:
        Unit vector, input frame, and the methods averaged, such as "lines+ground".
    """
    initial = estimates[0]
    ranked = sorted(estimates, key=lambda e: e.sigma)
    for reference in ranked:
        others = [e for e in estimates if e is not reference and e is not initial]
        confirmed = any(_angle(e.direction, reference.direction) < DISAGREEMENT for e in others)
        if confirmed or _angle(reference.direction, initial.direction) < OUTLIER:
            break
    agreeing = [e for e in ranked if _angle(e.direction, reference.direction) < OUTLIER]
    total = np.sum([e.direction / e.sigma**2 for e in agreeing], axis=0)
    return total / np.linalg.norm(total), "+".join(e.method for e in agreeing)


def rotation_to_z(up: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """Return the smallest rotation that takes the unit vector `up` to +z."""
    z = np.array([0.0, 0.0, 1.0])
    axis, cosine = np.cross(up, z), float(up @ z)
    if cosine < -1 + 1e-9:
        # The axis is undefined for -z; any horizontal one will do.
        return np.diag([1.0, -1.0, -1.0])
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + k + k @ k / (1 + cosine)


def _upright_axes(scene: Scene, poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 3 2"]:
    """Return the right and up axes of the images as displayed, input frame.

    Portrait photos stored in landscape have rotated poses; EXIF records the orientation in which
    they were taken. A tag may be wrong, so the tags are used only if the resulting up axes agree
    with one another about as well as without them.
    """
    stored = np.stack([poses[:, :3, 0], -poses[:, :3, 1]], axis=-1)
    headers = [read_header(v.path) for v in scene.views]
    displayed_up = np.array(
        [
            h.up_direction(scene.cameras[v.camera])
            for h, v in zip(headers, scene.views, strict=True)
        ],
        dtype=np.float64,
    )
    x, y = poses[:, :3, 0], poses[:, :3, 1]
    up = displayed_up[:, :1] * x + displayed_up[:, 1:] * y
    right = -displayed_up[:, 1:] * x + displayed_up[:, :1] * y
    with_tags = np.linalg.norm(up.mean(axis=0))
    without_tags = np.linalg.norm(stored[..., 1].mean(axis=0))
    return np.stack([right, up], axis=-1) if with_tags > without_tags - 0.1 else stored


def _up_from_ground(
    scene: Scene, poses: Float[np.ndarray, "n 4 4"], initial: Float[np.ndarray, " 3"]
) -> UpEstimate | None:
    if scene.points is None:
        return None
    up = initial
    # The ground cells depend on the assumed up; a second pass with the plane's normal refines both.
    for _ in range(2):
        rotation = rotation_to_z(up)
        ground = find_ground(scene.points @ rotation.T, poses[:, :3, 3] @ rotation.T)
        plane = ground_plane(ground) if ground else None
        if plane is None:
            return None
        up = rotation.T @ plane[0]
    return UpEstimate(up, PLANE_SIGMA, "ground")


def _is_reliable(lines: VanishingPoint) -> bool:
    return lines.segments >= 20 and lines.images >= 4 and lines.fraction >= 0.3 and lines.sigma < 2


def _angle(a: Float[np.ndarray, " 3"], b: Float[np.ndarray, " 3"]) -> float:
    """Return the angle between two vectors, degrees."""
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))
