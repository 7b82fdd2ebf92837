"""Ground height: one height per horizontal position, fitted to the sparse points labelled ground.

Distant lawns and roads look alike at any height: at grazing angles an error of some decimetres
hardly moves a pixel, but snow, water and smog make it visible. Sparse points are few but accurate,
and ground bends little between them. The fitted height therefore determines where rays labelled
ground should end.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from climatenerf.core.device import to_device

GRID_NODES = 33  # nodes of the height grid along a side
HALF_SIDE = 4.0  # grid units, from the scene's centre to the grid's border
MIN_POINTS, MAX_POINTS = 50, 6000  # for a fit; of more points an even subset is used
VALID_RADIUS = 0.5  # grid units around a point within which the height is valid
CREST_NODES = 2  # a ball must be above all nodes within this many of it
FINE_CELLS = 64  # cells along a side of the finer grid that marks where points support the height
BENDING_WEIGHT = 0.05  # of the bending energy against the points' mean absolute residual
ITERATIONS = 15  # of iteratively reweighted least squares
MIN_RESIDUAL = 2e-3  # grid units; bounds the weight 1/residual of a point on the surface
MIN_TOLERANCE = 7.5e-3  # grid units; kerbs and tufts of grass that the grid cannot resolve
TOLERANCE_FACTOR = 2.0  # tolerance over the 0.9 quantile of the points' residuals


@dataclass(frozen=True)
class GroundHeight:
    """Height of the ground on a square grid about the scene's centre; lengths in grid units."""

    height: Float[Tensor, "nodes nodes"]
    """Height at the grid's nodes; rows along y."""
    valid: Bool[Tensor, "nodes nodes"]
    """Nodes within `VALID_RADIUS` of a point."""
    supported: Bool[Tensor, "cells cells"]
    """Cells of a finer grid that contain a point or adjoin a cell that does; rows along y."""
    tolerance: float
    """Largest difference between the ground and `height` that is not an error."""

    def is_above_crests(
        self, q: Float[Tensor, "n 3"], radius: Float[Tensor, "n"]
    ) -> Bool[Tensor, "n"]:
        """Return which balls are above all ground nearby, so that no crest can hide them.

        False in cells without support: between points the height may miss a step.

        Args:
            q: Ball centres, grid units.
            radius: Ball radii, grid units.
        """
        highest = torch.nn.functional.max_pool2d(
            self.height[None], 2 * CREST_NODES + 1, stride=1, padding=CREST_NODES
        )[0]
        node, fraction = _cells(q)
        x, y = (node + (fraction > 0.5)).unbind(-1)
        inside = (q[:, :2].abs() < HALF_SIDE).all(-1)
        above = q[:, 2] - radius > highest[y, x] + self.tolerance
        x, y = _fine_cells(q)
        return inside & above & self.supported[y, x]

    def height_above(self, q: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n"], Bool[Tensor, "n"]]:
        """Return the signed height of positions above the ground, and whether it is valid there.

        Args:
            q: Positions, grid units; beyond the grid the ground continues its border.

        Returns:
            Heights, grid units; and whether the nearest node is valid.
        """
        scaled = q[:, :2] / HALF_SIDE
        height = torch.nn.functional.grid_sample(
            self.height[None, None], scaled[None, None], padding_mode="border", align_corners=True
        )[0, 0, 0]
        nearest = ((scaled + 1) * ((GRID_NODES - 1) / 2)).round().long()
        x, y = nearest.clamp(0, GRID_NODES - 1).unbind(-1)
        return q[:, 2] - height, (scaled.abs() < 1).all(-1) & self.valid[y, x]


def fit_ground_height(q: Float[Tensor, "n 3"]) -> GroundHeight | None:
    """Fit a thin plate to points of the ground.

    Minimise the mean absolute residual of the points plus `BENDING_WEIGHT` times the thin plate's
    bending energy, by iteratively reweighted least squares. Absolute residuals, because some points
    labelled ground are not.

    Args:
        q: Points labelled ground, grid units.

    Returns:
        None if fewer than `MIN_POINTS` points lie inside the grid.
    """
    q = q[(q[:, :2].abs() < HALF_SIDE).all(-1)]
    if q.shape[0] < MIN_POINTS:
        return None
    q = q[:: -(-q.shape[0] // MAX_POINTS)]
    n, size = q.shape[0], GRID_NODES * GRID_NODES
    # Each point involves the four nodes of its cell only.
    corners = list(_corners(*_cells(q)))
    node = torch.stack([y * GRID_NODES + x for x, y, _ in corners], dim=-1)
    bilinear = torch.stack([weight for _, _, weight in corners], dim=-1).double()
    pairs = (node[:, :, None] * size + node[:, None, :]).view(-1)
    products = bilinear[:, :, None] * bilinear[:, None, :]
    bending = _bending_energy(q.device)
    z = q[:, 2].double()
    median = z.median()
    weight = torch.ones_like(z) / n
    height = z.new_zeros(size)
    for _ in range(ITERATIONS):
        normal = z.new_zeros(size * size)
        normal.index_add_(0, pairs, (weight[:, None, None] * products).view(-1))
        target = z.new_zeros(size)
        target.index_add_(0, node.view(-1), ((weight * (z - median))[:, None] * bilinear).view(-1))
        height = torch.linalg.solve(normal.view(size, size) + bending, target)
        residual = ((bilinear * height[node]).sum(-1) + median - z).abs()
        weight = 1 / (residual.clamp_min(MIN_RESIDUAL) * n)
    line = np.linspace(-HALF_SIDE, HALF_SIDE, GRID_NODES, dtype=np.float32)
    line = to_device(line, q.device)
    nodes = torch.stack(torch.meshgrid(line, line, indexing="xy"), dim=-1).view(-1, 2)
    nearest = torch.cdist(nodes, q[:, :2]).amin(-1)
    return GroundHeight(
        height=(height + median).float().view(GRID_NODES, GRID_NODES),
        valid=(nearest < VALID_RADIUS).view(GRID_NODES, GRID_NODES),
        supported=_supported_cells(q),
        tolerance=max(MIN_TOLERANCE, TOLERANCE_FACTOR * float(residual.quantile(0.9))),
    )


def _supported_cells(q: Float[Tensor, "n 3"]) -> Bool[Tensor, "cells cells"]:
    """Return the cells of the finer grid that contain a point, and their neighbours."""
    count = q.new_zeros(FINE_CELLS, FINE_CELLS)
    x, y = _fine_cells(q)
    count[y, x] = 1
    return torch.nn.functional.max_pool2d(count[None], 3, 1, padding=1)[0] > 0


def _fine_cells(q: Float[Tensor, "n 3"]) -> tuple[Int[Tensor, "n"], Int[Tensor, "n"]]:
    """Return column and row of positions in the finer grid, clamped to it."""
    cell = ((q[:, :2] / HALF_SIDE + 1) * (FINE_CELLS / 2)).long().clamp(0, FINE_CELLS - 1)
    return cell[:, 0], cell[:, 1]


def _bending_energy(device: torch.device) -> Float[Tensor, "nodes2 nodes2"]:
    """Return the quadratic form of the thin plate's bending energy, weighted."""
    one = torch.eye(GRID_NODES, dtype=torch.float64, device=device)
    slope, bend = one[1:] - one[:-1], one[2:] - 2 * one[1:-1] + one[:-2]
    along_x, along_y, twist = torch.kron(one, bend), torch.kron(bend, one), torch.kron(slope, slope)
    energy = BENDING_WEIGHT * (along_x.T @ along_x + along_y.T @ along_y + 2 * twist.T @ twist)
    # 1e-9: collinear points leave the plate's rotation about their line undetermined (singular).
    nodes = GRID_NODES * GRID_NODES
    return energy + 1e-9 * torch.eye(nodes, dtype=torch.float64, device=device)


def _cells(q: Float[Tensor, "n 3"]) -> tuple[Int[Tensor, "n 2"], Float[Tensor, "n 2"]]:
    """Return the lower node (x, y) of each position's cell, and the position in it, [0,1]."""
    scaled = (q[:, :2] / HALF_SIDE + 1).clamp(0, 2) * ((GRID_NODES - 1) / 2)
    node = scaled.long().clamp_max(GRID_NODES - 2)
    return node, scaled - node


def _corners(node: Int[Tensor, "n 2"], fraction: Float[Tensor, "n 2"]):
    """Yield x index, y index and bilinear weight of each of the four nodes of every cell."""
    for right in (0, 1):
        for up in (0, 1):
            x = fraction[:, 0] if right else 1 - fraction[:, 0]
            y = fraction[:, 1] if up else 1 - fraction[:, 1]
            yield node[:, 0] + right, node[:, 1] + up, x * y
