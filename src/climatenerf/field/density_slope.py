"""Normals from finite differences of the density, which have gradients to it."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.core.vectors import unit
from climatenerf.ops.reference import contract


def finite_difference_normal(
    raw_density: Callable[[Float[Tensor, "s 3"]], Float[Tensor, "s"]],
    q: Float[Tensor, "n 3"],
    step: Float[Tensor, "n"],
) -> Float[Tensor, "n 3"]:
    """Return unit vectors against the density's slope, with gradients to the density.

    Four densities at the corners of a tetrahedron give the slope; 0 where they are equal.

    Args:
        raw_density: logarithm of the density per contracted length, at unit-cube coordinates.
        q: positions, grid units.
        step: half the edge of the cube around each tetrahedron, grid units.
    """
    k = torch.arange(4, device=q.device)
    x, y = 1.0 - 2.0 * (k // 2), 1.0 - 2.0 * (k % 2)
    corners = torch.stack([x, y, x * y], dim=-1)
    around = q[:, None] + step[:, None, None] * corners
    flat = around.reshape(-1, 3)
    # Density per contracted length, to density per length: see `reference.density`.
    contraction = flat.square().sum(-1).clamp_min(1.0).log()
    raw = (raw_density(contract(flat)) - contraction).view(-1, 4, 1)
    # 1e-6: where the density is constant the gradient of its direction would be NaN.
    return -unit((raw * corners).sum(1), 1e-6)
