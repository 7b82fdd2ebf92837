"""What cameras have in view at all, and what is so near before one that it would be in its way.

Of space outside every picture the photos say nothing. Matter that grows there only shelters the
ground and blackens reflections, so it is left empty (as Instant-NGP does: Müller et al. 2022).
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from climatenerf.core.cameras import Camera
from climatenerf.core.device import to_device

AT_ONCE = 800_000  # distances between places and views that fit into the cache
BORDER = 64  # points along each side of a picture from which its pyramid of sight is found
WIDE = 0.1  # least cosine from the axis that fits into a pyramid; beyond it all counts as in view


def frustum_planes(
    cameras: Sequence[Camera], c2w: Float[np.ndarray, "v 4 4"]
) -> Float[Tensor, "v 4 4"]:
    """The four sides of each view's pyramid of sight, as planes.

    Args:
        cameras: of each view; where distortion bends the picture's border, the pyramid holds it.
        c2w: poses, world metres.

    Returns:
        Rows (unit normal, offset) with normal . x + offset = metres outside; of a view too wide
        for a pyramid, planes that have everything inside.
    """
    planes = []
    for camera, pose in zip(cameras, np.asarray(c2w, np.float64), strict=True):
        along = np.linspace(0, 1, BORDER)
        ends = np.stack([np.zeros(BORDER), np.ones(BORDER)])
        x, y = np.append(along[None].repeat(2, 0), ends), np.append(ends, along[None].repeat(2, 0))
        d = camera.directions(np.stack([x * camera.width, y * camera.height], axis=-1))
        if d[:, 2].min() < WIDE:
            planes.append(np.array([[0.0, 0.0, 0.0, -1e9]] * 4))
            continue
        slope = d[:, :2] / d[:, 2:]
        (left, top), (right, bottom) = slope.min(0), slope.max(0)
        outward = np.array([[-1, 0, left], [1, 0, -right], [0, -1, top], [0, 1, -bottom]])
        outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
        normal = outward @ pose[:3, :3].T
        planes.append(np.concatenate([normal, -normal @ pose[:3, 3:]], axis=-1))
    return to_device(np.stack(planes).astype(np.float32))


def intersects_frustum(
    x: Float[Tensor, "n 3"], radius: Float[Tensor, "n"], views: Float[Tensor, "v 4 4"]
) -> Bool[Tensor, "n"]:
    """Whether balls about x (world m) with a radius (m) reach into any view's pyramid of sight."""
    found, some = [], max(256, AT_ONCE // views.shape[0])
    for place, reach in zip(x.split(some), radius.split(some), strict=True):
        outside = torch.full((place.shape[0], views.shape[0]), -torch.inf)
        for side in views.unbind(1):
            outside = torch.maximum(outside, place @ side[:, :3].T + side[:, 3])
        found.append(outside.amin(-1) < reach)
    return torch.cat(found)


def within_camera_range(
    x: Float[Tensor, "n 3"],
    radius: Float[Tensor, "n"],
    views: Float[Tensor, "v 4 4"],
    eyes: Float[Tensor, "v 3"],
    reach: Float[Tensor, "v"],
) -> Bool[Tensor, "n"]:
    """Whether balls are wholly within a view's reach (m) of its eye, their middles in view."""
    found = torch.zeros(x.shape[0], dtype=torch.bool)
    low, high = (eyes - reach[:, None]).amin(0), (eyes + reach[:, None]).amax(0)
    near = ((x > low) & (x < high)).all(-1).nonzero()[:, 0]
    for some in near.split(max(256, AT_ONCE // views.shape[0])):
        place, own = x[some], radius[some, None]
        beyond = (place[:, None] - eyes).norm(dim=-1) + own - reach
        for side in views.unbind(1):
            beyond = torch.maximum(beyond, place @ side[:, :3].T + side[:, 3])
        found[some] = beyond.amin(-1) < 0
    return found
