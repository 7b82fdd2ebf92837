"""Votes of label masks, slow and obvious: the specification and test oracle of `visual_hull`."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def label_votes(
    x: Float[Tensor, "n 3"],
    radius: Float[Tensor, "n"],
    masks: list[Tensor],
    pinholes: Float[Tensor, "v 4"],
    c2w: Float[Tensor, "v 4 4"],
    thresholds: tuple[int, float, float],
) -> Bool[Tensor, "n"]:
    """Return for which balls enough views agree that only a mask (sky, or ground) lies behind.

    Args:
        x: centres of the balls, world m.
        radius: of the balls, m.
        masks: depth inside each view's mask: pixels to its edge, 1 at the edge, 0 outside.
        pinholes: fx, fy, cx, cy of the masks.
        c2w: poses of the views.
        thresholds: minimum number of votes; minimum fraction of the views whose picture contains
            the centre; minimum baseline (m) between the first voting view and another one.
    """
    voted, observed = [], []
    for mask, (fx, fy, cx, cy), pose in zip(masks, pinholes, c2w, strict=True):
        height, width = mask.shape
        local = (x - pose[:3, 3]) @ pose[:3, :3]
        z = local[:, 2]
        z = torch.where(z > radius, z, torch.nan)  # the ball must lie in front of the camera
        column = (fx * local[:, 0] / z + cx).floor()
        row = (fy * local[:, 1] / z + cy).floor()
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        pixel = torch.stack([row, column]).where(inside, 0.0).long()
        depth = mask[pixel[0], pixel[1]]
        observed.append(inside)
        voted.append(inside & (depth >= 1) & (depth - 1 >= radius * torch.maximum(fx, fy) / z))
    votes, centres = torch.stack(voted), c2w[:, :3, 3]
    first = centres[votes.float().argmax(0)]  # of the first vote, or any view where there is none
    far_apart = (centres[:, None] - first).norm(dim=-1) > thresholds[2]
    wide = (votes & far_apart).any(0)
    count = votes.sum(0)
    enough = count >= thresholds[1] * torch.stack(observed).sum(0)
    return wide & (count >= thresholds[0]) & enough
