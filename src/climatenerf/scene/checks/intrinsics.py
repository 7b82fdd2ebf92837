"""Do intrinsics agree with the size of the photos, with each other and with EXIF?"""

from __future__ import annotations

import math
from dataclasses import replace

from climatenerf.core.cameras import Camera
from climatenerf.scene.findings import Finding

MAX_FRACTION = 10.0  # a focal length below is in widths: 10 pixels on 64 are 145 degrees
MIN_FRACTION_SIDE = 64  # pixels; smaller photos may have such a focal length in pixels
MAX_FRACTION_CENTRE = 1.5  # a principal point below is in widths and heights
FOREIGN_SIZE = 1.5  # principal point over half the photo's size that another size explains
SAME_SHAPE = 0.2  # relative difference between the two sides' ratios
INTEGER_RATIO = 0.06  # relative distance to a whole number, off-centre principal points included
FIELDS_OF_VIEW = (3.0, 165.0)  # degrees across a perspective photo
MAX_PIXEL_ASPECT = 1.2  # of fx and fy; pixels of cameras are square within 1 %
MAX_OFF_CENTRE = 0.35  # of the side; shifted lenses and crops reach 0.25
MAX_EXIF_RATIO = 1.3  # of focal lengths; crops by video modes reach 1.25


def corrected_camera(camera: Camera) -> tuple[Camera, list[Finding]]:
    """Return a camera with intrinsics in pixels of its photo, and what was changed.

    Args:
        camera: Intrinsics as stored, with the size of the photo.
    """
    findings = []
    if camera.fx < 0 or camera.fy < 0:
        message = (
            f"A focal length is negative (fx {camera.fx:g}, fy {camera.fy:g}); its absolute value"
            " is used"
        )
        findings.append(Finding("focal-negative", message, "check that the result is upright"))
        camera = replace(camera, fx=abs(camera.fx), fy=abs(camera.fy))
    if (in_pixels := _from_fractions(camera)) is not None:
        message = (
            f"The intrinsics fx {camera.fx:g}, fy {camera.fy:g} are fractions of the photo's size;"
            f" {in_pixels.fx:.1f} and {in_pixels.fy:.1f} pixels are used"
        )
        findings.append(Finding("intrinsics-fractions", message, "give them in pixels"))
        camera = in_pixels
    elif (scaled := _from_other_size(camera)) is not None:
        ratio = camera.cx / scaled.cx
        message = (
            f"The principal point ({camera.cx:g}, {camera.cy:g}) belongs to photos {ratio:.3g}"
            f" times the size of these {camera.width}x{camera.height}; the intrinsics are scaled"
        )
        remedy = "give w and h of the photos that were calibrated, or correct the intrinsics"
        findings.append(Finding("intrinsics-resolution", message, remedy))
        camera = scaled
    return camera, findings


def camera_findings(camera: Camera) -> list[Finding]:
    """Return what is unusual about a camera's field of view, pixels and principal point."""
    findings, size = [], f"{camera.width}x{camera.height}"
    angle = math.degrees(2 * math.atan(camera.width / (2 * camera.fx)))
    if not camera.fisheye and not FIELDS_OF_VIEW[0] < angle < FIELDS_OF_VIEW[1]:
        message = f"A camera of {size} photos has a field of view of {angle:.1f} degrees"
        findings.append(Finding("focal-unusual", message, "check its focal length"))
    elif max(camera.fx / camera.fy, camera.fy / camera.fx) > MAX_PIXEL_ASPECT:
        message = (
            f"A camera of {size} photos has fx {camera.fx:.1f} and fy {camera.fy:.1f}, as if pixels"
            " were not square"
        )
        findings.append(Finding("focal-unusual", message, "check its intrinsics"))
    off = max(abs(camera.cx / camera.width - 0.5), abs(camera.cy / camera.height - 0.5))
    if off > MAX_OFF_CENTRE:
        message = (
            f"A camera of {size} photos has its principal point at ({camera.cx:.1f},"
            f" {camera.cy:.1f}), far from the middle"
        )
        remedy = "check that the intrinsics belong to photos of this size"
        findings.append(Finding("principal-point", message, remedy))
    return findings


def exif_findings(camera: Camera, focal_35mm: float) -> list[Finding]:
    """Return a finding if a camera's field of view contradicts EXIF.

    Args:
        camera: Intrinsics of the photo.
        focal_35mm: EXIF's FocalLengthIn35mmFilm, mm: the diagonal is that of 36 x 24 mm.
    """
    if camera.fisheye or not focal_35mm > 0:
        return []
    expected = focal_35mm / math.hypot(36, 24) * math.hypot(camera.width, camera.height)
    focal = math.sqrt(camera.fx * camera.fy)
    if max(focal / expected, expected / focal) <= MAX_EXIF_RATIO:
        return []
    message = (
        f"A camera of {camera.width}x{camera.height} photos has a focal length of {focal:.0f}"
        f" pixels, and EXIF gives {expected:.0f}"
    )
    return [Finding("focal-exif", message, "check the intrinsics, or whether photos were cropped")]


def _from_fractions(camera: Camera) -> Camera | None:
    """Return the camera with intrinsics in pixels if they are fractions of the photo's size."""
    w, h = camera.width, camera.height
    if max(camera.fx, camera.fy) >= MAX_FRACTION or min(w, h) < MIN_FRACTION_SIDE:
        return None
    # Pixels are square: fy is a fraction of the height if that agrees, otherwise of the width.
    by_height = abs(math.log(camera.fy * h / (camera.fx * w)))
    by_width = abs(math.log(camera.fy / camera.fx))
    vertical = h if by_height <= by_width else w
    cx, cy = camera.cx, camera.cy
    if max(abs(cx), abs(cy)) < MAX_FRACTION_CENTRE:
        cx, cy = cx * w, min(cy * vertical, cy * h, key=lambda y: abs(y / h - 0.5))
    return replace(camera, fx=camera.fx * w, fy=camera.fy * vertical, cx=cx, cy=cy)


def _from_other_size(camera: Camera) -> Camera | None:
    """Return the camera scaled to its photo if its principal point lies in a photo of other size.

    Only a principal point outside the photo, or nearly so, is certain: that of a smaller photo may
    as well be that of a crop, which `points` tells apart.
    """
    across, down = 2 * camera.cx / camera.width, 2 * camera.cy / camera.height
    if min(across, down) < FOREIGN_SIZE or abs(across / down - 1) > SAME_SHAPE:
        return None
    return scaled_by(camera, size_ratio(across, down))


def size_ratio(across: float, down: float) -> float:
    """Return the ratio of two sizes from that of two principal points, whole if nearly so."""
    ratio = math.sqrt(across * down)
    whole = round(ratio) if ratio > 1 else 1 / max(round(1 / ratio), 1)
    return whole if abs(ratio / whole - 1) < INTEGER_RATIO else ratio


def scaled_by(camera: Camera, ratio: float) -> Camera:
    """Return the camera with its intrinsics divided by `ratio`, for the same photo."""
    return replace(
        camera,
        fx=camera.fx / ratio,
        fy=camera.fy / ratio,
        cx=camera.cx / ratio,
        cy=camera.cy / ratio,
    )
