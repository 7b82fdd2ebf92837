"""Irradiance of surfaces from a grid of light probes. No gradients.

A probe has the coefficients of irradiance in spherical harmonics of degree 2. The eight probes
around a position are averaged; those inside matter do not count, unless all are, and those behind
the surface count little: they see what is on its other side. Beyond the grid its border counts.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from climatenerf.ops import dispatch

TERMS = 9
MIN_WEIGHT = 1e-6  # sum of weights
BEHIND = 0.02  # weight of a probe straight behind the surface; one straight before it has 1.02


@dataclass(frozen=True)
class ProbeGrid:
    """Where probes are: an upright grid of nodes, x fastest.

    Attributes:
        origin: the lowest corner, world m.
        spacing: distances of neighbours along the axes, m.
        shape: number of nodes along x, y and z; 2 at least.
        valid: nodes outside matter and above the ground; the others have the light of the nearest
            of these.
    """

    origin: Float[Tensor, "3"]
    spacing: Float[Tensor, "3"]
    shape: tuple[int, int, int]
    valid: Bool[Tensor, "p"]


def irradiance(
    grid: ProbeGrid,
    tables: tuple[Float[Tensor, "p 9 3"], ...],
    x: Float[Tensor, "n 3"],
    normal: Float[Tensor, "n 3"],
    basis: Float[Tensor, "9 n"],
) -> tuple[Float[Tensor, "n 3"], ...]:
    """Irradiance of surfaces at positions (world m) with unit normals, for each table.

    `basis` has the spherical harmonics of the normals.
    """
    if dispatch.backend(x, normal, *tables) == "cpu":
        from climatenerf.ops.cpu import probes as kernel

        rows = torch.cat(tables, dim=-1).flatten(1)
        found = torch.empty(x.shape[0], 3 * len(tables), device=x.device)
        places = dispatch.kernel_array(x), dispatch.kernel_array(normal)
        nodes = dispatch.kernel_array(grid.origin), dispatch.kernel_array(grid.spacing)
        kernel.irradiance(
            places[0],
            places[1],
            dispatch.kernel_array(basis),
            nodes[0],
            nodes[1],
            grid.shape,
            dispatch.kernel_array(grid.valid),
            dispatch.kernel_array(rows),
            dispatch.kernel_array(found),
        )
        return found.split(3, dim=-1)
    return tuple(
        torch.einsum("tn,ntc->nc", basis, interpolated(grid, table, x, normal)).clamp_min(0)
        for table in tables
    )


def interpolated(
    grid: ProbeGrid,
    coefficients: Float[Tensor, "p 9 3"],
    x: Float[Tensor, "n 3"],
    normal: Float[Tensor, "n 3"],
) -> Float[Tensor, "n 9 3"]:
    """Coefficients at positions (world m), slow and obvious."""
    size = torch.tensor(grid.shape, device=x.device)
    place = ((x - grid.origin) / grid.spacing).clamp_min(0)
    place = torch.minimum(place, (size - 1).to(place) - 1e-4)
    corner = place.long()
    fraction = place - corner
    total = torch.zeros(2, x.shape[0], TERMS, 3, dtype=x.dtype, device=x.device)
    weights = torch.zeros(2, x.shape[0], dtype=x.dtype, device=x.device)
    for k in range(8):
        step = torch.tensor([k & 1, k >> 1 & 1, k >> 2 & 1], device=x.device)
        node = corner + step
        index = (node[:, 2] * grid.shape[1] + node[:, 1]) * grid.shape[0] + node[:, 0]
        weight = torch.where(step == 1, fraction, 1 - fraction).prod(-1)
        towards = grid.origin + node * grid.spacing - x
        facing = (towards * normal).sum(-1) / towards.norm(dim=-1).clamp_min(1e-6)
        weight = weight * (((facing + 1) / 2).square() + BEHIND)
        for every, counts in enumerate((grid.valid[index], torch.ones_like(grid.valid[index]))):
            total[every] += (counts * weight)[:, None, None] * coefficients[index]
            weights[every] += counts * weight
    every = (weights[0] <= MIN_WEIGHT).long()  # no probe outside matter counts
    rows = torch.arange(x.shape[0], device=x.device)
    return total[every, rows] / weights[every, rows][:, None, None]
