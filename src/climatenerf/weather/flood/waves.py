"""Wind waves: a seeded, periodic, animated slope field that knows its own statistics.

The surface is a sum of plane waves (Fournier and Reeves 1986; Tessendorf) with the spectrum of
`weather.spectrum`, made by FFT on periodic tiles, each of which carries one band of wavenumbers.
Slope maps are filtered with distance, and the slope variance that a lookup does not show is
returned with it, so that the reflection's lobe and the Fresnel term can take it over.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Complex, Float, Int64
from torch import Tensor

from climatenerf.core.device import to_device
from climatenerf.weather.flood.spectrum import (
    LOWEST,
    MAX_CUTOFF,
    cox_munk,
    cutoff_wavenumber,
    dispersion,
    log_axis,
    peak_frequency,
    peak_wavenumber,
    spreading,
    wavenumber_spectrum,
)
from climatenerf.weather.parameters import Flood

_CYCLES = 8  # longest wave of a tile, in waves per tile
_RATIO = 5  # length of a tile over that of the next finer one
_MAX_TILES = 4
_SAMPLES = 8  # of the finest tile per wave of the cutoff: bilinear slopes then look smooth


@dataclass(frozen=True)
class WaveTile:
    """One band of the spectrum on a periodic square of N x N points, rows along +y.

    Attributes:
        length: side of the tile, m.
        k: wave vectors (x, y), rad/m.
        omega: frequency of each wave, rad/s.
        forward: amplitude of exp(i(k.x - omega t)), m.
        backward: amplitude of exp(i(k.x + omega t)), m; makes the surface real.
        total: slope variance per axis of all waves, mean over time.
        kept: what of it level l of the mip pyramid still shows.
        shared: covariance per axis of levels l and l + 1.
    """

    length: float
    k: Float[Tensor, "n n 2"]
    omega: Float[Tensor, "n n"]
    forward: Complex[Tensor, "n n"]
    backward: Complex[Tensor, "n n"]
    total: float
    kept: Float[Tensor, "levels"]
    shared: Float[Tensor, "levels"]


@dataclass(frozen=True)
class Waves:
    """A wind sea; without tiles it is flat.

    Attributes:
        tiles: bands of the spectrum, coarse to fine.
        unresolved: slope variance per axis of waves finer than all tiles.
        scale: lengths are this many times, durations sqrt of it times as large as the spectrum's.
        significant_height: 4 sqrt(m0) of the resolved waves, scale included, m.
        mean_square_slope: of the resolved waves, both axes together.
        cutoff: k_c, rad/m before scaling.
    """

    tiles: tuple[WaveTile, ...]
    unresolved: float = 0.0
    scale: float = 1.0
    significant_height: float = 0.0
    mean_square_slope: float = 0.0
    cutoff: float = 0.0


@dataclass(frozen=True)
class WaveFrame:
    """Waves at one moment: for each tile its pyramid of slope maps, flattened level after level."""

    waves: Waves
    pyramids: tuple[Complex[Tensor, "texels"], ...]


def make_waves(flood: Flood, seed: int, n: int = 256) -> Waves:
    """Draw the waves of a flood.

    Args:
        flood: wind, fetch, depth and scale.
        seed: of the amplitudes; the same seed gives the same waves.
        n: points along each side of a tile, a power of two.

    Returns:
        The waves; flat when there is no wind, or too little for any wave longer than a centimetre.
    """
    if flood.wind_speed < 1e-3:
        return Waves(())
    lowest = LOWEST * peak_wavenumber(flood)
    cutoff = cutoff_wavenumber(flood)
    if lowest > 2 * MAX_CUTOFF:
        return Waves(())
    # Finest tile: `_SAMPLES` points per wave of the cutoff, if the tiles reach that far from the
    # peak.
    reach = lowest * (n / _SAMPLES / _CYCLES) * _RATIO ** (_MAX_TILES - 1)
    finest = min(cutoff, reach)
    lengths = [n / _SAMPLES * 2 * math.pi / finest]
    while 2 * math.pi * _CYCLES / lengths[0] > lowest * 1.001 and len(lengths) < _MAX_TILES:
        lengths.insert(0, lengths[0] * _RATIO)
    starts = [0.0] + [2 * math.pi * _CYCLES / length for length in lengths[1:]]
    edges = [*starts, 2 * finest]
    generator = torch.Generator().manual_seed(seed)
    tiles = tuple(
        make_tile(flood, length, edges[i : i + 2], cutoff, generator, n)
        for i, length in enumerate(lengths)
    )
    k = log_axis(flood)
    k = k[k <= edges[-1]]
    energy = wavenumber_spectrum(k, flood, cutoff) * k
    slope = float(np.trapezoid(k**2 * energy, np.log(k)))
    height = 4 * math.sqrt(float(np.trapezoid(energy, np.log(k)))) * flood.wave_scale
    unresolved = max(cox_munk(flood.wind_speed) - slope, 0.0) / 2
    return Waves(tiles, unresolved, flood.wave_scale, height, slope, cutoff)


def make_tile(
    flood: Flood,
    length: float,
    band: list[float],
    cutoff: float,
    generator: torch.Generator,
    n: int = 256,
) -> WaveTile:
    """Draw the waves with |k| in `band` (rad/m, half open) on a tile of `length` metres."""
    index = np.fft.fftfreq(n) * n
    kx, ky = np.meshgrid(2 * math.pi * index / length, 2 * math.pi * index / length)
    k = np.hypot(kx, ky)
    omega = dispersion(k, flood.depth)
    # The wind blows from its compass direction; waves run with it.
    heading = math.atan2(-math.cos(flood.wind_direction), -math.sin(flood.wind_direction))
    angle = np.angle(np.exp(1j * (np.arctan2(ky, kx) - heading)))
    share = spreading(omega / peak_frequency(flood.wind_speed, flood.fetch), angle)
    energy = wavenumber_spectrum(k, flood, cutoff) * share / np.maximum(k, 1e-9)
    # Waves at the Nyquist index have no mirror image, so a real surface cannot hold them.
    inside = (k >= band[0]) & (k < band[1]) & (k > 0)
    inside &= (np.abs(index) < n // 2)[:, None] & (np.abs(index) < n // 2)
    deviation = np.sqrt(np.where(inside, energy, 0) / 2) * 2 * math.pi / length
    noise = torch.randn(n, n, dtype=torch.complex128, generator=generator, device="cpu")
    forward = noise * torch.from_numpy(deviation)  # torch's complex normal has E|z|^2 = 1
    backward = forward.flip(0, 1).roll((1, 1), (0, 1)).conj().resolve_conj()
    power = (forward.abs() ** 2 + backward.abs() ** 2).numpy()  # mean over time of |h(k, t)|^2
    slope_power = k**2 * power / 2
    kept, shared = _level_variances(slope_power, kx, ky, length)
    return WaveTile(
        length,
        to_device(np.stack([kx, ky], axis=-1)).float(),
        to_device(omega),
        forward.to(torch.get_default_device(), torch.complex64),
        backward.to(torch.get_default_device(), torch.complex64),
        float(slope_power.sum()),
        to_device(kept).float(),
        to_device(shared).float(),
    )


def _level_variances(
    slope_power: Float[np.ndarray, "n n"],
    kx: Float[np.ndarray, "n n"],
    ky: Float[np.ndarray, "n n"],
    length: float,
) -> tuple[Float[np.ndarray, "levels"], Float[np.ndarray, "levels"]]:
    """Slope variance that each level shows, and its covariance with the next; per axis.

    Includes what bilinear interpolation takes: (2 + cos)/3 per axis of the variance of a wave, and
    sinc^2 of its amplitude where two levels are mixed.
    """
    n = len(slope_power)
    levels = int(math.log2(n)) + 1
    kept, coherent = np.zeros(levels), []
    for level in range(levels):
        texel = length / (n >> level)
        inside = np.maximum(abs(kx), abs(ky)) < math.pi / texel * (1 - 1e-9)
        blur = np.where(inside, _blur(kx**2 + ky**2, texel, level), 0)
        lost = (2 + np.cos(kx * texel)) * (2 + np.cos(ky * texel)) / 9
        kept[level] = (slope_power * blur**2 * lost).sum()
        phase = texel / (2 * math.pi)
        coherent.append(blur * (np.sinc(kx * phase) * np.sinc(ky * phase)) ** 2)
    pairs = zip(coherent, [*coherent[1:], 0 * kx], strict=True)
    return kept, np.array([(slope_power * a * b).sum() for a, b in pairs])


def _blur(k2: np.ndarray, texel: float, level: int) -> np.ndarray:
    """Transfer of the Gaussian, half a texel in deviation, that makes a level; none at level 0."""
    return np.exp(-k2 * (0.5 * texel) ** 2 / 2) if level else np.ones_like(k2)


def at_time(waves: Waves, time: float) -> WaveFrame:
    """Slope maps of all tiles at `time` seconds: once a frame, before any lookup."""
    time = time / math.sqrt(waves.scale)  # Froude: waves s times as long take sqrt(s) times as long
    return WaveFrame(waves, tuple(_pyramid(tile, time) for tile in waves.tiles))


def amplitudes(tile: WaveTile, time: float) -> Complex[Tensor, "n n"]:
    """Amplitude of every wave of the tile at `time` seconds (unscaled), m; Hermitian."""
    phase = tile.omega * time  # float64: stays exact for hours
    turn = torch.polar(torch.ones_like(phase), phase).to(tile.forward.dtype)
    return tile.forward * turn.conj() + tile.backward * turn


def heights(waves: Waves, index: int, time: float) -> Float[Tensor, "n n"]:
    """Heights of tile `index` in m at `time` seconds, rows along +y, sides `length * scale` m."""
    spectrum = amplitudes(waves.tiles[index], time / math.sqrt(waves.scale))
    return torch.fft.ifft2(spectrum, norm="forward").real * waves.scale


def _pyramid(tile: WaveTile, time: float) -> Complex[Tensor, "texels"]:
    """Slope maps, x slope + i y slope, from N x N down to 1 x 1, flattened."""
    # Both slopes are real, so one complex FFT makes both: i kx h + i (i ky h).
    spectrum = amplitudes(tile, time) * torch.complex(-tile.k[..., 1], tile.k[..., 0])
    k2 = (tile.k**2).sum(-1)
    n, maps = len(spectrum), []
    for level in range(len(tile.kept)):
        size = n >> level
        half = size // 2
        if half < 2:  # the only wave left is the mean, and the mean slope is 0
            maps.append(spectrum.new_zeros(size * size))
            continue
        rows = torch.cat([torch.arange(half), torch.arange(n - half, n)]).to(spectrum.device)
        part = spectrum[rows][:, rows]
        if level:
            part = part * torch.exp(-k2[rows][:, rows] * (0.5 * tile.length / size) ** 2 / 2)
        part[half], part[:, half] = 0, 0  # the Nyquist index has no mirror image
        maps.append(torch.fft.ifft2(part, norm="forward").flatten())
    return torch.cat(maps)


def slopes(
    frame: WaveFrame, x: Float[Tensor, "n 2"], footprint: Float[Tensor, "n"]
) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n"]]:
    """Slope of the water at points, filtered to the size of a pixel.

    Args:
        frame: the waves at one moment.
        x: horizontal world position, m.
        footprint: width of the pixel on the water, m, >= 0.

    Returns:
        Slope (dz/dx, dz/dy), and the slope variance per axis that it leaves out: what filtering
        removed and what no tile resolves, >= 0.
    """
    slope = torch.zeros_like(x)
    removed = torch.full_like(footprint, frame.waves.unresolved)
    for tile, pyramid in zip(frame.waves.tiles, frame.pyramids, strict=True):
        top = len(tile.kept) - 1
        texel = tile.length * frame.waves.scale / (1 << top)
        exact = torch.log2((footprint / texel).clamp(1, 1 << top))
        level = exact.floor().long().clamp(max=top - 1)
        mix = exact - level
        u = x / (tile.length * frame.waves.scale)
        fine = _bilinear(pyramid, u, level, top)
        coarse = _bilinear(pyramid, u, level + 1, top)
        slope = slope + torch.lerp(fine, coarse, mix[:, None])
        kept, shared = tile.kept, tile.shared
        shown = (1 - mix) ** 2 * kept[level] + mix**2 * kept[level + 1]
        shown = shown + 2 * mix * (1 - mix) * shared[level]
        removed = removed + (tile.total - shown).clamp(min=0)
    return slope, removed


def _bilinear(
    pyramid: Complex[Tensor, "texels"], u: Float[Tensor, "n 2"], level: Int64[Tensor, "n"], top: int
) -> Float[Tensor, "n 2"]:
    """Interpolate a level at `u` (tiles of side 1, repeating)."""
    size = torch.bitwise_left_shift(torch.ones_like(level), top - level)
    # Texels before a level: 4^top + ... down to the level before it.
    start = ((4 << (2 * top)) - 4 * size**2) // 3
    position = (u - u.floor()) * size[:, None]
    corner = position.floor()
    fx, fy = (position - corner).unbind(-1)
    i, j = (corner.long() % size[:, None]).unbind(-1)  # u just below 0 may round up to size
    i1, j1 = (i + 1) % size, (j + 1) % size
    maps = torch.view_as_real(pyramid)
    row, row1 = start + j * size, start + j1 * size
    a, b, c, d = (maps.index_select(0, n) for n in (row + i, row + i1, row1 + i, row1 + i1))
    fx, fy = fx[:, None], fy[:, None]
    return torch.lerp(torch.lerp(a, b, fx), torch.lerp(c, d, fx), fy)
