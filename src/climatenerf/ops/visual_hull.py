"""Votes of label masks on positions in space. No gradients."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from climatenerf.ops import dispatch, visual_hull_reference

Views = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
"""Views with their masks: depths inside the masks (uint8, all views in one flat list), start of
each view in it, sizes (rows, columns), pinholes (fx, fy, cx, cy), c2w."""


def label_votes(
    x: Float[Tensor, "n 3"],
    radius: Float[Tensor, "n"],
    views: Views,
    thresholds: tuple[int, float, float],
) -> Bool[Tensor, "n"]:
    """Return on which balls the views' masks agree: `visual_hull_reference.label_votes`."""
    kernels = dispatch.kernels("visual_hull", x, radius, *views)
    if kernels is None:
        depth, starts, sizes, pinholes, c2w = views
        corners = zip(starts.tolist(), sizes.tolist(), strict=True)
        masks = [depth[start : start + h * w].view(h, w) for start, (h, w) in corners]
        return visual_hull_reference.label_votes(x, radius, masks, pinholes, c2w, thresholds)
    consensus = torch.empty_like(radius, dtype=torch.uint8)
    x_array, radius_array, consensus_array = dispatch.kernel_arrays(x, radius, consensus)
    kernels.label_votes(
        x_array, radius_array, dispatch.kernel_arrays(*views), thresholds, consensus_array
    )
    return consensus.bool()
