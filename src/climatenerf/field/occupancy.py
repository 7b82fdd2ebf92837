"""Occupancy: which cells of straight space hold matter, in cascades (Müller et al. 2022).

Cascade k covers the cube of half side 2^k grid units with side³ cells, so cells grow with distance
as steps do. Marching looks only where a cell is occupied.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.core.device import integers, uniform
from climatenerf.ops import marching

OPACITY = 0.3  # of a crossed cell
FOR_MEAN = 100_000  # cells from which the cascades' mean densities are told, about

DensityAt = Callable[[Float[Tensor, "n 3"]], Float[Tensor, "n"]]


class Occupancy(torch.nn.Module):
    """Running maximum of density per cell, and which cells marching looks into."""

    density: Tensor
    occupied: Tensor
    seen: Tensor
    barred: Tensor

    def __init__(self, cascades: int, side: int):
        super().__init__()
        self.register_buffer("density", torch.zeros(cascades, side, side, side))
        self.register_buffer("occupied", torch.ones(cascades, side, side, side, dtype=torch.uint8))
        # Cells that training images have seen matter in; filled when a fit ends.
        self.register_buffer("seen", torch.zeros(cascades, side, side, side, dtype=torch.uint8))

        # Cells that are known to be empty from elsewhere: they never become occupied. It follows
        # from the photos, so it is not stored.
        barred = torch.zeros(cascades, side, side, side, dtype=torch.bool)
        self.register_buffer("barred", barred, persistent=False)
        self.packed: tuple[Tensor, int, marching.Cells] | None = None

    @property
    def side(self) -> int:
        """Cells along an edge."""
        return self.density.shape[1]

    def cells(self) -> marching.Cells:
        """What marching reads: `marching.cells_of` the occupied ones, anew if they have changed."""
        if self.occupied.is_inference():  # those count no changes
            return marching.cells_of(self.occupied)
        state = self.occupied, self.occupied._version
        if self.packed is None or self.packed[0] is not state[0] or self.packed[1] != state[1]:
            self.packed = *state, marching.cells_of(self.occupied)
        return self.packed[2]

    def __getstate__(self) -> dict:
        """A copy counts its own changes, so it packs its own cells."""
        return {**self.__dict__, "packed": None}

    def cell_centres(
        self, cells: Int[Tensor, "n"]
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]:
        """Centre and side (grid units) of cells given by flat index."""
        side = self.side
        cascade = cells // side**3
        index = torch.stack([cells // side**2 % side, cells // side % side, cells % side], dim=-1)
        size = 2.0 ** (cascade + 1) / side
        return (index + 0.5) * size[:, None] - 2.0 ** cascade[:, None], size

    def update(
        self, density_at: DensityAt, fraction: float, decay: float, generator: torch.Generator
    ) -> None:
        """Looks at all cells or, for fraction < 1, at some occupied ones and some of all.

        Args:
            density_at: density (1/grid unit) at positions in grid units.
            fraction: share of the cells looked at; 1 looks at every cell.
            decay: what an old value is multiplied with before the maximum with the new one.
            generator: source of the positions inside the cells.
        """
        total = self.density.numel()
        flat, held = self.density.view(-1), self.occupied.view(-1)
        if fraction >= 1:
            cells = torch.arange(total)
        else:
            # Half anywhere, half occupied ones found by looking at more until enough are met:
            # listing all occupied cells would cost more than looking at these.
            count = max(1, int(total * fraction / 2))
            anywhere = self._spread(count, generator)
            drawn = self._spread(4 * count, generator)
            known = (self._known_at_once if drawn.is_cuda else self._known)(drawn, count)
            half = integers(generator, 0, max(1, known.shape[0]), known.shape[0] // 2)
            cells = torch.cat([anywhere, known, self._neighbours(known[half], generator)])
        centre, size = self.cell_centres(cells)
        offset = uniform(generator, *centre.shape) - 0.5
        seen = density_at(centre + offset * size[:, None])
        flat[cells] = torch.maximum(flat[cells] * decay, seen)
        if fraction >= 1:
            self._threshold()
        else:
            threshold = self._thresholds(anywhere[:: max(1, count // FOR_MEAN)])
            dense = flat[cells] * size > threshold[cells // self.side**3]
            held[cells] = (dense & ~self.barred.view(-1)[cells]).to(torch.uint8)

    def _known(self, drawn: Int[Tensor, "m"], count: int) -> Int[Tensor, "n"]:
        """Those of some cells that are occupied, thinned out to about `count`."""
        known = drawn[self.occupied.view(-1)[drawn] > 0]
        return known[:: max(1, known.shape[0] // count)]

    def _known_at_once(self, drawn: Int[Tensor, "m"], count: int) -> Int[Tensor, "count"]:
        """As `_known`, without a GPU's having to count them: `count`, if need be with any other.

        In no order, so that what is left out is spread evenly.
        """
        mixed = drawn[torch.randperm(drawn.shape[0], device=drawn.device)]
        found = torch.nonzero_static(self.occupied.view(-1)[mixed], size=count, fill_value=0)[:, 0]
        return mixed[found]

    def _spread(self, count: int, generator: torch.Generator) -> Int[Tensor, "n"]:
        """About `count` cells at equal distances from a random one on.

        In order: of as many random ones nearly each would be waited for, in hundreds of megabytes.
        """
        total = self.density.numel()
        step = max(1, total // count)
        return torch.arange(0, total - step + 1, step) + integers(generator, 0, step, 1)

    def _neighbours(self, cells: Int[Tensor, "n"], generator: torch.Generator) -> Int[Tensor, "n"]:
        """A cell next to each: holes in surfaces lie beside what is known, and close this way."""
        side = self.side
        shift = integers(generator, -1, 2, 3, cells.shape[0])
        place = [cells // side**2 % side, cells // side % side, cells % side]
        x, y, z = ((p + s).clamp(0, side - 1) for p, s in zip(place, shift, strict=True))
        return ((cells // side**3 * side + x) * side + y) * side + z

    def _thresholds(self, cells: Int[Tensor, "n"]) -> Float[Tensor, "cascades"]:
        """Optical depth across a cell from which it is occupied, for each cascade.

        A cell is occupied if crossing it absorbs more than `OPACITY` of the light. Early on all
        density is low: then the cascade's mean (over the cells given) decides, or the grid would
        be empty.
        """
        count = self.density.shape[0]
        cascade = cells // self.side**3
        depth = self.density.view(-1)[cells] * 2.0 ** (cascade + 1) / self.side
        total = torch.zeros(count).index_add(0, cascade, depth)
        number = torch.zeros(count).index_add(0, cascade, torch.ones_like(depth)).clamp_min(1)
        return (total / number).clamp_max(OPACITY)

    def _threshold(self) -> None:
        """Decides every cell anew."""
        cascades = torch.arange(self.density.shape[0])
        depth = self.density * (2.0 ** (cascades + 1) / self.side)[:, None, None, None]
        threshold = depth.mean((1, 2, 3), keepdim=True).clamp_max(OPACITY)
        self.occupied = ((depth > threshold) & ~self.barred).to(torch.uint8)

    def refine(self) -> None:
        """Halves the cells, each of the eight inheriting its parent's density."""
        double = self.density
        for axis in (1, 2, 3):
            double = double.repeat_interleave(2, dim=axis)
        self.density = double
        held = self.barred
        for axis in (1, 2, 3):
            held = held.repeat_interleave(2, dim=axis)
        self.barred = held
        self.seen = torch.zeros_like(double, dtype=torch.uint8)
        self._threshold()
