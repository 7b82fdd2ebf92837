"""Space carving from class labels: a visual hull (Laurentini 1994).

Every point of a ray that ends in the sky is empty. The sky labels of all views therefore carve the
scene as silhouettes carve a visual hull. Likewise, all space in front of the ground on a ray that
ends on the ground is empty. Labels contain errors, so a point counts as carved only by consensus:
enough views must vote for it, and their cameras must be a minimum baseline apart.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from climatenerf.core.cameras import Camera
from climatenerf.core.classes import UNKNOWN
from climatenerf.core.device import CPU, to_device
from climatenerf.core.morphology import depth_inside, eroded
from climatenerf.ops import visual_hull

MAX_VIEWS = 64  # views that vote, evenly spaced in the list of labelled views
MAX_MAP_WIDTH = 400  # px, width of the label maps that are looked up
MAX_FOOTPRINT = 24  # px of such a map; a ball with a larger projected radius gets no vote
MIN_VOTES = 2
BASELINE_FRACTION = 0.1
"""Minimum baseline, as a fraction of the cameras' mean distance from their centroid. Neighbouring
frames repeat each other's label errors, so they count as one vote."""


class VisualHull:
    """Volume that the labels of several views agree to lie in front of some classes."""

    def __init__(
        self,
        cameras: Sequence[Camera],
        c2w: Float[np.ndarray, "v 4 4"],
        labels: Sequence[UInt8[np.ndarray, "h w"]],
        classes: Sequence[int],
        min_fraction: float,
        device: torch.device = CPU,
    ):
        """Build the label maps that vote.

        Args:
            cameras: Of each view.
            c2w: Camera poses, world m, OpenCV axes.
            labels: Merged classes of each view, in the size of its camera; at least one view must
                have a known label.
            classes: Merged classes that carve: whatever lies in front of them is empty.
            min_fraction: Votes needed, as a fraction of the views whose image contains the point.
            device: Where the maps are stored.
        """
        self.min_fraction = min_fraction
        labelled = [i for i, label in enumerate(labels) if (label != UNKNOWN).any()]
        rows = np.unique(np.linspace(0, len(labelled) - 1, MAX_VIEWS).round().astype(int))
        voting = [labelled[i] for i in rows]
        maps = [border_distance(cameras[i], np.isin(labels[i], classes)) for i in voting]
        sizes = np.array([each.shape for each, _ in maps], np.int64)
        poses = np.ascontiguousarray(np.asarray(c2w, np.float32)[voting])
        arrays = (
            np.concatenate([each.astype(np.uint8).ravel() for each, _ in maps]),
            np.append(0, sizes.prod(1).cumsum()[:-1]).astype(np.int64),
            sizes,
            np.array([pinhole for _, pinhole in maps], np.float32),
            poses,
        )
        depth, starts, sides, pinholes, c2w_maps = (to_device(each, device) for each in arrays)
        self.views = depth, starts, sides, pinholes, c2w_maps
        centres = poses[:, :3, 3]
        spread = float(np.linalg.norm(centres - centres.mean(0), axis=-1).mean())
        self.min_baseline = BASELINE_FRACTION * spread

    def consensus(self, x: Float[Tensor, "n 3"], radius: Float[Tensor, "n"]) -> Bool[Tensor, "n"]:
        """Return which balls the views agree to be empty.

        A view votes for a ball if its whole projection falls on the hull's classes. Consensus
        needs `MIN_VOTES` votes, votes of the fraction `min_fraction` of the views whose image
        contains the centre, and two votes of cameras more than `min_baseline` apart (see
        `visual_hull_reference.label_votes`).

        Args:
            x: Ball centres, world m.
            radius: Ball radii, m.
        """
        needed = (MIN_VOTES, self.min_fraction, self.min_baseline)
        return visual_hull.label_votes(x, radius, self.views, needed)


def border_distance(
    camera: Camera, mask: Bool[np.ndarray, "h w"]
) -> tuple[Float[np.ndarray, "hs ws"], tuple[float, float, float, float]]:
    """Return each pixel's distance to the border of a mask, in a small undistorted image.

    The distance is the chessboard distance in pixels of the small image: 1 for the mask's outermost
    pixels, 0 outside the mask, at most `MAX_FOOTPRINT`. Outside the image the mask is unset.

    Args:
        camera: The camera of the mask, which may have lens distortion.
        mask: In the size of the camera.

    Returns:
        The distances, and fx, fy, cx, cy (px) of the small pinhole image.
    """
    width = min(MAX_MAP_WIDTH, camera.width)
    small = camera.resized(width, max(1, round(camera.height * width / camera.width)))
    row, column = np.mgrid[: small.height, : small.width] + 0.5
    x, y = (column - small.cx) / small.fx, (row - small.cy) / small.fy
    pixel = camera.project(np.stack([x, y, np.ones_like(x)], axis=-1))
    with np.errstate(invalid="ignore"):
        inside = np.all((pixel >= 0) & (pixel < (camera.width, camera.height)), axis=-1)
    source = np.where(inside[..., None], np.nan_to_num(pixel), 0).astype(np.int64)
    # Erode before downsampling, so that a wire thinner than a small pixel stays in the map.
    for _ in range(camera.width // width // 2):
        mask = eroded(mask)
    part = inside & mask[source[..., 1], source[..., 0]]
    distance = np.minimum(depth_inside(part), MAX_FOOTPRINT).astype(np.float32)
    return distance, (small.fx, small.fy, small.cx, small.cy)
