"""From deposits to metaballs: columns of snow, prefiltered onto a sparse lattice.

Each deposit fills the column around it, from below the ground up to the requested depth above it.
The filled fraction around a vertex is an integral, not a sample: weighted by a tent of one spacing
in x and y and a quadratic B-spline along z. So the thickness does not depend on the offset of the
lattice. World frame, m.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8
from numba import njit

from climatenerf.ops.cpu.metaballs import (
    BRICK,
    HEIGHT_UNIT,
    STORED,
    SUPPORT,
    Lattice,
    occupied_cells,
)
from climatenerf.weather.snow.cover import held_by_crowns
from climatenerf.weather.snow.sliding import settled

_BLUR = 1.5  # half-width of the vertical prefilter in spacings
# A column that extends below the ground by the supports of kernel and prefilter gives the same
# surface as a half-space.
_BURIAL = SUPPORT + _BLUR
_BELOW, _ABOVE = 20.0, 40.0  # m; ground up to this far below and above the cameras carries snow
SHADE_UNIT = 128 / 255  # a value that a byte holds
"""`Catch.shade` of snow that receives as much light as its surroundings."""
TRACE = 0.01  # of the fall, up to which a surface is bare; the paper's slopes keep 1e-14 anywhere
_THINNEST = 2e-4  # m; thinner snow is no layer of grains
UNDERGROUND = 1.75, 2.5  # spacings that a vertex lies below a column's ground, from 0 to all hidden
THIN, DEEP = 0.04, 0.08  # m on level ground; between these, hidden columns lose their weight
HIDDEN_WEIGHT = 1.0, 0.2  # of hidden columns in mean heights, in thin and in deep snow


@dataclass(frozen=True)
class SnowGrid:
    """Extent and resolution of the snow lattice."""

    centre: tuple[float, float]
    """x and y of the centre, m."""
    z_range: tuple[float, float]
    """Lowest and highest ground that can carry snow, m."""
    spacing: float
    """Spacing of the innermost cascade, m; each further one has twice the spacing and side."""
    half_cells: int
    """Cells from the centre to a side, the same for every cascade; a multiple of 16."""
    cascades: int = 1

    def __post_init__(self) -> None:
        if self.half_cells % (2 * BRICK) or self.half_cells <= 0 or self.cascades < 1:
            raise ValueError(
                f"half_cells must be a positive multiple of {2 * BRICK} and cascades at least 1; "
                f"got {self.half_cells} and {self.cascades}"
            )

    def spacing_of(self, cascade: int) -> float:
        """Return the lattice spacing of a cascade, m."""
        return self.spacing * 2**cascade

    def half_side(self, cascade: int) -> float:
        """Return half the side of a cascade's square, m."""
        return self.half_cells * self.spacing_of(cascade)


@dataclass(frozen=True)
class Catch:
    """What catches the snow of one pass: a raster of surfaces, or of crowns above them."""

    position: Float32[np.ndarray, "h w 3"]
    """Points on what catches the snow, world frame, m; NaN where there is nothing."""
    of_fall: Float32[np.ndarray, "h w"]
    """Depth of the snow over that on open level ground."""
    of_held: Float32[np.ndarray, "h w"]
    """Depth, in addition, over what a closed crown holds; negative below crowns."""
    hidden: Float32[np.ndarray, "h w"]
    """Depth that lies between leaves and does not show, m."""
    weight: Float32[np.ndarray, "h w"]
    """Fraction of the cell that catches snow; 0 outside the raster's part of the scene."""
    shade: Float32[np.ndarray, "h w"]
    """0 to 1; NaN: unknown. In the light of the place: light over that around, by `SHADE_UNIT`. In
    the paper's light: beta_s V_s + V_s0."""
    overhangs: bool = False
    """Whether it hangs over lower ground, to which snow falls from its edges."""


