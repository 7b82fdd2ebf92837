"""Ground as one height over each place, told by the sparse points that photos label ground.

Far lawns and roads look the same wherever they lie: at grazing angles a lump of some decimetres
hardly moves a pixel, but snow, water and smog show it. Points are few and right, and ground between
them bends little; so rays that are labelled ground are to end near that height.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from climatenerf.core.device import to_device

CELLS = 33  # lines along an edge
HALF_SIDE = 4.0  # grid units
MIN_POINTS, MAX_POINTS = 50, 6000  # by which a map is drawn
REACH = 0.5  # grid units around a point in which the map is believed
AROUND = 2  # lines of the map that a place has to be above
FINE_CELLS = 64  # along an edge: next to a point's own, the map is sure
STIFF = 0.05  # price of bending against the points' mean distance
ROUNDS = 15  # of reweighted least squares
FINEST = 2e-3  # grid units: points are not believed to be nearer the ground
MIN_TOLERANCE = 7.5e-3  # grid units: kerbs and tufts that the map does not know
ROUGHNESS = 2.0  # tolerance over the distance within which nine tenths of the points lie


@dataclass(frozen=True)
class GroundHeight:
    """Heights on lines about the scene's middle, rows along y; all in grid units."""

    height: Float[Tensor, "c c"]
    known: Bool[Tensor, "c c"]
    """Where points are near."""
    sure: Bool[Tensor, "f f"]
    """Cells of a finer square in or next to which a point lies, rows along y."""
    tolerance: float
    """Ground may be this far from the map."""

    def clears(self, q: Float[Tensor, "n 3"], reach: Float[Tensor, "n"]) -> Bool[Tensor, "n"]:
        """Whether balls about positions are above all ground around: no crest can hide them.

        Only right above points: elsewhere the map may have missed a step.
        """
        highest = torch.nn.functional.max_pool2d(
            self.height[None], 2 * AROUND + 1, stride=1, padding=AROUND
        )[0]
        corner, share = _cells(q)
        x, y = (corner + (share > 0.5)).unbind(-1)
        inside = (q[:, :2].abs() < HALF_SIDE).all(-1)
        high = q[:, 2] - reach > highest[y, x] + self.tolerance
        x, y = _fine(q)
        return inside & high & self.sure[y, x]

    def height_above(self, q: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n"], Bool[Tensor, "n"]]:
        """Height of positions over the map, and whether the map is known there."""
        place = q[:, :2] / HALF_SIDE
        height = torch.nn.functional.grid_sample(
            self.height[None, None], place[None, None], padding_mode="border", align_corners=True
        )[0, 0, 0]
        x, y = ((place + 1) * ((CELLS - 1) / 2)).round().long().clamp(0, CELLS - 1).unbind(-1)
        return q[:, 2] - height, (place.abs() < 1).all(-1) & self.known[y, x]


def fit_ground_height(q: Float[Tensor, "n 3"]) -> GroundHeight | None:
    """The map through points on the ground (grid units); None for too few.

    The least mean distance (not squared: labels err) plus the price of bending, the thin plate's.
    """
    q = q[(q[:, :2].abs() < HALF_SIDE).all(-1)]
    if q.shape[0] < MIN_POINTS:
        return None
    q = q[:: -(-q.shape[0] // MAX_POINTS)]
    n, size = q.shape[0], CELLS * CELLS
    # Each point looks at four places of the map only.
    corners = list(_corners(*_cells(q)))
    place = torch.stack([y * CELLS + x for x, y, _ in corners], dim=-1)
    look = torch.stack([weight for _, _, weight in corners], dim=-1).double()
    pairs = (place[:, :, None] * size + place[:, None, :]).view(-1)
    products = look[:, :, None] * look[:, None, :]
    price = _bending()
    z = q[:, 2].double()
    middle = z.median()
    weight = torch.ones_like(z) / n
    height = torch.zeros(size, dtype=torch.float64)
    for _ in range(ROUNDS):
        pull = torch.zeros(size * size, dtype=torch.float64)
        pull.index_add_(0, pairs, (weight[:, None, None] * products).view(-1))
        goal = torch.zeros(size, dtype=torch.float64)
        goal.index_add_(0, place.view(-1), ((weight * (z - middle))[:, None] * look).view(-1))
        height = torch.linalg.solve(pull.view(size, size) + price, goal)
        off = ((look * height[place]).sum(-1) + middle - z).abs()
        weight = 1 / (off.clamp_min(FINEST) * n)
    line = to_device(np.linspace(-HALF_SIDE, HALF_SIDE, CELLS, dtype=np.float32))
    lines = torch.stack(torch.meshgrid(line, line, indexing="xy"), dim=-1).view(-1, 2)
    near = torch.cdist(lines, q[:, :2]).amin(-1)
    return GroundHeight(
        height=(height + middle).float().view(CELLS, CELLS),
        known=(near < REACH).view(CELLS, CELLS),
        sure=_next_to(q),
        tolerance=max(MIN_TOLERANCE, ROUGHNESS * float(off.quantile(0.9))),
    )


def _next_to(q: Float[Tensor, "n 3"]) -> Bool[Tensor, "f f"]:
    """Cells of the finer square that hold a point, and their neighbours."""
    held = torch.zeros(FINE_CELLS, FINE_CELLS)
    x, y = _fine(q)
    held[y, x] = 1
    return torch.nn.functional.max_pool2d(held[None], 3, 1, padding=1)[0] > 0


def _fine(q: Float[Tensor, "n 3"]) -> tuple[Int[Tensor, "n"], Int[Tensor, "n"]]:
    """Column and row of positions in the finer square."""
    place = ((q[:, :2] / HALF_SIDE + 1) * (FINE_CELLS / 2)).long().clamp(0, FINE_CELLS - 1)
    return place[:, 0], place[:, 1]


def _bending() -> Float[Tensor, "c2 c2"]:
    """Quadratic form of the map's price for bending."""
    one = torch.eye(CELLS, dtype=torch.float64)
    slope, bend = one[1:] - one[:-1], one[2:] - 2 * one[1:-1] + one[:-2]
    along_x, along_y, twist = torch.kron(one, bend), torch.kron(bend, one), torch.kron(slope, slope)
    price = STIFF * (along_x.T @ along_x + along_y.T @ along_y + 2 * twist.T @ twist)
    # Points in a line leave the map's turn about it open: singular without 1e-9.
    return price + 1e-9 * torch.eye(CELLS * CELLS, dtype=torch.float64)


def _cells(q: Float[Tensor, "n 3"]) -> tuple[Int[Tensor, "n 2"], Float[Tensor, "n 2"]]:
    """Lower line of each position's cell, along x and y, and its place in the cell."""
    place = (q[:, :2] / HALF_SIDE + 1).clamp(0, 2) * ((CELLS - 1) / 2)
    corner = place.long().clamp_max(CELLS - 2)
    return corner, place - corner


def _corners(corner: Int[Tensor, "n 2"], share: Float[Tensor, "n 2"]):
    """Line along x, line along y and bilinear weight of each cell's four corners."""
    for right in (0, 1):
        for up in (0, 1):
            x = share[:, 0] if right else 1 - share[:, 0]
            y = share[:, 1] if up else 1 - share[:, 1]
            yield corner[:, 0] + right, corner[:, 1] + up, x * y
