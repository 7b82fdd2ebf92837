"""Occupancy: which cells of uncontracted space hold density, in cascades (Müller et al. 2022).

Cascade k covers the cube of half side 2^k grid units with side³ cells, so cells grow with distance
as marching steps do. Marching evaluates the density in occupied cells only.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from climatenerf.core.device import integers, uniform
from climatenerf.ops import marching

MAX_THRESHOLD = 0.3  # optical depth across a cell above which it is always occupied
MEAN_CELLS = 100_000  # about how many cells give the mean density of the cascades

DensityAt = Callable[[Float[Tensor, "n 3"]], Float[Tensor, "n"]]


class Occupancy(torch.nn.Module):
    """Running maximum of the density per cell, and which cells are occupied.

    Buffers have the shape [cascades, side, side, side]; x is the first axis of a cascade.
    """

    density: Tensor
    """Running maximum, 1/grid unit."""
    occupied: Tensor
    seen: Tensor
    """Cells in which training images have seen a surface; filled when a fit ends."""
    forced_empty: Tensor
    """Cells that the photos show to be empty and that never become occupied; not stored."""

    def __init__(self, cascades: int, side: int):
        """Make cells that are all occupied, on the CPU; `.to(device)` moves them."""
        super().__init__()
        shape = (cascades, side, side, side)
        self.register_buffer("density", torch.zeros(shape, device="cpu"))
        self.register_buffer("occupied", torch.ones(shape, dtype=torch.uint8, device="cpu"))
        self.register_buffer("seen", torch.zeros(shape, dtype=torch.uint8, device="cpu"))
        forced_empty = torch.zeros(shape, dtype=torch.bool, device="cpu")
        self.register_buffer("forced_empty", forced_empty, persistent=False)
        self.packed: tuple[Tensor, int, marching.Cells] | None = None

    @property
    def cascades(self) -> int:
        """Number of cascades."""
        return self.density.shape[0]

    @property
    def side(self) -> int:
        """Cells along an edge of a cascade."""
        return self.density.shape[1]

    def cells(self) -> marching.Cells:
        """Return `marching.cells_of` the occupied cells, packed again only after a change."""
        if self.occupied.is_inference():  # inference tensors have no version counter
            return marching.cells_of(self.occupied)
        state = self.occupied, self.occupied._version
        if self.packed is None or self.packed[0] is not state[0] or self.packed[1] != state[1]:
            self.packed = *state, marching.cells_of(self.occupied)
        return self.packed[2]

    def __getstate__(self) -> dict:
        """Leave out the packed cells: a copy has a version counter of its own."""
        return {**self.__dict__, "packed": None}

    def cell_index(self, q: Float[Tensor, "n 3"]) -> tuple[Int[Tensor, "n"], Tensor]:
        """Return the flat index of the cell of each position, and whether a cascade holds it.

        A position (grid units) belongs to the finest cascade that holds it.
        """
        distance = q.abs().amax(-1)
        cascade = distance.clamp_min(1.0).log2().ceil().long()
        inside = cascade < self.cascades
        cascade = cascade.clamp_max(self.cascades - 1)
        half = (2.0**cascade)[:, None]
        side = self.side
        index = ((q + half) / (2 * half) * side).long().clamp(0, side - 1)
        flat = ((cascade * side + index[:, 0]) * side + index[:, 1]) * side + index[:, 2]
        return flat, inside

    def cell_centres(
        self, cells: Int[Tensor, "n"]
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]:
        """Return centre and side (grid units) of cells given by flat index."""
        side = self.side
        cascade = cells // side**3
        index = torch.stack([cells // side**2 % side, cells // side % side, cells % side], dim=-1)
        size = 2.0 ** (cascade + 1) / side
        return (index + 0.5) * size[:, None] - 2.0 ** cascade[:, None], size

    def occupied_at(self, q: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Return 1 where the cell of a position (grid units) is occupied, else 0."""
        cells, inside = self.cell_index(q)
        return self.occupied.view(-1)[cells].float() * inside

    def record(self, q: Float[Tensor, "n 3"], density: Float[Tensor, "n"]) -> None:
        """Raise the running maximum to densities (1/grid unit) at positions (grid units)."""
        cells, inside = self.cell_index(q)
        self.density.view(-1).scatter_reduce_(0, cells, density * inside, "amax")

    def mark_seen(self, q: Float[Tensor, "n 3"]) -> None:
        """Mark the cells of positions (grid units) as seen."""
        cells, inside = self.cell_index(q)
        self.seen.view(-1)[cells[inside]] = 1

    def observed_only(self) -> "Occupancy":
        """Return an occupancy of the occupied cells that were seen or touch a seen cell."""
        observed = Occupancy(self.cascades, self.side).to(self.density.device)
        observed.occupied = self.occupied * dilated(self.seen).to(torch.uint8)
        return observed

    def update(
        self, density_at: DensityAt, fraction: float, decay: float, generator: torch.Generator
    ) -> None:
        """Evaluate the density in all cells or, for fraction < 1, in some of them.

        Args:
            density_at: density (1/grid unit) at positions in grid units.
            fraction: fraction of the cells to evaluate; 1 evaluates every cell.
            decay: factor on an old value before the maximum with the new one is taken.
            generator: source of the cells and of the positions inside them.
        """
        total = self.density.numel()
        flat, occupied = self.density.view(-1), self.occupied.view(-1)
        if fraction >= 1:
            cells = torch.arange(total, device=flat.device)
        else:
            # Half anywhere, half occupied ones out of a larger sample: a list of all occupied
            # cells would cost more than evaluating these.
            count = max(1, int(total * fraction / 2))
            anywhere = self._stratified(count, generator)
            sampled = self._stratified(4 * count, generator)
            selected = (self._occupied_of_static if sampled.is_cuda else self._occupied_of)(
                sampled, count
            )
            found = selected.shape[0]
            half = integers(generator, 0, max(1, found), found // 2, device=flat.device)
            cells = torch.cat([anywhere, selected, self._neighbours(selected[half], generator)])
        centre, size = self.cell_centres(cells)
        offset = uniform(generator, *centre.shape, device=centre.device) - 0.5
        evaluated = density_at(centre + offset * size[:, None])
        flat[cells] = torch.maximum(flat[cells] * decay, evaluated)
        if fraction >= 1:
            self._apply_threshold()
        else:
            threshold = self._thresholds(anywhere[:: max(1, count // MEAN_CELLS)])
            dense = flat[cells] * size > threshold[cells // self.side**3]
            occupied[cells] = (dense & ~self.forced_empty.view(-1)[cells]).to(torch.uint8)

    def _occupied_of(self, cells: Int[Tensor, "m"], count: int) -> Int[Tensor, "n"]:
        """Return the occupied ones of some cells, subsampled to about `count`."""
        occupied = cells[self.occupied.view(-1)[cells] > 0]
        return occupied[:: max(1, occupied.shape[0] // count)]

    def _occupied_of_static(self, cells: Int[Tensor, "m"], count: int) -> Int[Tensor, "count"]:
        """Return what `_occupied_of` does without a size that depends on the data.

        Such a size synchronises with a GPU. There are always `count` cells; where too few are
        occupied, the first one fills up the list. A random order spreads what is cut off evenly.
        """
        mixed = cells[torch.randperm(cells.shape[0], device=cells.device)]
        found = torch.nonzero_static(self.occupied.view(-1)[mixed], size=count, fill_value=0)[:, 0]
        return mixed[found]

    def _stratified(self, count: int, generator: torch.Generator) -> Int[Tensor, "n"]:
        """Return about `count` cells at equal distances, from a random first one on.

        Ascending order: random access to hundreds of megabytes misses the cache nearly each time.
        """
        total, device = self.density.numel(), self.density.device
        step = max(1, total // count)
        first = integers(generator, 0, step, 1, device=device)
        return torch.arange(0, total - step + 1, step, device=device) + first

    def _neighbours(self, cells: Int[Tensor, "n"], generator: torch.Generator) -> Int[Tensor, "n"]:
        """Return a random neighbour of each cell: holes in surfaces lie next to occupied cells."""
        side = self.side
        shift = integers(generator, -1, 2, 3, cells.shape[0], device=cells.device)
        index = [cells // side**2 % side, cells // side % side, cells % side]
        x, y, z = ((i + s).clamp(0, side - 1) for i, s in zip(index, shift, strict=True))
        return ((cells // side**3 * side + x) * side + y) * side + z

    def _thresholds(self, cells: Int[Tensor, "n"]) -> Float[Tensor, "cascades"]:
        """Return the optical depth across a cell above which it is occupied, for each cascade.

        That is `MAX_THRESHOLD` or, early in a fit when all density is low, the cascade's mean over
        the given cells: otherwise no cell would be occupied.
        """
        cascade = cells // self.side**3
        depth = self.density.view(-1)[cells] * 2.0 ** (cascade + 1) / self.side
        zeros = depth.new_zeros(self.cascades)
        total = zeros.index_add(0, cascade, depth)
        number = zeros.index_add(0, cascade, torch.ones_like(depth))
        return (total / number.clamp_min(1)).clamp_max(MAX_THRESHOLD)

    def _apply_threshold(self) -> None:
        """Decide for every cell whether it is occupied."""
        cascades = torch.arange(self.cascades, device=self.density.device)
        depth = self.density * (2.0 ** (cascades + 1) / self.side)[:, None, None, None]
        threshold = depth.mean((1, 2, 3), keepdim=True).clamp_max(MAX_THRESHOLD)
        self.occupied = ((depth > threshold) & ~self.forced_empty).to(torch.uint8)

    def refine(self) -> None:
        """Halve the cells; each of the eight children inherits its parent's density."""
        self.density = _doubled(self.density)
        self.forced_empty = _doubled(self.forced_empty)
        self.seen = torch.zeros_like(self.density, dtype=torch.uint8)
        self._apply_threshold()


def dilated(cells: UInt8[Tensor, "k g g g"] | Tensor) -> Tensor:
    """Return a boolean mask of cells and their 26 neighbours in the same cascade."""
    return torch.nn.functional.max_pool3d(cells[:, None].float(), 3, 1, padding=1)[:, 0] > 0


def _doubled(cells: Tensor) -> Tensor:
    """Return cells [cascades, side, side, side] with each repeated along all three axes."""
    for axis in (1, 2, 3):
        cells = cells.repeat_interleave(2, dim=axis)
    return cells
