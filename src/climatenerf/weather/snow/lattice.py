"""From places where snow lands to metaballs: slabs of snow, prefiltered onto a sparse lattice.

Each deposit fills the column around it from below the ground up to the requested depth over it.
How much of a vertex's surroundings is filled is integrated, not sampled: a tent of one spacing in
x and y, a quadratic B-spline along z. So the thickness does not depend on how the lattice lies.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8
from numba import njit

from climatenerf.ops.cpu.metaballs import (
    BRICK,
    HEIGHT_UNIT,
    REACH,
    STORED,
    Lattice,
    where_matter_is,
)

_BLUR = 1.5  # half-width of the vertical prefilter in spacings
# A slab buried by the kernel's and the prefilter's reach looks like a half-space from its top.
_BURIAL = REACH + _BLUR
_BELOW, _ABOVE = 20.0, 40.0  # m; ground this far under and over the cameras can carry snow
_PATCHY = 0.01  # m; thinner snow is a dusting that does not cover everything


@dataclass(frozen=True)
class SnowGrid:
    """Where snow is simulated, and how finely."""

    centre: tuple[float, float]
    """x and y of the middle, m."""
    z_range: tuple[float, float]
    """Lowest and highest ground that can carry snow, m."""
    spacing: float
    """Of the innermost cascade's lattice, m; each further one has twice the spacing and side."""
    half_cells: int
    """Cells from the middle to a side; the same for every cascade; a multiple of 16."""
    cascades: int = 1

    def __post_init__(self) -> None:
        if self.half_cells % (2 * BRICK) or self.half_cells <= 0 or self.cascades < 1:
            raise ValueError("half_cells must be a positive multiple of 16, cascades at least 1")

    def spacing_of(self, cascade: int) -> float:
        """Lattice spacing of a cascade, m."""
        return self.spacing * 2**cascade

    def half_side(self, cascade: int) -> float:
        """Half the side of a cascade's square, m."""
        return self.half_cells * self.spacing_of(cascade)


@dataclass(frozen=True)
class Deposits:
    """Where snow lands; needs the scene, but not the depth of the snow."""

    grid: SnowGrid
    position: Float32[np.ndarray, "n 3"]
    """On the surface that catches the snow, m."""
    weight: Float32[np.ndarray, "n"]
    """Share of the snow that stays, 0 to 1."""
    shade: Float32[np.ndarray, "n"]
    """Brightness of snow there under the scene's light, 0 to 1; NaN: not known here."""
    cascade: Int[np.ndarray, "cascades+1"]
    """Deposits of cascade k are cascade[k]:cascade[k + 1]."""
    passes: Int[np.ndarray, "cascades"]
    """Fall directions in each cascade; each lands one deposit per cell."""


