"""Label votes for positions by views of known pose. No gradients."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from climatenerf.ops import dispatch, reference

Views = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
"""Maps of some views in one row (8 bits), where each starts, sizes (rows, columns), fx fy cx cy,
c2w."""


def label_votes(
    x: Float[Tensor, "n 3"],
    radius: Float[Tensor, "n"],
    views: Views,
    least: tuple[int, float, float],
) -> Bool[Tensor, "n"]:
    """See `reference.label_votes`."""
    kernels = dispatch.kernels("visual_hull", x, radius, *views)
    if kernels is None:
        reach, starts, sizes, pinholes, c2w = views
        corners = zip(starts.tolist(), sizes.tolist(), strict=True)
        maps = [reach[start : start + h * w].view(h, w) for start, (h, w) in corners]
        return reference.label_votes(x, radius, maps, pinholes, c2w, least)
    agreed = torch.empty_like(radius, dtype=torch.uint8)
    given = (
        dispatch.kernel_array(x),
        dispatch.kernel_array(radius),
        tuple(map(dispatch.kernel_array, views)),
        least,
    )
    kernels.label_votes(*given, dispatch.kernel_array(agreed))
    return agreed.bool()
