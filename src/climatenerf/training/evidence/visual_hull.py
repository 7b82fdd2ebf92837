"""Where photos agree that there is nothing: on a ray that ends in the sky, or above the ground.

Nothing stands behind the sky, so every point of a sky ray is empty, whatever else stands about: the
views' sky carves the scene as silhouettes carve a visual hull (Laurentini 1994). Likewise all that
is above the ground on a ray that ends on it. Labels err, so one view's word is not enough.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from climatenerf.core.cameras import Camera
from climatenerf.core.classes import UNKNOWN
from climatenerf.core.device import to_device
from climatenerf.core.morphology import depth_inside, eroded
from climatenerf.ops import visual_hull

VOICES = 64  # views that are asked, at most
WIDEST = 400  # pixels of the maps that they are asked by
REACH = 24  # pixels: within larger footprints nothing is claimed
MIN_VOICES = 2  # views that must agree
APART = 0.1  # of the cameras' spread: neighbouring frames err alike, so they have one voice


class VisualHull:
    """Asks views whether a place is in front of what they label as one of some classes."""

    def __init__(
        self,
        cameras: Sequence[Camera],
        c2w: Float[np.ndarray, "v 4 4"],
        labels: Sequence[UInt8[np.ndarray, "h w"]],
        classes: Sequence[int],
        share: float,
    ):
        """Takes merged classes in the size of each view's camera; c2w in world metres.

        `share`: of the views that have a place in view, those that must show the classes there.
        """
        self.share = share
        labelled = [i for i, label in enumerate(labels) if (label != UNKNOWN).any()]
        chosen = np.unique(np.linspace(0, len(labelled) - 1, VOICES).round().astype(int))
        asked = [labelled[i] for i in chosen]
        maps = [depth_within(cameras[i], np.isin(labels[i], classes)) for i in asked]
        sizes = np.array([each.shape for each, _ in maps], np.int64)
        poses = np.ascontiguousarray(np.asarray(c2w, np.float32)[asked])
        self.views = (
            to_device(np.concatenate([each.astype(np.uint8).ravel() for each, _ in maps])),
            to_device(np.append(0, sizes.prod(1).cumsum()[:-1]).astype(np.int64)),
            to_device(sizes),
            to_device(np.array([pinhole for _, pinhole in maps], np.float32)),
            to_device(poses),
        )
        eyes = poses[:, :3, 3]
        self.apart = APART * float(np.linalg.norm(eyes - eyes.mean(0), axis=-1).mean())

    def consensus(self, x: Float[Tensor, "n 3"], radius: Float[Tensor, "n"]) -> Bool[Tensor, "n"]:
        """Whether enough views see nothing else within `radius` (m) of places x (world m)."""
        least = (MIN_VOICES, self.share, self.apart)
        return visual_hull.label_votes(x, radius, self.views, least)


def depth_within(
    camera: Camera, whole: Bool[np.ndarray, "h w"]
) -> tuple[Float[np.ndarray, "hs ws"], tuple[float, float, float, float]]:
    """How many pixels within a mask each pixel lies, in a small picture without distortion.

    1 at the mask's edge, 0 outside it, at most `REACH`. Also its fx, fy, cx, cy.
    """
    width = min(WIDEST, camera.width)
    small = camera.resized(width, max(1, round(camera.height * width / camera.width)))
    row, column = np.mgrid[: small.height, : small.width] + 0.5
    x, y = (column - small.cx) / small.fx, (row - small.cy) / small.fy
    pixel = camera.project(np.stack([x, y, np.ones_like(x)], axis=-1))
    with np.errstate(invalid="ignore"):
        inside = np.all((pixel >= 0) & (pixel < (camera.width, camera.height)), axis=-1)
    place = np.where(inside[..., None], np.nan_to_num(pixel), 0).astype(np.int64)
    for _ in range(camera.width // width // 2):  # a wire thinner than a small pixel stays
        whole = eroded(whole)
    part = inside & whole[place[..., 1], place[..., 0]]
    depth = np.minimum(depth_inside(part), REACH).astype(np.float32)
    return depth, (small.fx, small.fy, small.cx, small.cy)