@dataclass(frozen=True)
class Deposits:
    """Where snow lands. It depends on the scene, not on the depth of the snow."""

    grid: SnowGrid
    cascades: tuple[tuple[Catch, ...], ...]
    """What catches snow in each cascade; every fall direction adds one or two rasters."""
    passes: Int[np.ndarray, "cascades"]
    """Number of fall directions per cascade; each covers all cells once."""

    def coverage(self) -> float:
        """Fraction of a cascade's square that carries snow, seen from above, of the one with most.

        The mean over fall directions.
        """
        found = [0.0]
        for k, catches in enumerate(self.cascades):
            cells = (2 * self.grid.half_cells) ** 2 * int(self.passes[k])
            snowy = (each.weight[each.of_fall + each.of_held > TRACE].sum() for each in catches)
            found.append(sum(map(float, snowy)) / cells)
        return max(found)


def choose_grid(
    lower: Float[np.ndarray, "3"],
    upper: Float[np.ndarray, "3"],
    cameras: Float[np.ndarray, "m 3"],
) -> SnowGrid:
    """Return a grid that is fine near the cameras and extends to the scene's bounds.

    Args:
        lower: lower corner of the region with density, m.
        upper: upper corner, m.
        cameras: camera positions of the path, m.

    Returns:
        A grid with a spacing of 3 to 6 cm; larger if the path spans more than about 60 m.
    """
    low, high = cameras.min(0), cameras.max(0)
    centre = (low[:2] + high[:2]) / 2
    near = float(np.linalg.norm(high[:2] - low[:2])) / 2 + 5.0
    far = float(np.maximum(np.abs(lower[:2] - centre), np.abs(upper[:2] - centre)).max())
    spacing = min(max(min(near, far) / 180, 0.03), 0.06)
    spacing = max(spacing, near / 600)
    half_cells = math.ceil(min(near, far) / spacing / (2 * BRICK)) * 2 * BRICK
    half_cells = min(half_cells, 14 * 2 * BRICK)
    cascades = 1 + max(0, math.ceil(math.log2(max(far, 1e-3) / (half_cells * spacing))))
    # A sixth cascade would be so coarse and so far away that its shape would not be visible.
    return SnowGrid(
        (float(centre[0]), float(centre[1])),
        (max(float(lower[2]), low[2] - _BELOW), min(float(upper[2]), high[2] + _ABOVE)),
        spacing,
        half_cells,
        min(cascades, 5),
    )


def grow(deposits: Deposits, depth: float) -> Lattice:
    """Build the lattice of snow of a given depth on the deposits.

    Args:
        deposits: where snow lands.
        depth: thickness on open level ground, m.

    Returns:
        The lattice; without bricks if there are no deposits.
    """
    grid = deposits.grid
    lower, bricks, index, pool = [], [], [], []
    used = 0
    for k in range(grid.cascades):
        h, half = grid.spacing_of(k), grid.half_side(k)
        position, weight, shade, thickness = _columns(deposits.cascades[k], depth, h)
        # Margin for the columns below and above the ground, and one brick for the kernel support.
        bottom = grid.z_range[0] - (_BURIAL + _BLUR + BRICK) * h
        top = grid.z_range[1] + depth + (_BLUR + BRICK) * h
        side = 2 * grid.half_cells // BRICK + 2
        count = np.array([side, side, math.ceil((top - bottom) / (h * BRICK))], np.int64)
        margin = half + BRICK * h
        corner = np.array([grid.centre[0] - margin, grid.centre[1] - margin, bottom])
        weight = weight / np.float32(deposits.passes[k])
        hidden = float(np.interp(depth, (THIN, DEEP), HIDDEN_WEIGHT))
        sums, core = _fill((position - corner) / h, weight, shade, thickness / h, count, hidden)
        table, fill, height, shade = _assemble(sums, core)
        index.append(np.where(table >= 0, table + used, -1).astype(np.int32).reshape(-1))
        pool.append((fill, height, shade))
        used += fill.shape[0]
        lower.append(corner)
        bricks.append(count)
    sizes = [part.size for part in index]
    spacing = np.array([grid.spacing_of(k) for k in range(grid.cascades)])
    fill = np.concatenate([p[0] for p in pool])
    band, near = occupied_cells(fill)
    return Lattice(
        lower=np.array(lower),
        spacing=spacing,
        bricks=np.array(bricks),
        start=np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int64),
        index=np.concatenate(index),
        fill=fill,
        height=np.concatenate([p[1] for p in pool]),
        shade=np.concatenate([p[2] for p in pool]),
        band=band,
        near=near,
        # Deep enough to leave no gap above rough ground, and too thin to be visible under a table.
        burial=np.clip(0.5 * spacing, 0.02, 0.04),
    )


