"""Whether frames show one place: a frame moved to another's camera by depth must look like it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from climatenerf.evaluation.geometry import nearest_pixels
from climatenerf.scene import Camera

SAME = 0.02  # of the distance: the other frame sees the place itself if its depth is this near
LEAST = 200  # pixels; fewer say nothing


@dataclass(frozen=True)
class Frame:
    """One frame of a movie.

    Attributes:
        picture: display values, 0 to 1.
        depth: ray length, m; +inf in the sky.
        excluded: pixels that may change with the view (water).
        c2w: pose, world m.
        camera: intrinsics.
    """

    picture: Float[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"]
    excluded: Bool[np.ndarray, "h w"]
    c2w: Float[np.ndarray, "4 4"]
    camera: Camera


def warp_error(frame: Frame, other: Frame) -> float:
    """Root mean square difference of a frame from another one warped to it, over its contrast.

    Each pixel's place is looked up in the other frame (bilinearly) where that one sees it too;
    water, sky and what is hidden there are left out. Contrast is the deviation of the frame's
    colours over the same pixels.

    Args:
        frame: at t.
        other: at t + 1 or later.

    Returns:
        0 for frames of one rigid, dull place; NaN where the two share nothing.
    """
    seen = np.isfinite(frame.depth) & ~frame.excluded
    rays = frame.camera.directions() @ frame.c2w[:3, :3].T
    points = frame.c2w[:3, 3] + np.where(seen, frame.depth, 1.0)[..., None] * rays
    local = (points - other.c2w[:3, 3]) @ other.c2w[:3, :3]
    row, column, inside = nearest_pixels(other.camera, local)
    distance = np.linalg.norm(local, axis=-1)
    same = np.abs(other.depth[row, column] - distance) < SAME * distance
    seen &= inside & same & ~other.excluded[row, column]
    if seen.sum() < LEAST:
        return float("nan")
    moved = bilinear(other.picture, other.camera.project(local[seen]))
    own = frame.picture[seen]
    contrast = np.sqrt(((own - own.mean(0)) ** 2).mean())
    return float(np.sqrt(((own - moved) ** 2).mean()) / max(contrast, 1e-6))  # one colour: 0/0


def bilinear(
    picture: Float[np.ndarray, "h w 3"], pixel: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 3"]:
    """Values between pixel centres, held at the border."""
    height, width = picture.shape[:2]
    x = np.clip(pixel[:, 0] - 0.5, 0, width - 1)
    y = np.clip(pixel[:, 1] - 0.5, 0, height - 1)
    i = np.minimum(x.astype(int), width - 2)
    j = np.minimum(y.astype(int), height - 2)
    u, v = (x - i)[:, None], (y - j)[:, None]
    upper = (1 - u) * picture[j, i] + u * picture[j, i + 1]
    lower = (1 - u) * picture[j + 1, i] + u * picture[j + 1, i + 1]
    return (1 - v) * upper + v * lower
