"""Occupancy: which cells of straight space hold matter, in cascades (Müller et al. 2022).

Cascade k covers the cube of half side 2^k grid units with side³ cells, so cells grow with distance
as steps do. Marching looks only where a cell is occupied.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

OPACITY = 0.3  # of a crossed cell

DensityAt = Callable[[Float[Tensor, "n 3"]], Float[Tensor, "n"]]


class Occupancy(torch.nn.Module):
    """Running maximum of density per cell, and the bytes that marching reads."""

    density: Tensor
    occupied: Tensor
    seen: Tensor

    def __init__(self, cascades: int, side: int):
        super().__init__()
        self.register_buffer("density", torch.zeros(cascades, side, side, side))
        self.register_buffer("occupied", torch.ones(cascades, side, side, side, dtype=torch.uint8))
        # Cells that training images have seen matter in; filled when a fit ends.
        self.register_buffer("seen", torch.zeros(cascades, side, side, side, dtype=torch.uint8))

    @property
    def side(self) -> int:
        """Cells along an edge."""
        return self.density.shape[1]

    def cell_centres(self, cells: Int[Tensor, "n"]) -> tuple[Tensor, Tensor]:
        """Centre (grid units) and side of cells given by flat index."""
        side = self.side
        cascade = cells // side**3
        index = torch.stack([cells // side**2 % side, cells // side % side, cells % side], dim=-1)
        size = 2.0 ** (cascade + 1) / side
        return (index + 0.5) * size[:, None] - 2.0 ** cascade[:, None], size

    def update(
        self, density_at: DensityAt, fraction: float, decay: float, generator: torch.Generator
    ) -> None:
        """Looks at all occupied cells or, for fraction < 1, at some of them and of all others.

        Args:
            density_at: density (1/grid unit) at positions in grid units.
            fraction: share of the cells looked at; 1 looks at every cell.
            decay: what an old value is multiplied with before the maximum with the new one.
            generator: source of the positions inside the cells.
        """
        total = self.density.numel()
        if fraction >= 1:
            cells = torch.arange(total)
        else:
            count = int(total * fraction)
            anywhere = torch.randint(total, (count,), generator=generator)
            held = self.occupied.view(-1).nonzero()[:, 0]
            if held.numel() > 2 * count:
                held = held[torch.randint(held.numel(), (2 * count,), generator=generator)]
            cells = torch.cat([anywhere, held])
        centre, size = self.cell_centres(cells)
        offset = torch.rand(centre.shape, generator=generator) - 0.5
        seen = density_at(centre + offset * size[:, None])
        flat = self.density.view(-1)
        flat[cells] = torch.maximum(flat[cells] * decay, seen)
        self._threshold()

    def _threshold(self, opacity: float = OPACITY) -> None:
        """A cell is occupied if crossing it would absorb more than `opacity` of the light.

        Early on all density is low: then the cascade's mean is the threshold, or the grid would
        be empty.
        """
        cascades = torch.arange(self.density.shape[0])
        depth = self.density * (2.0 ** (cascades + 1) / self.side)[:, None, None, None]
        threshold = depth.mean((1, 2, 3), keepdim=True).clamp_max(opacity)
        self.occupied = (depth > threshold).to(torch.uint8)

    def refine(self) -> None:
        """Halves the cells, each of the eight inheriting its parent's density."""
        double = self.density
        for axis in (1, 2, 3):
            double = double.repeat_interleave(2, dim=axis)
        self.density = double
        self.seen = torch.zeros_like(double, dtype=torch.uint8)
        self._threshold()
