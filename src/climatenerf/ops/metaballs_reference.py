"""Metaball sums, slow and obvious: the specification and test oracle of `ops.cpu.metaballs`."""

import math

import torch
from jaxtyping import Float
from torch import Tensor


def metaball_kernel(r: Float[Tensor, "*n"], radius: float) -> Float[Tensor, "*n"]:
    """Return the metaball kernel of compact support (ClimateNeRF, after van der Laan's SPH one).

    K(r, R) = 315 / (64 pi 1.5^7) (1.5^2 - (r/R)^2)^3 for r < 1.5 R and 0 beyond, so that value,
    first and second derivative vanish at the edge of the support.

    Args:
        r: distance from the ball's centre, m.
        radius: R, m.

    Returns:
        The kernel, without unit; 1.044 at the centre.
    """
    inside = (1.5**2 - (r / radius) ** 2).clamp(min=0)
    return 315 / (64 * math.pi * 1.5**7) * inside**3


def metaball_sums(
    points: Float[Tensor, "n 3"],
    fractions: Float[Tensor, "x y z"],
    values: Float[Tensor, "x y z c"],
    origin: Float[Tensor, "3"],
    spacing: float,
    radius: float,
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n c"]]:
    """Return the normalised metaball sum of a lattice and the kernel-weighted mean of values on it.

    s(x) = sum_v f_v K(|x - x_v|) / sum_v K(|x - x_v|) over *all* vertices v; outside of its support
    the kernel is 0. The quotient is exactly 1 in a filled region, wherever the lattice lies.
    Mean: sum_v f_v K a_v / sum_v f_v K.

    Args:
        points: positions, m, at least 1.5 radius inside the lattice.
        fractions: f_v, filled fraction of each vertex's surroundings, 0 to 1.
        values: a_v, the quantities to average.
        origin: position of vertex (0, 0, 0), m.
        spacing: lattice spacing, m.
        radius: R of the kernel, m.

    Returns:
        s and the means, which are 0 where no vertex within the support is filled.
    """
    steps = [torch.arange(n, dtype=points.dtype, device=points.device) for n in fractions.shape]
    axes = [origin[i] + spacing * each for i, each in enumerate(steps)]
    vertices = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    # Squared distances: the root's gradient at 0 would be NaN.
    squared = ((points[:, None] - vertices) ** 2).sum(-1)
    inside = (1.5**2 - squared / radius**2).clamp(min=0)
    kernel = 315 / (64 * math.pi * 1.5**7) * inside**3
    filled = kernel * fractions.reshape(-1)
    total = filled.sum(-1)
    # Outside all supports 0 / 0 would give NaN.
    means = filled @ values.reshape(-1, values.shape[-1]) / total.clamp(min=1e-12)[:, None]
    return total / kernel.sum(-1), means
