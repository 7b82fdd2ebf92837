"""View frusta: which space any camera sees, and which space lies too close in front of one.

Photos hold no information about space outside every frustum. Density that grows there only shadows
the ground and darkens reflections, so that space is culled, as in Instant-NGP (Müller et al. 2022).
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from climatenerf.core.cameras import Camera
from climatenerf.core.device import CPU, to_device

CHUNK = 800_000  # distances between balls and views computed at once, to fit into the cache
BORDER_SAMPLES = 64  # points along each side of an image from which its frustum is found
MIN_COSINE = 0.1  # from the optical axis; a view with wider rays has no frustum and sees everything


def frustum_planes(
    cameras: Sequence[Camera], c2w: Float[np.ndarray, "v 4 4"], device: torch.device = CPU
) -> Float[Tensor, "v 4 4"]:
    """Return the four side planes of each view's frustum; the frustum starts at the camera centre.

    Args:
        cameras: Of each view. Where lens distortion bends the image border, the frustum encloses
            the border.
        c2w: Camera poses, world m, OpenCV axes.
        device: Where the planes are stored.

    Returns:
        Per view four rows (unit normal, offset): normal . x + offset is the distance (m) of x
        outside the plane. For a view too wide for a frustum, planes that contain all space.
    """
    planes = []
    for camera, pose in zip(cameras, np.asarray(c2w, np.float64), strict=True):
        along = np.linspace(0, 1, BORDER_SAMPLES)
        ends = np.stack([np.zeros(BORDER_SAMPLES), np.ones(BORDER_SAMPLES)])
        x, y = np.append(along[None].repeat(2, 0), ends), np.append(ends, along[None].repeat(2, 0))
        d = camera.directions(np.stack([x * camera.width, y * camera.height], axis=-1))
        if d[:, 2].min() < MIN_COSINE:
            planes.append(np.array([[0.0, 0.0, 0.0, -1e9]] * 4))
            continue
        slope = d[:, :2] / d[:, 2:]
        (left, top), (right, bottom) = slope.min(0), slope.max(0)
        outward = np.array([[-1, 0, left], [1, 0, -right], [0, -1, top], [0, 1, -bottom]])
        outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
        normal = outward @ pose[:3, :3].T
        planes.append(np.concatenate([normal, -normal @ pose[:3, 3:]], axis=-1))
    return to_device(np.stack(planes).astype(np.float32), device)


def intersects_frustum(
    x: Float[Tensor, "n 3"], radius: Float[Tensor, "n"], frusta: Float[Tensor, "v 4 4"]
) -> Bool[Tensor, "n"]:
    """Return which balls intersect the frustum of any view.

    Args:
        x: Ball centres, world m.
        radius: Ball radii, m.
        frusta: From `frustum_planes`.
    """
    found, size = [], max(256, CHUNK // frusta.shape[0])
    for centres, radii in zip(x.split(size), radius.split(size), strict=True):
        outside = x.new_full((centres.shape[0], frusta.shape[0]), -torch.inf)
        for side in frusta.unbind(1):
            outside = torch.maximum(outside, centres @ side[:, :3].T + side[:, 3])
        found.append(outside.amin(-1) < radii)
    return torch.cat(found)


def within_camera_range(
    x: Float[Tensor, "n 3"],
    radius: Float[Tensor, "n"],
    frusta: Float[Tensor, "v 4 4"],
    camera_centres: Float[Tensor, "v 3"],
    max_distance: Float[Tensor, "v"],
) -> Bool[Tensor, "n"]:
    """Return which balls lie wholly closer to a view's camera than a distance, centres in view.

    Args:
        x: Ball centres, world m.
        radius: Ball radii, m.
        frusta: From `frustum_planes`.
        camera_centres: Of each view, world m.
        max_distance: Of each view, m; 0 excludes the view.
    """
    found = x.new_zeros(x.shape[0], dtype=torch.bool)
    low = (camera_centres - max_distance[:, None]).amin(0)
    high = (camera_centres + max_distance[:, None]).amax(0)
    near = ((x > low) & (x < high)).all(-1).nonzero()[:, 0]
    for rows in near.split(max(256, CHUNK // frusta.shape[0])):
        centres = x[rows]
        farthest = (centres[:, None] - camera_centres).norm(dim=-1) + radius[rows, None]
        outside = farthest - max_distance
        for side in frusta.unbind(1):
            outside = torch.maximum(outside, centres @ side[:, :3].T + side[:, 3])
        found[rows] = outside.amin(-1) < 0
    return found
