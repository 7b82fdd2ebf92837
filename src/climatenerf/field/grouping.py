"""Samples of a ray that lie close together, to look up once what they share."""

import torch
from jaxtyping import Float, Int
from torch import Tensor


def shared_lookups(
    x: Float[Tensor, "s 3"], d: Float[Tensor, "n 3"], ray: Int[Tensor, "s"], length: float
) -> tuple[Int[Tensor, "g"], Int[Tensor, "s"]]:
    """Group the samples of each ray that lie within `length` (m) of each other.

    Args:
        x: positions, sorted by ray and by depth.
        d: unit directions of the rays.
        ray: of each sample.
        length: of the pieces of a ray, m.

    Returns:
        The index of each group's middle sample, and the group of each sample.
    """
    cell = ((x * d[ray]).sum(-1) / length).floor()
    first = torch.ones_like(ray, dtype=torch.bool)
    first[1:] = (cell[1:] != cell[:-1]) | (ray[1:] != ray[:-1])
    start = first.nonzero()[:, 0]
    end = torch.cat([start[1:], start.new_tensor([len(ray)])])
    return (start + end - 1) // 2, first.cumsum(0) - 1
