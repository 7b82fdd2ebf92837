"""All checks of a capture, in the order in which one relies on another."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError
from climatenerf.scene.checks.intrinsics import camera_findings, corrected_camera, exif_findings
from climatenerf.scene.checks.matching import matching_findings
from climatenerf.scene.checks.points import agreeing_convention, view_findings
from climatenerf.scene.checks.poses import (
    baseline_findings,
    duplicate_findings,
    without_outliers,
)
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
    shares = None
    if scene.points is not None and len(scene.points):
        scene, shares, odd = agreeing_convention(scene, point_transforms)
        findings += odd
    if shares is None or not shares.recorded and not any(f.code == "pose-axes" for f in findings):
        try:
            scene, odd = matching_findings(scene)
        except UserError:
            odd = []  # a photo that cannot be read: loading it reports the error
        findings += odd
    total = len(scene.views)
    before = scene.views
    scene, odd = without_outliers(scene, shares)
    if shares is not None and len(scene.views) < total:
        left = [view in scene.views for view in before]
        shares = replace(shares, by_view=shares.by_view[left])
    findings += odd
    if shares is not None:
        findings += view_findings(scene, shares)
    for camera in dict.fromkeys(scene.cameras[view.camera] for view in scene.views):
        findings += camera_findings(camera)
    findings += [*duplicate_findings(scene), *baseline_findings(scene), *_exif(scene)]
    return replace(scene, findings=without_repeats((*scene.findings, *findings)))


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
