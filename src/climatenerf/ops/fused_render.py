"""Whole rays in one launch on a GPU: marching, both networks and compositing. No gradients."""

import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.ops import dispatch
from climatenerf.ops.marching import Cells, Net


def takes_whole_rays(*tensors: Tensor) -> bool:
    """Whether these are on a GPU, as `composite` wants them."""
    return dispatch.backend(*tensors) == "triton"


@torch.no_grad()
def composite(
    rays: tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]],
    spans: Float[Tensor, "n 3"],
    cells: Cells,
    steps: tuple[float, float, float],
    limits: tuple[float, float],
    net: Net,
    colours: tuple[Net, Float[Tensor, "n h"]],
) -> Float[Tensor, "n 5"]:
    """Whole rays in one launch, where `takes_whole_rays`; elsewhere march and composite.

    Args:
        rays, spans, cells, steps, net: as those of `march`.
        limits: transmittance at which a ray ends, weight from which a sample has a colour.
        colours: encoding and network of the appearance, and what is added to its hidden layer.

    Returns:
        Linear radiance of matter, weighted sum of ray lengths (grid units), transmittance.
    """
    from climatenerf.ops.triton import fused_render as triton

    looks, shared = colours
    out = spans.new_empty(spans.shape[0], 5)
    weights = tuple(map(dispatch.kernel_array, net)), tuple(map(dispatch.kernel_array, looks))
    given = (
        tuple(map(dispatch.kernel_array, rays)),
        dispatch.kernel_array(spans),
        tuple(map(dispatch.kernel_array, cells)),
    )
    triton.composite(
        *given, steps, limits, *weights, dispatch.kernel_array(shared), dispatch.kernel_array(out)
    )
    return out
