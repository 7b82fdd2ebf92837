"""The world frame of a capture: z up, metres, origin on the ground below the cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from climatenerf.scene.alignment.ground_plane import Ground, find_ground
from climatenerf.scene.alignment.up import estimate_up, rotation_to_z
from climatenerf.scene.findings import Finding
from climatenerf.scene.scene import Scene

ASSUMED_CAMERA_HEIGHT = 1.6  # m: a camera held at eye height
ASSUMED_SCALE_ERROR = 0.3  # relative
NO_GROUND_SCALE_ERROR = 0.5  # relative
MIN_SCALE_ERROR = 0.05  # relative, of a camera height that the user gives
MAX_ORIGIN_DISTANCE = 10_000  # m: float32 resolves a millimetre up to 16 km from the origin
FOCUS_FRACTION = 0.35  # camera height over distance to the focus, where no ground is found


def align_scene(
    scene: Scene,
    *,
    camera_height: float | None = None,
    metric_input: bool = False,
    gravity: Mapping[str, Sequence[float]] | None = None,
) -> Scene:
    """Return the scene with up, scale and ground datum, as `world_from_input` and its reports.

    Up comes from `up.estimate_up`. The scale is that of `metric_input`, or the one that puts the
    cameras `camera_height` (1.6 m if not given) above the ground below them. The ground datum is
    the median ground height under the camera path. Without sparse points below the cameras, their
    height is assumed to be 0.35 times the distance to their common focus.

    Args:
        scene: Scene from a reader; its `world_from_input` is ignored.
        camera_height: Height of the cameras above the ground, m, > 0.
        metric_input: The input frame is in metres with z up and is kept unchanged.
        gravity: Direction of gravity in camera axes (x right, y down, z forward), unit vector, by
            image name.

    Raises:
        UserError: An image cannot be read.
    """
    poses = np.stack([v.c2w for v in scene.views])
    up = estimate_up(scene, gravity or {}, input_is_upright=metric_input)
    scene = replace(scene, up_report=up.report, findings=(*scene.findings, *up.findings))
    rotation = np.eye(3) if metric_input else rotation_to_z(up.direction)
    positions = poses[:, :3, 3] @ rotation.T
    points = None if scene.points is None else scene.points @ rotation.T
    ground = None if points is None else find_ground(points, positions)
    if metric_input:
        return _keep_metric_frame(scene, positions, ground)
    if ground is None:
        height = _assumed_height(poses, positions[:, 2])
        ground_z = lowest_z = float(np.median(positions[:, 2])) - height
        error = NO_GROUND_SCALE_ERROR
    else:
        height, ground_z, lowest_z = ground.camera_height, ground.under_path, ground.lowest
        smallest = ASSUMED_SCALE_ERROR if camera_height is None else MIN_SCALE_ERROR
        error = max(smallest, round(ground.spread, 3))
    scale = (camera_height or ASSUMED_CAMERA_HEIGHT) / height
    world = np.eye(4)
    world[:3, :3] = scale * rotation
    world[:3, 3] = -scale * np.append(positions[:, :2].mean(axis=0), ground_z)
    return replace(
        scene,
        world_from_input=world,
        scale_source="camera-height" if camera_height else "camera-height-assumed",
        scale_error=error,
        ground_z=0.0,
        lowest_ground_z=float(scale * (lowest_z - ground_z)),
        findings=(*scene.findings, *_scale_findings(ground, camera_height, error)),
    )


def _keep_metric_frame(
    scene: Scene, positions: Float[np.ndarray, "n 3"], ground: Ground | None
) -> Scene:
    """Return the scene with the input frame as world frame, moved only if far from its origin."""
    findings = list(scene.findings)
    if ground is None:
        ground_z = lowest_z = float(np.median(positions[:, 2])) - ASSUMED_CAMERA_HEIGHT
        findings.append(
            Finding(
                "ground-missing",
                "No ground was found below the cameras, so it is assumed"
                f" {ASSUMED_CAMERA_HEIGHT} m below them",
                "check water levels in the result",
            )
        )
    else:
        ground_z, lowest_z = ground.under_path, ground.lowest
    world = np.eye(4)
    origin = np.round(positions[:, :2].mean(axis=0), -3)
    if np.abs(origin).max() > MAX_ORIGIN_DISTANCE:
        world[:2, 3] = -origin
        findings.append(
            Finding(
                "origin-moved",
                "The poses are far from their origin; the world's origin is moved to x"
                f" {origin[0]:.0f} m, y {origin[1]:.0f} m of the input",
                severity="note",
            )
        )
    return replace(
        scene,
        world_from_input=world,
        scale_source="metric-input",
        scale_error=0.0,
        ground_z=float(ground_z),
        lowest_ground_z=float(lowest_z),
        findings=tuple(findings),
    )


def _assumed_height(poses: Float[np.ndarray, "n 4 4"], z: Float[np.ndarray, " n"]) -> float:
    """Return a camera height, input units, from the distance to the common focus of the cameras.

    The height is large enough for the ground to lie below the lowest camera.

    Args:
        poses: Camera-to-input poses.
        z: Camera heights along up, input units, any origin.
    """
    position, axis = poses[:, :3, 3], poses[:, :3, 2]
    across = np.eye(3) - axis[:, :, None] * axis[:, None, :]
    # A small regulariser towards the mean position keeps parallel axes from meeting at infinity.
    regulariser = 1e-3 * np.eye(3)
    focus = np.linalg.solve(
        across.mean(axis=0) + regulariser,
        np.einsum("nij,nj->ni", across, position).mean(axis=0)
        + regulariser @ position.mean(axis=0),
    )
    ahead = np.einsum("nj,nj->n", focus - position, axis)
    distance = float(np.linalg.norm(focus - position, axis=-1).mean())
    if np.median(ahead) <= 0 or not distance > 0:
        distance = float(np.linalg.norm(np.ptp(position, axis=0))) or 1.0
    return max(FOCUS_FRACTION * distance, float(np.median(z) - z.min()) + 0.1 * distance)


def _scale_findings(
    ground: Ground | None, camera_height: float | None, error: float
) -> list[Finding]:
    if ground is None:
        message = (
            "No ground was found below the cameras, so scale and ground height are estimates "
            f"(+-{error:.0%})"
        )
        return [Finding("ground-missing", message, "check water levels in the result")]
    if camera_height is None:
        # `scale.with_capture_flags` replaces the remedy.
        message = (
            f"The scale is assumed: cameras {ASSUMED_CAMERA_HEIGHT} m above the ground "
            f"(+-{error:.0%})"
        )
        remedy = "give --camera-height, or --metric-input if the poses are in metres with z up"
        return [Finding("scale-assumed", message, remedy)]
    return []
