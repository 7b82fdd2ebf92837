"""Intrinsics of the movie's camera: the photographs' field of view, in another size."""

import math

import numpy as np

from climatenerf.core.errors import UserError
from climatenerf.scene import Camera, Scene, View

MAX_OVERSHOOT = 1.5
"""Maximum ratio of a picture's extent to the photographs', for pictures of another shape."""


def fitted_camera(scene: Scene, size: tuple[int, int] | None = None) -> Camera:
    """Return a camera without distortion with the median photograph's field of view.

    If the aspect ratio differs (upright photographs, wide movie), the areas on the image plane are
    equal, but the movie extends at most 1.5 times as far as the photographs: beyond their edges the
    field is unknown.

    Args:
        scene: the capture.
        size: (width, height) in pixels; None takes the median photograph's.
    """
    views = train_views(scene)
    extents = []
    for view in views:
        across, down = half_extent(scene.cameras[view.camera])
        # A photograph from a phone held sideways is rotated by 90 degrees: its sides swap.
        on_side = abs(scene.c2w_world(view)[2, 0]) > math.sqrt(0.5)
        extents.append((down, across) if on_side else (across, down))
    if size is None:
        sizes = [(scene.cameras[v.camera].width, scene.cameras[v.camera].height) for v in views]
        size = max(set(sizes), key=sizes.count)
    return fit_to_size(extents, size)


def fit_to_size(extents: list[tuple[float, float]], size: tuple[int, int]) -> Camera:
    """Return the camera of ``size`` for the median of half extents (see `half_extent`).

    Raises:
        UserError: the size is not positive.
    """
    width, height = size
    check_size(width, height)
    across, down = np.median(np.array(extents), axis=0)
    same_area = math.sqrt(width * height / (4 * across * down))
    filled = max(width / (2 * across), height / (2 * down))
    focal = float(max(same_area, filled / MAX_OVERSHOOT))
    return Camera(width, height, focal, focal, width / 2, height / 2)


def half_extent(camera: Camera) -> tuple[float, float]:
    """Return half width and half height of the undistorted picture at distance 1."""
    w, h = camera.width, camera.height
    middles = np.array([[0, h / 2], [w, h / 2], [w / 2, 0], [w / 2, h]])
    left, right, top, bottom = camera.directions(middles).astype(np.float64)
    # At 55 degrees off axis a perspective picture is stretched threefold: a fisheye is cut there.
    limit = math.radians(55)
    across = (math.atan2(right[0], right[2]) - math.atan2(left[0], left[2])) / 2
    down = (math.atan2(bottom[1], bottom[2]) - math.atan2(top[1], top[2])) / 2
    return math.tan(min(abs(across), limit)), math.tan(min(abs(down), limit))


def train_views(scene: Scene) -> tuple[View, ...]:
    """Return the views that paths are made from: the training split, or all if it is empty."""
    return scene.of_split("train") or scene.views


def check_size(width: int, height: int) -> None:
    """Raise UserError unless width and height, pixels, are positive."""
    if width < 1 or height < 1:
        raise UserError(f"a picture of {width}x{height} pixels cannot be rendered; give --size WxH")