def choose_grid(
    lower: Float[np.ndarray, "3"],
    upper: Float[np.ndarray, "3"],
    cameras: Float[np.ndarray, "m 3"],
) -> SnowGrid:
    """A grid that is fine near the cameras and reaches to the scene's bounds.

    Args:
        lower: corner of the region that holds anything, m.
        upper: the opposite corner, m.
        cameras: camera positions of the path, m.

    Returns:
        Spacing 3 to 6 cm, wider only where the path itself spans more than some 40 m.
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
    # Beyond the fifth the lattice is so coarse, and so far away, that snow there shows no shape.
    return SnowGrid(
        (float(centre[0]), float(centre[1])),
        (max(float(lower[2]), low[2] - _BELOW), min(float(upper[2]), high[2] + _ABOVE)),
        spacing,
        half_cells,
        min(cascades, 5),
    )


def grow(deposits: Deposits, depth: float) -> Lattice:
    """Let snow of a given depth lie on the deposits.

    Args:
        deposits: where snow lands.
        depth: thickness over open ground, m. Under 1 cm the cover gets patchy and then vanishes.

    Returns:
        The lattice; nothing in it (no bricks) where nothing lands.
    """
    grid = deposits.grid
    fade = min(max(depth / _PATCHY, 0.0), 1.0)
    cover = fade * fade * (3 - 2 * fade)
    lower, bricks, index, pool = [], [], [], []
    used = 0
    for k in range(grid.cascades):
        part = slice(int(deposits.cascade[k]), int(deposits.cascade[k + 1]))
        h, half = grid.spacing_of(k), grid.half_side(k)
        # Room for the buried and the fallen snow, and a brick around for the balls' reach.
        bottom = grid.z_range[0] - (_BURIAL + _BLUR + BRICK) * h
        top = grid.z_range[1] + depth + (_BLUR + BRICK) * h
        side = 2 * grid.half_cells // BRICK + 2
        count = np.array([side, side, math.ceil((top - bottom) / (h * BRICK))], np.int64)
        margin = half + BRICK * h
        corner = np.array([grid.centre[0] - margin, grid.centre[1] - margin, bottom])
        position = (deposits.position[part].astype(np.float64) - corner) / h
        weight = deposits.weight[part] * np.float32(cover / deposits.passes[k])
        sums, core = _fill(position, weight, deposits.shade[part], depth / h, count)
        table, fill, height, shade = _assemble(sums, core, count)
        index.append(np.where(table >= 0, table + used, -1).astype(np.int32).reshape(-1))
        pool.append((fill, height, shade))
        used += fill.shape[0]
        lower.append(corner)
        bricks.append(count)
    sizes = [part.size for part in index]
    spacing = np.array([grid.spacing_of(k) for k in range(grid.cascades)])
    fill = np.concatenate([p[0] for p in pool])
    band, near = where_matter_is(fill)
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
        # Deep enough to leave no gap to a rough ground, too little to show under a table.
        burial=np.clip(0.5 * spacing, 0.02, 0.04),
    )


@njit(cache=True)
def _ramp(u: float) -> float:
    """Share of a quadratic B-spline (unit knots, centred on 0) that lies below u."""
    a = min(abs(u), 1.5)
    half = 0.75 * a - a**3 / 3 if a < 0.5 else 0.5 - (1.5 - a) ** 3 / 6
    return 0.5 + half if u > 0 else 0.5 - half


@njit(cache=True)
def _fill(
    position: Float[np.ndarray, "n 3"],
    weight: Float32[np.ndarray, "n"],
    shade: Float32[np.ndarray, "n"],
    depth: float,
    bricks: Int[np.ndarray, "3"],
) -> tuple[Float32[np.ndarray, "b 8 8 8 4"], Int[np.ndarray, "x y z"]]:
    """Spread the slabs over the vertices, in units of the spacing.

    One thread, so the order of the sums, and with it the last bit, is always the same.

    Returns:
        for each brick that is touched, sums at its vertices of: filling; filling times height over
        the ground; filling where brightness is known; filling times brightness. And the bricks'
        numbers, -1 where there is none.
    """
    size = (bricks[0] * BRICK, bricks[1] * BRICK, bricks[2] * BRICK)
    core = np.full((bricks[0], bricks[1], bricks[2]), -1, np.int32)
    sums = np.zeros((0, BRICK, BRICK, BRICK, 4), np.float32)
    for phase in range(2):  # find the bricks first, then fill them
        used = 0
        for r in range(position.shape[0]):
            if weight[r] <= 0:
                continue
            x, y, z = position[r, 0], position[r, 1], position[r, 2]
            first = max(math.ceil(z - _BURIAL - _BLUR), 0)
            last = min(math.floor(z + depth + _BLUR), size[2] - 1)
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
                        share = tent * (_ramp(z + depth - m) - _ramp(z - _BURIAL - m))
                        row = sums[
                            core[i // BRICK, j // BRICK, m // BRICK],
                            i % BRICK,
                            j % BRICK,
                            m % BRICK,
                        ]
                        row[0] += share
                        row[1] += share * (m - z)
                        if not math.isnan(shade[r]):
                            row[2] += share
                            row[3] += share * shade[r]
        if phase == 0:
            sums = np.zeros((used, BRICK, BRICK, BRICK, 4), np.float32)
    return sums, core


def _assemble(
    sums: Float32[np.ndarray, "b 8 8 8 4"],
    core: Int[np.ndarray, "x y z"],
    bricks: Int[np.ndarray, "3"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Quantise the vertices and copy to each brick what it needs of its neighbours."""
    known = float(sums[..., 2].sum(dtype=np.float64))
    # Without any known brightness (no deposit in this cascade) the value is never seen.
    typical = float(sums[..., 3].sum(dtype=np.float64)) / known if known > 0 else 1.0
    vertices = _quantise(sums, typical)
    near = core >= 0
    for axis in range(3):
        wide = near.copy()
        ahead, behind = [slice(None)] * 3, [slice(None)] * 3
        ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
        wide[tuple(ahead)] |= near[tuple(behind)]
        wide[tuple(behind)] |= near[tuple(ahead)]
        near = wide
    places = np.argwhere(near)
    fill, height, shade = _gather(places, core, *vertices)
    touched = fill.any((1, 2, 3))
    table = np.full(core.shape, -1, np.int32)
    table[tuple(places[touched].T)] = np.arange(int(touched.sum()))
    return table, fill[touched], height[touched], shade[touched]


def _quantise(
    sums: Float32[np.ndarray, "b 8 8 8 4"], typical: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Filled fraction, height over the ground and brightness in the units of `Lattice`."""
    filled, moment, known, bright = (sums[..., c] for c in range(4))
    # Empty vertices (0 / 0 would give NaN) are never seen: they weigh nothing.
    height = np.clip(moment / np.maximum(filled, 1e-6) / HEIGHT_UNIT, -32000, 32000)
    shade = np.where(known > 1e-6, bright / np.maximum(known, 1e-6), np.float32(typical))
    return (
        np.rint(np.minimum(filled, 1) * 255).astype(np.uint8),
        np.rint(height).astype(np.int16),
        np.rint(np.clip(shade, 0, 1) * 255).astype(np.uint8),
    )


@njit(cache=True)
def _gather(
    places: Int[np.ndarray, "n 3"],
    core: Int[np.ndarray, "x y z"],
    fill: UInt8[np.ndarray, "b 8 8 8"],
    height: Int[np.ndarray, "b 8 8 8"],
    shade: UInt8[np.ndarray, "b 8 8 8"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    n = places.shape[0]
    all_fill = np.zeros((n, STORED, STORED, STORED), np.uint8)
    all_height = np.zeros((n, STORED, STORED, STORED), np.int16)
    all_shade = np.zeros((n, STORED, STORED, STORED), np.uint8)
    for r in range(n):
        for i in range(STORED):
            x = places[r, 0] * BRICK + i - 1
            for j in range(STORED):
                y = places[r, 1] * BRICK + j - 1
                for m in range(STORED):
                    z = places[r, 2] * BRICK + m - 1
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
