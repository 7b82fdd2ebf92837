"""Rays against a water surface z = level + h(x, y). No gradients.

h is anything that answers `Heights`. Wind waves are `WaveMaps`, a sum of periodic tiles: each has
maps of its heights and slopes, each filtered to ever coarser texels (a mip pyramid), so a lookup at
the size of a pixel costs the same at any distance. It also says which variance of slopes the filter
has removed. Waves have a CPU kernel; any other h is met by tensor operations.

Rays are followed through the layer that holds all crests and troughs, in steps of half a pixel, or
of a sixty-fourth of the way if that is more. The first crossing is refined by regula falsi.
"""

from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from climatenerf.ops import dispatch

STEPS = 64  # along a ray's way through the layer, at most
STEP = 0.5  # pixels
REFINED = 4  # iterations of regula falsi (Illinois)
REACH = 50.0  # m through the layer of the waves; beyond, rays meet the mean surface
NEAR = 3.0  # m; an eye among the waves sees those of this distance sharply
FLAT = 1e-5  # m; lower waves do not move the surface
GRAZING = 1e-4  # of a direction's z: pixels on the water stay finite


class Heights(Protocol):
    """Heights h of a water surface over its level, at one moment."""

    @property
    def still(self) -> bool:
        """Whether h is 0 everywhere and no slope is filtered out."""
        ...

    def crest(self) -> float:
        """No crest is higher and no trough deeper than this, m."""
        ...

    def crest_of(self, footprint: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
        """Return the same for heights filtered to pixels of a size on the water, m."""
        ...

    def at(
        self, x: Float[Tensor, "n 2"], footprint: Float[Tensor, "n"]
    ) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 2"], Float[Tensor, "n"]]:
        """Return height over the level (m), slope (dz/dx, dz/dy), and removed slope variance.

        Args:
            x: horizontal world position, m.
            footprint: size of a pixel on the water, m, >= 0, to which the surface is filtered.
        """
        ...


@dataclass(frozen=True)
class WaveMaps:
    """Heights and slopes of water at one moment.

    Attributes:
        texels: height (m) and slope (dz/dx, dz/dy); for each tile the levels of its pyramid from
            fine to coarse, rows along +y.
        start: first texel of each tile.
        side: of each tile, m.
        top: levels of a pyramid, without the finest.
        slope_variance: per axis, of each tile.
        level_variance: of each tile's levels.
        level_covariance: between levels l and l + 1.
        highest: largest height of each tile's levels, m.
        unresolved: slope variance per axis of waves shorter than any tile resolves.
    """

    texels: Float[Tensor, "t 3"]
    start: Int64[Tensor, "k"]
    side: Float[Tensor, "k"]
    top: int
    slope_variance: Float[Tensor, "k"]
    level_variance: Float[Tensor, "k l"]
    level_covariance: Float[Tensor, "k l"]
    highest: Float[Tensor, "k l"]
    unresolved: float

    def crest(self) -> float:
        """No crest is higher and no trough deeper than this, m."""
        return float(self.highest[:, 0].sum()) if self.start.numel() else 0.0

    @property
    def still(self) -> bool:
        """Whether there are no waves."""
        return not self.start.numel() and self.unresolved == 0

    def crest_of(self, footprint: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
        """Largest height of waves filtered to pixels of a size on the water (m), m."""
        total = torch.zeros_like(footprint)
        for k in range(self.start.numel()):
            level, mix = _level(self, k, footprint)
            total = total + torch.lerp(self.highest[k][level], self.highest[k][level + 1], mix)
        return total

    def at(
        self, x: Float[Tensor, "n 2"], footprint: Float[Tensor, "n"]
    ) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 2"], Float[Tensor, "n"]]:
        """Return height over the level (m), slope, and the slope variance the filter removed.

        Args:
            x: horizontal world position, m.
            footprint: size of a pixel on the water, m, >= 0.
        """
        found = torch.zeros(*footprint.shape, 3, device=x.device, dtype=x.dtype)
        removed = torch.full_like(footprint, self.unresolved)
        for k in range(self.start.numel()):
            level, mix = _level(self, k, footprint)
            u = x / self.side[k]
            fine = _bilinear(self, k, u, level)
            coarse = _bilinear(self, k, u, level + 1)
            found = found + torch.lerp(fine, coarse, mix[:, None])
            variance, covariance = self.level_variance[k], self.level_covariance[k]
            filtered = (1 - mix) ** 2 * variance[level] + mix**2 * variance[level + 1]
            filtered = filtered + 2 * mix * (1 - mix) * covariance[level]
            removed = removed + (self.slope_variance[k] - filtered).clamp(min=0)
        return found[:, 0], found[:, 1:], removed


@dataclass(frozen=True)
class WaveHits:
    """Where rays meet the water."""

    t: Float[Tensor, "n"]
    """Ray length, m; +inf without a hit."""
    slope: Float[Tensor, "n 2"]
    """Slope (dz/dx, dz/dy) there, filtered to the pixel; 0 without a hit."""
    variance: Float[Tensor, "n"]
    """Slope variance per axis that the filter has removed."""


def first_hits(
    heights: Heights,
    level: float,
    rays_o: Float[Tensor, "n 3"],
    rays_d: Float[Tensor, "n 3"],
    below: Bool[Tensor, "n"],
    pixel_angle: Float[Tensor, "n"],
) -> WaveHits:
    """Find where rays first meet the water.

    Args:
        heights: of the surface over its level.
        level: height of the mean surface, m.
        rays_o: origins, m.
        rays_d: unit directions.
        below: whether the origins are under water.
        pixel_angle: angle that a pixel spans, rad; waves shorter than the pixel are filtered out.
    """
    if not isinstance(heights, WaveMaps):
        return _first_hits(heights, level, rays_o, rays_d, below, pixel_angle)
    maps = heights
    if dispatch.backend(maps.texels, rays_o, rays_d, pixel_angle) == "cpu":
        from climatenerf.ops.cpu import wave_tracing as kernels

        found = WaveHits(
            torch.empty_like(pixel_angle),
            torch.empty(len(rays_o), 2, device=rays_o.device),
            torch.empty_like(pixel_angle),
        )
        tables = (maps.texels, maps.start, maps.side, maps.slope_variance, maps.level_variance)
        tables = (*tables, maps.level_covariance, maps.highest)
        given = dispatch.kernel_arrays(rays_o, rays_d, below.to(torch.uint8), pixel_angle)
        results = dispatch.kernel_arrays(found.t, found.slope, found.variance)
        kernels.first_hits(
            dispatch.kernel_arrays(*tables), maps.top, maps.unresolved, level, given, results
        )
        return found
    return _first_hits(maps, level, rays_o, rays_d, below, pixel_angle)


def _first_hits(
    heights: Heights,
    level: float,
    rays_o: Tensor,
    rays_d: Tensor,
    below: Tensor,
    pixel_angle: Tensor,
) -> WaveHits:
    """All rays together, on any device: as the kernel in `ops.cpu.wave_tracing`."""
    side = torch.where(below, -1.0, 1.0).to(rays_o)
    over, climb = side * (rays_o[:, 2] - level), side * rays_d[:, 2]
    falls = climb < 0
    flat = torch.where(falls, -over / torch.where(falls, climb, -torch.ones_like(climb)), REACH)
    among = over.abs() < heights.crest()
    distance = torch.where(among, flat.clamp(0, NEAR), flat.clamp_min(0))
    footprint = distance * pixel_angle / rays_d[:, 2].abs().clamp_min(GRAZING).sqrt()
    crest = heights.crest_of(footprint)
    # 1e-9: a level ray leaves the layer nowhere, x/0.
    safe = torch.where(climb.abs() < 1e-9, torch.full_like(climb, 1e-9), climb)
    first, last = (crest - over) / safe, (-crest - over) / safe
    begin = torch.minimum(first, last).clamp_min(0)
    end = torch.minimum(torch.maximum(first, last), begin + REACH)
    level_surface = crest <= FLAT
    none = torch.where(level_surface, ~falls | (over <= 0), ~falls & (over >= crest))
    none |= ~level_surface & falls & (end <= 0)
    run = rays_d[:, :2].norm(dim=-1)
    # 1e-4 m: a pixel that sees no surface.
    steps = ((end - begin) * run / (STEP * footprint.clamp_min(1e-4))).ceil().clamp(1, STEPS)

    def above(t: Tensor) -> Tensor:
        x = rays_o[:, :2] + t[:, None] * rays_d[:, :2]
        return over + climb * t - side * heights.at(x, footprint)[0]

    low, high = begin.clone(), end.clone()
    f_low = above(begin)
    met = f_low <= 0
    high = torch.where(met, begin, high)
    f_high = torch.where(met, f_low, above(end))
    open_ = ~met
    t, f = begin, f_low
    for k in range(1, STEPS + 1):
        share = k / steps
        # An eye among the waves needs short steps first.
        share = torch.where(among, share * share, share)
        t_next = torch.minimum(begin + (end - begin) * share, end)
        f_next = above(t_next)
        crossed = open_ & (f_next <= 0)
        low, f_low = torch.where(crossed, t, low), torch.where(crossed, f, f_low)
        high, f_high = torch.where(crossed, t_next, high), torch.where(crossed, f_next, f_high)
        open_ &= ~crossed & (k < steps)
        met |= crossed
        t, f = t_next, f_next
    # One more than the kernel: in single precision a hundredth of the hits was 1 mm off.
    for _ in range(REFINED + 1):
        # 1e-12: equal heights at both ends, 0/0.
        share = (f_low / (f_low - f_high).clamp_min(1e-12)).clamp(0, 1)
        t = low + share * (high - low)
        f = above(t)
        under = f <= 0
        high, f_high_new = torch.where(under, t, high), torch.where(under, f, f_high * 0.5)
        low, f_low_new = torch.where(under, low, t), torch.where(under, f_low * 0.5, f)
        f_low, f_high = f_low_new, f_high_new
    far = ~met & falls & (end < torch.maximum(first, last)) & (flat > end)
    t = torch.where(level_surface | far, flat, high)
    missed = none | (~level_surface & ~met & ~far)
    x = rays_o[:, :2] + t[:, None] * rays_d[:, :2]
    _, slope, variance = heights.at(torch.where(missed[:, None], 0.0, x), footprint)
    return WaveHits(
        torch.where(missed, torch.inf, t), torch.where(missed[:, None], 0.0, slope), variance
    )


def _level(
    maps: WaveMaps, k: int, footprint: Float[Tensor, "n"]
) -> tuple[Int64[Tensor, "n"], Float[Tensor, "n"]]:
    """The level of a tile for a pixel, and how much of the next one belongs to it."""
    texel = maps.side[k] / (1 << maps.top)
    exact = torch.log2((footprint / texel).clamp(1, 1 << maps.top))
    level = exact.floor().long().clamp(max=maps.top - 1)
    return level, exact - level


def _bilinear(
    maps: WaveMaps, k: int, u: Float[Tensor, "n 2"], level: Int64[Tensor, "n"]
) -> Float[Tensor, "n 3"]:
    """Interpolate one level of a tile at `u`, in units of the tile's side; periodic."""
    top = maps.top
    size = torch.bitwise_left_shift(torch.ones_like(level), top - level)
    # Texels of all finer levels: 4^top + ... + 4 size^2.
    start = maps.start[k] + ((4 << (2 * top)) - 4 * size**2) // 3
    position = (u - u.floor()) * size[:, None]
    corner = position.floor()
    fx, fy = (position - corner).unbind(-1)
    i, j = (corner.long() % size[:, None]).unbind(-1)  # u just below 0 may round to size
    i1, j1 = (i + 1) % size, (j + 1) % size
    row, row1 = start + j * size, start + j1 * size
    a, b, c, d = (maps.texels.index_select(0, n) for n in (row + i, row + i1, row1 + i, row1 + i1))
    fx, fy = fx[:, None], fy[:, None]
    return torch.lerp(torch.lerp(a, b, fx), torch.lerp(c, d, fx), fy)
