"""Coarse-to-fine rendering: a sixteenth of a frame's rays, then a quarter, then all.

A ray's result does not depend on the rays beside it, so no ray is traced twice, and the last pass
equals `trace` up to roundings.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.render.integrator import trace
from climatenerf.weather.world import RenderOutput, World, concatenate

SPACINGS = (4, 2, 1)  # rays between traced ones after each pass

Rays = tuple[Tensor, Tensor, Tensor]


def trace_coarse_first(
    world: World,
    rays: Rays,
    width: int,
    show: Callable[[Float[Tensor, "h w 3"]], None],
    cancelled: Callable[[], bool] | None = None,
) -> RenderOutput:
    """`trace` a picture's rays, given row by row, in passes from coarse to fine.

    Args:
        world: field and weather.
        rays: origins (m), unit directions, pixel angles (rad).
        width: rays in a row.
        show: called with each pass's picture in linear radiance. A ray that is not traced yet shows
            the nearest traced one above and left of it.
        cancelled: asked between chunks of rays; see `trace`.
    """
    n, device = rays[0].shape[0], rays[0].device
    index = torch.arange(n, device=device)
    row, column = index // width, index % width
    linear, traced = torch.zeros(n, 3, device=device), torch.zeros_like(index, dtype=torch.bool)
    order, parts = [], []
    for spacing in SPACINGS:
        pending = ((row % spacing == 0) & (column % spacing == 0) & ~traced).nonzero()[:, 0]
        if pending.numel():
            parts.append(trace(world, *(each[pending] for each in rays), cancelled=cancelled))
            order.append(pending)
            linear[pending], traced[pending] = parts[-1].rgb, True
        nearest = row // spacing * spacing * width + column // spacing * spacing
        show(linear[nearest].view(-1, width, 3))
    return concatenate(parts, torch.cat(order).argsort())
