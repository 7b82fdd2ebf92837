"""Multi-view consistency of rendered frames: a frame warped by depth must match its neighbour."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from climatenerf.evaluation.geometry import nearest_pixels
from climatenerf.scene import Camera

DEPTH_TOLERANCE = 0.02  # relative; a point is visible in the other frame if its depth agrees
MIN_PIXELS = 200  # fewer common pixels give no score


@dataclass(frozen=True)
class Frame:
    """One frame of a movie.

    Attributes:
        picture: display values, [0, 1].
        depth: ray length, m; +inf in the sky.
        excluded: pixels whose colour may depend on the view (water).
        c2w: pose, world m.
        camera: intrinsics.
    """

    picture: Float[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"]
    excluded: Bool[np.ndarray, "h w"]
    c2w: Float[np.ndarray, "4 4"]
    camera: Camera


def warp_error(frame: Frame, other: Frame) -> float:
    """Return the RMS difference between a frame and another one warped to it, over its contrast.

    The contrast is the standard deviation of the frame's colours over the compared pixels.

    Args:
        frame: at time t.
        other: at t + 1 or later.

    Returns:
        0 for a rigid scene of diffuse surfaces; NaN if fewer than `MIN_PIXELS` are common.
    """
    compared = _compared(frame, other)
    if compared is None:
        return float("nan")
    colour, warped = compared
    contrast = np.sqrt(((colour - colour.mean(0)) ** 2).mean())
    # 1e-6: a frame of one colour has no contrast, 0/0.
    return float(np.sqrt(((colour - warped) ** 2).mean()) / max(contrast, 1e-6))


def warp_difference(frame: Frame, other: Frame) -> float:
    """Return the RMS difference between a frame and another one warped to it, display value.

    Arguments and NaN are those of `warp_error`. This is for surfaces that may be of one colour.
    """
    compared = _compared(frame, other)
    if compared is None:
        return float("nan")
    colour, warped = compared
    return float(np.sqrt(((colour - warped) ** 2).mean()))


def _compared(
    frame: Frame, other: Frame
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]] | None:
    """Return the colours of a frame, and those of another frame at the same surface points.

    The surface point of each pixel is projected into the other frame, whose colour is interpolated
    bilinearly. Excluded pixels, sky and points hidden from the other camera are left out. None if
    fewer than `MIN_PIXELS` are common.
    """
    compared = np.isfinite(frame.depth) & ~frame.excluded
    rays = frame.camera.directions() @ frame.c2w[:3, :3].T
    points = frame.c2w[:3, 3] + np.where(compared, frame.depth, 1.0)[..., None] * rays
    local = (points - other.c2w[:3, 3]) @ other.c2w[:3, :3]
    row, column, inside = nearest_pixels(other.camera, local)
    distance = np.linalg.norm(local, axis=-1)
    visible = np.abs(other.depth[row, column] - distance) < DEPTH_TOLERANCE * distance
    compared &= inside & visible & ~other.excluded[row, column]
    if compared.sum() < MIN_PIXELS:
        return None
    return frame.picture[compared], bilinear(other.picture, other.camera.project(local[compared]))


def bilinear(
    picture: Float[np.ndarray, "h w 3"], pixel: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 3"]:
    """Interpolate a picture at pixel coordinates (x, y); beyond the border the edge is repeated."""
    height, width = picture.shape[:2]
    x = np.clip(pixel[:, 0] - 0.5, 0, width - 1)
    y = np.clip(pixel[:, 1] - 0.5, 0, height - 1)
    i = np.minimum(x.astype(int), width - 2)
    j = np.minimum(y.astype(int), height - 2)
    u, v = (x - i)[:, None], (y - j)[:, None]
    upper = (1 - u) * picture[j, i] + u * picture[j, i + 1]
    lower = (1 - u) * picture[j + 1, i] + u * picture[j + 1, i + 1]
    return (1 - v) * upper + v * lower
