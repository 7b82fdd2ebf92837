"""Whole rays in one launch on a GPU: marching, both networks and compositing. No gradients."""

import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.ops import dispatch
from climatenerf.ops.marching import Cells, Net


def is_available(*tensors: Tensor) -> bool:
    """Return whether `composite` takes these tensors: they must be on an NVIDIA GPU."""
    return dispatch.backend(*tensors) == "triton"


@torch.no_grad()
def composite(
    rays: tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]],
    spans: Float[Tensor, "n 3"],
    cells: Cells,
    steps: tuple[float, float, float],
    limits: tuple[float, float],
    density_net: Net,
    colour_net: Net,
    ray_hidden: Float[Tensor, "n h"],
) -> Float[Tensor, "n 5"]:
    """March and composite rays, where `is_available`; elsewhere compose the separate operations.

    Args:
        rays, spans, cells, steps, density_net: as `marching.march` takes them.
        limits: transmittance at which a ray ends; weight from which a sample's colour is evaluated.
        colour_net: encoding and network of the appearance.
        ray_hidden: what each ray adds to the hidden layer of the colours.

    Returns:
        Linear radiance, weighted sum of ray lengths (grid units), transmittance.
    """
    from climatenerf.ops.triton import fused_render as triton

    out = spans.new_empty(spans.shape[0], 5)
    triton.composite(
        dispatch.kernel_arrays(*rays),
        dispatch.kernel_array(spans),
        dispatch.kernel_arrays(*cells),
        steps,
        limits,
        dispatch.kernel_arrays(*density_net),
        dispatch.kernel_arrays(*colour_net),
        *dispatch.kernel_arrays(ray_hidden, out),
    )
    return out
