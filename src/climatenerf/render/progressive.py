"""A frame that shows early: a sixteenth of its rays all over it, then a quarter, then all.

What a ray sees does not depend on the rays beside it, so none is traced twice, and what is seen in
the end is what `trace` sees, but for roundings.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.render.integrator import RenderOutput, trace
from climatenerf.weather.world import World, concatenate

SPACINGS = (4, 2, 1)  # rays between those that are known after each pass

Rays = tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"], Float[Tensor, "n"], Float[Tensor, "n"]]


def trace_coarse_first(
    world: World, rays: Rays, width: int, show: Callable[[Float[Tensor, "h w 3"]], None]
) -> RenderOutput:
    """`trace` of a picture's rays, row by row, coarse ones first.

    Args:
        world: field and weather.
        rays: origins (m), unit directions, pixel angles and rolls, as `trace` takes them.
        width: rays in a row.
        show: called with each pass's picture in linear light, the last but for roundings complete.
            A ray that is not known yet shows the nearest known one above and left of it.
    """
    n = rays[0].shape[0]
    row, column = torch.arange(n) // width, torch.arange(n) % width
    linear, known = torch.zeros(n, 3), torch.zeros(n, dtype=torch.bool)
    order, parts = [], []
    for spacing in SPACINGS:
        some = ((row % spacing == 0) & (column % spacing == 0) & ~known).nonzero()[:, 0]
        if some.numel():
            parts.append(trace(world, *(each[some] for each in rays)))
            order.append(some)
            linear[some], known[some] = parts[-1].rgb, True
        nearest = row // spacing * spacing * width + column // spacing * spacing
        show(linear[nearest].view(-1, width, 3))
    return concatenate(parts, torch.cat(order).argsort())
