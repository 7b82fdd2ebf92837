"""All checks of a capture, in the order in which one relies on another."""

from __future__ import annotations

import contextlib
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError
from climatenerf.scene.checks.appearance import appearance_findings
from climatenerf.scene.checks.intrinsics import camera_findings, corrected_camera, exif_findings
from climatenerf.scene.checks.matching import matching_findings
from climatenerf.scene.checks.points import agreeing_convention, view_findings
from climatenerf.scene.checks.poses import (
    baseline_findings,
    duplicate_findings,
    without_outliers,
)
from climatenerf.scene.checks.visibility import with_visible_points
from climatenerf.scene.findings import Finding, without_repeats
from climatenerf.scene.images import focal_35mm
from climatenerf.scene.scene import Scene

MAX_EXIF = 24  # photos whose EXIF is read
MIN_SHARED = 3  # photos of a camera that must agree in EXIF


def corrected(scene: Scene, point_transforms: Sequence[Float[np.ndarray, "4 4"]] = ()) -> Scene:
    """Return the scene with contradictions of poses, intrinsics and points found or mended.

    Args:
        scene: Poses and points in the input frame.
        point_transforms: Transforms that the points may lack although the poses include them.

    Returns:
        The scene, without photos whose cameras are far off, with what was found in `findings`.
    """
    scene, findings = _with_corrected_cameras(scene)
    fractions = None
    if scene.points is not None and len(scene.points):
        scene, fractions, odd = agreeing_convention(scene, point_transforms)
        findings += odd
    recorded = fractions is not None and fractions.recorded
    if not recorded and not any(f.code == "pose-axes" for f in findings):
        with contextlib.suppress(UserError):  # a photo that cannot be read: loading it reports that
            scene, odd = _without_record(scene, findings)
            findings += odd
    total = len(scene.views)
    before = scene.views
    scene, odd = without_outliers(scene, fractions)
    if fractions is not None and len(scene.views) < total:
        remaining = [view in scene.views for view in before]
        fractions = replace(fractions, by_view=fractions.by_view[remaining])
    findings += odd
    if fractions is not None:
        findings += view_findings(scene, fractions)
    if recorded and not any(f.code in ("pose-axes", "points-outside") for f in findings):
        with contextlib.suppress(UserError):
            findings += _photo_findings(scene)
    for camera in dict.fromkeys(scene.cameras[view.camera] for view in scene.views):
        findings += camera_findings(camera)
    findings += [*duplicate_findings(scene), *baseline_findings(scene), *_exif(scene)]
    return replace(scene, findings=without_repeats((*scene.findings, *findings)))


def _photo_findings(scene: Scene) -> list[Finding]:
    """Compare photos around the points that they share, or else around matched corners.

    Raises:
        UserError: A photo cannot be read.
    """
    if (odd := appearance_findings(scene)) is not None:
        return odd
    # Points that agree with the poses outweigh matches that would convert these.
    codes = ("focal-disagrees", "matches-disagree")
    return [each for each in matching_findings(scene).findings if each.code in codes]


def _without_record(scene: Scene, earlier: Sequence[Finding]) -> tuple[Scene, list[Finding]]:
    """Compare photos by matches, and around the points that are visible in them by their poses.

    Both use the same photos.

    Returns:
        The scene, in the axes in which matches agree with its poses, and what is odd.

    Raises:
        UserError: A photo cannot be read.
    """
    found = matching_findings(scene)
    odd = found.findings
    certain = any(each.code not in ("matches-few", "pose-disagrees") for each in odd)
    outside = any(each.code == "points-outside" for each in earlier)
    if scene.points is None or not len(scene.points) or certain or outside:
        return found.scene, odd
    visible = with_visible_points(scene, found.photos)
    if (unlike := appearance_findings(visible, found.photos, found.agreeing)) is None:
        return scene, odd
    return scene, [*(each for each in odd if each.code != "matches-few"), *unlike]


def _with_corrected_cameras(scene: Scene) -> tuple[Scene, list[Finding]]:
    cameras, findings = [], []
    for camera in scene.cameras:
        found, odd = corrected_camera(camera)
        cameras.append(found)
        findings += odd
    return replace(scene, cameras=tuple(cameras)), findings


def _exif(scene: Scene) -> list[Finding]:
    """Return a finding for each camera that contradicts the EXIF of most of its photos."""
    step = max(1, len(scene.views) // MAX_EXIF)
    focal: dict[Camera, list[float]] = defaultdict(list)
    for view in scene.views[::step]:
        if (value := focal_35mm(view.path)) is not None:
            focal[scene.cameras[view.camera]].append(value)
    findings = []
    for camera, values in focal.items():
        if len(values) >= min(MIN_SHARED, len(scene.views[::step])):
            findings += exif_findings(camera, float(np.median(values)))
    return findings