def _columns(
    catches: tuple[Catch, ...], depth: float, spacing: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return position (m), weight, brightness and thickness (m) of all columns of a cascade."""
    held = held_by_crowns(depth)
    parts = []
    for catch in catches:
        thickness = catch.of_fall * np.float64(depth) + catch.of_held * held - catch.hidden
        surface = catch.weight > 0
        nothing = -1e3 if catch.overhangs else np.nan  # far below; beside NaN snow stays
        base = np.where(surface, catch.position[..., 2].astype(np.float64), nothing)
        thickness = np.where(surface, np.maximum(thickness, 0.0), 0.0)
        thickness = settled(base, thickness, spacing)
        used = surface & (thickness > _THINNEST)
        parts.append(
            [each[used] for each in (catch.position, catch.weight, catch.shade, thickness)]
        )
    position, weight, shade, thickness = (np.concatenate(each) for each in zip(*parts, strict=True))
    return position.astype(np.float64), weight, shade, thickness


@njit(cache=True)
def _integrated_spline(u: float) -> float:
    """Return the integral of a quadratic B-spline (unit knots, centred on 0) up to u."""
    a = min(abs(u), 1.5)
    half = 0.75 * a - a**3 / 3 if a < 0.5 else 0.5 - (1.5 - a) ** 3 / 6
    return 0.5 + half if u > 0 else 0.5 - half


@njit(cache=True)
def _fill(
    position: Float[np.ndarray, "n 3"],
    weight: Float32[np.ndarray, "n"],
    shade: Float32[np.ndarray, "n"],
    depth: Float[np.ndarray, "n"],
    bricks: Int[np.ndarray, "3"],
    hidden: float,
) -> tuple[Float32[np.ndarray, "b 8 8 8 5"], Int[np.ndarray, "x y z"]]:
    """Accumulate the columns at the vertices; lengths in units of the spacing.

    Serial, so that the order of the floating-point sums is always the same.

    Below a step of the ground a vertex is in the snow of the lower column and under the ground of
    the higher one. By the mean height of both, deep snow would have holes at the foot of stones,
    kerbs and tufts, so what is far underground (`UNDERGROUND`) counts less.

    Args:
        position: deposits relative to the lattice's corner.
        weight: filled fraction per deposit.
        shade: brightness per deposit; NaN: unknown.
        depth: thickness of the snow per deposit.
        bricks: number of bricks along each axis.
        hidden: weight of columns that are far underground in mean heights, 1 or less.

    Returns:
        For each occupied brick, sums at its vertices of: the filled fraction f; weighted f times
        height above the ground; f of deposits with known brightness; that f times brightness;
        weighted f. And the index of the brick at each (x, y, z), -1: none.
    """
    size = (bricks[0] * BRICK, bricks[1] * BRICK, bricks[2] * BRICK)
    core = np.full((bricks[0], bricks[1], bricks[2]), -1, np.int32)
    sums = np.zeros((0, BRICK, BRICK, BRICK, 5), np.float32)
    for phase in range(2):  # 0: count the bricks; 1: fill them
        used = 0
        for r in range(position.shape[0]):
            if weight[r] <= 0:
                continue
            x, y, z = position[r, 0], position[r, 1], position[r, 2]
            first = max(math.ceil(z - _BURIAL - _BLUR), 0)
            last = min(math.floor(z + depth[r] + _BLUR), size[2] - 1)
            for a in range(2):
                i = math.floor(x) + a
                if i < 0 or i >= size[0]:
                    continue
                tent_x = 1 - abs(x - i)
                for b in range(2):
                    j = math.floor(y) + b
                    if j < 0 or j >= size[1]:
                        continue
                    tent = tent_x * (1 - abs(y - j)) * weight[r]
                    if tent <= 0:
                        continue
                    if phase == 0:
                        for m in range(first // BRICK, last // BRICK + 1):
                            if core[i // BRICK, j // BRICK, m] < 0:
                                core[i // BRICK, j // BRICK, m] = used
                                used += 1
                        continue
                    for m in range(first, last + 1):
                        fraction = tent * (
                            _integrated_spline(z + depth[r] - m)
                            - _integrated_spline(z - _BURIAL - m)
                        )
                        row = sums[
                            core[i // BRICK, j // BRICK, m // BRICK],
                            i % BRICK,
                            j % BRICK,
                            m % BRICK,
                        ]
                        row[0] += fraction
                        below = (z - m - UNDERGROUND[0]) / (UNDERGROUND[1] - UNDERGROUND[0])
                        counted = fraction * (1 - (1 - hidden) * min(max(below, 0.0), 1.0))
                        row[1] += counted * (m - z)
                        row[4] += counted
                        if not math.isnan(shade[r]):
                            row[2] += fraction
                            row[3] += fraction * shade[r]
        if phase == 0:
            sums = np.zeros((used, BRICK, BRICK, BRICK, 5), np.float32)
    return sums, core


def _assemble(
    sums: Float32[np.ndarray, "b 8 8 8 5"],
    core: Int[np.ndarray, "x y z"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Quantise the vertices and store with each brick the adjacent vertices of its neighbours.

    Returns:
        Brick table [x, y, z] (-1: empty), and `fill`, `height` and `shade` of `Lattice`.
    """
    from scipy import ndimage

    shaded = float(sums[..., 2].sum(dtype=np.float64))
    default_shade = float(sums[..., 3].sum(dtype=np.float64)) / shaded if shaded > 0 else SHADE_UNIT
    vertices = _quantise(sums, default_shade)
    near = ndimage.binary_dilation(core >= 0, np.ones((3, 3, 3), bool))
    cells = np.argwhere(near)
    fill, height, shade = _gather(cells, core, *vertices)
    occupied = fill.any((1, 2, 3))
    table = np.full(core.shape, -1, np.int32)
    table[tuple(cells[occupied].T)] = np.arange(int(occupied.sum()))
    return table, fill[occupied], height[occupied], shade[occupied]


def _quantise(
    sums: Float32[np.ndarray, "b 8 8 8 5"], default_shade: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return filled fraction, height above the ground and brightness in the units of `Lattice`."""
    filled, moment, shaded, brightness, counted = (sums[..., c] for c in range(5))
    # The floors avoid 0/0 at empty vertices, whose values have no weight.
    height = np.clip(moment / np.maximum(counted, 1e-6) / HEIGHT_UNIT, -32000, 32000)
    mean = brightness / np.maximum(shaded, 1e-6)
    shade = np.where(shaded > 1e-6, mean, np.float32(default_shade))
    return (
        np.rint(np.minimum(filled, 1) * 255).astype(np.uint8),
        np.rint(height).astype(np.int16),
        np.rint(np.clip(shade, 0, 1) * 255).astype(np.uint8),
    )


@njit(cache=True)
def _gather(
    cells: Int[np.ndarray, "n 3"],
    core: Int[np.ndarray, "x y z"],
    fill: UInt8[np.ndarray, "b 8 8 8"],
    height: Int[np.ndarray, "b 8 8 8"],
    shade: UInt8[np.ndarray, "b 8 8 8"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Copy the vertices of each brick and the adjacent ones of its neighbours."""
    n = cells.shape[0]
    all_fill = np.zeros((n, STORED, STORED, STORED), np.uint8)
    all_height = np.zeros((n, STORED, STORED, STORED), np.int16)
    all_shade = np.zeros((n, STORED, STORED, STORED), np.uint8)
    for r in range(n):
        for i in range(STORED):
            x = cells[r, 0] * BRICK + i - 1
            for j in range(STORED):
                y = cells[r, 1] * BRICK + j - 1
                for m in range(STORED):
                    z = cells[r, 2] * BRICK + m - 1
                    bx, by, bz = x // BRICK, y // BRICK, z // BRICK
                    if bx < 0 or by < 0 or bz < 0:
                        continue
                    if bx >= core.shape[0] or by >= core.shape[1] or bz >= core.shape[2]:
                        continue
                    b = core[bx, by, bz]
                    if b >= 0:
                        at = (b, x % BRICK, y % BRICK, z % BRICK)
                        all_fill[r, i, j, m] = fill[at]
                        all_height[r, i, j, m] = height[at]
                        all_shade[r, i, j, m] = shade[at]
    return all_fill, all_height, all_shade
