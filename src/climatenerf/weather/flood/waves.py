"""Wind waves: a seeded, periodic, animated slope field with known slope statistics.

The surface is a sum of plane waves (Fournier and Reeves 1986; Tessendorf 2001) with the spectrum of
`weather.flood.spectrum`. An FFT evaluates it on periodic tiles; each tile carries one band of
wavenumbers. Maps of heights and slopes are prefiltered in a mip pyramid. A lookup
(`ops.wave_tracing`) returns the filtered height and slope and the slope variance that the filter
removed; the reflection lobe and the Fresnel term include this variance.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Complex, Float
from torch import Tensor

from climatenerf.core.device import CPU, to_device
from climatenerf.ops.wave_tracing import WaveMaps
from climatenerf.weather.flood.parameters import Flood
from climatenerf.weather.flood.spectrum import (
    MAX_CUTOFF,
    MIN_PEAK_RATIO,
    cox_munk,
    cutoff_wavenumber,
    dispersion,
    log_axis,
    peak_wavenumber,
    spreading,
    wavenumber_spectrum,
)

_CYCLES = 8  # periods of a tile's longest wave along its side
_RATIO = 5  # side of a tile over that of the next finer one
_MAX_TILES = 4
_SAMPLES = 8  # points per wave at the cutoff, on the finest tile: bilinear slopes look smooth


@dataclass(frozen=True)
class WaveTile:
    """One band of the spectrum on a periodic square of N x N points, rows along +y.

    Attributes:
        length: side of the tile, m.
        k: wave vectors (x, y), rad/m.
        omega: angular frequency of each wave, rad/s.
        forward: amplitude of exp(i(k.x - omega t)), m.
        backward: amplitude of exp(i(k.x + omega t)), m; makes the surface real.
        slope_variance: slope variance per axis of all waves, mean over time.
        level_variance: slope variance per axis at each level of the mip pyramid.
        level_covariance: covariance per axis of levels l and l + 1.
    """

    length: float
    k: Float[Tensor, "n n 2"]
    omega: Float[Tensor, "n n"]
    forward: Complex[Tensor, "n n"]
    backward: Complex[Tensor, "n n"]
    slope_variance: float
    level_variance: Float[Tensor, "levels"]
    level_covariance: Float[Tensor, "levels"]


@dataclass(frozen=True)
class Waves:
    """A wind sea; flat if it has no tiles.

    Attributes:
        tiles: bands of the spectrum, coarse to fine.
        unresolved: slope variance per axis of waves shorter than any tile resolves.
        scale: factor on all lengths of the spectrum; durations scale with its square root (Froude).
        significant_height: 4 sqrt(m0) of the resolved waves, scale included, m.
        mean_square_slope: of the resolved waves, both axes together.
        cutoff: k_c before scaling, rad/m.
        device: where they are computed and looked up.
    """

    tiles: tuple[WaveTile, ...]
    unresolved: float = 0.0
    scale: float = 1.0
    significant_height: float = 0.0
    mean_square_slope: float = 0.0
    cutoff: float = 0.0
    device: torch.device = CPU


def make_waves(flood: Flood, seed: int, n: int = 256, device: torch.device = CPU) -> Waves:
    """Sample the random amplitudes of a flood's waves.

    Args:
        flood: wind, fetch, depth and scale.
        seed: random seed of the amplitudes.
        n: points along each side of a tile, a power of two.
        device: where the waves are computed and looked up.

    Returns:
        The waves; flat without wind, or if the wind is too weak for waves longer than a centimetre.
    """
    if flood.wind_speed < 1e-3:
        return Waves((), device=device)
    lowest = MIN_PEAK_RATIO * peak_wavenumber(flood)
    cutoff = cutoff_wavenumber(flood)
    if lowest > 2 * MAX_CUTOFF:
        return Waves((), device=device)
    # The finest tile has `_SAMPLES` points per wave at the cutoff, unless `_MAX_TILES` tiles cannot
    # span the band from the lowest wavenumber to the cutoff.
    highest = lowest * (n / _SAMPLES / _CYCLES) * _RATIO ** (_MAX_TILES - 1)
    finest = min(cutoff, highest)
    lengths = [n / _SAMPLES * 2 * math.pi / finest]
    while 2 * math.pi * _CYCLES / lengths[0] > lowest * 1.001 and len(lengths) < _MAX_TILES:
        lengths.insert(0, lengths[0] * _RATIO)
    starts = [0.0] + [2 * math.pi * _CYCLES / length for length in lengths[1:]]
    edges = [*starts, 2 * finest]
    generator = torch.Generator(device="cpu").manual_seed(seed)
    tiles = tuple(
        make_tile(flood, length, edges[i : i + 2], cutoff, generator, n, device)
        for i, length in enumerate(lengths)
    )
    k = log_axis(flood)
    k = k[k <= edges[-1]]
    energy = wavenumber_spectrum(k, flood, cutoff) * k
    slope = float(np.trapezoid(k**2 * energy, np.log(k)))
    height = 4 * math.sqrt(float(np.trapezoid(energy, np.log(k)))) * flood.wave_scale
    unresolved = max(cox_munk(flood.wind_speed) - slope, 0.0) / 2
    return Waves(tiles, unresolved, flood.wave_scale, height, slope, cutoff, device)


def make_tile(
    flood: Flood,
    length: float,
    band: list[float],
    cutoff: float,
    generator: torch.Generator,
    n: int = 256,
    device: torch.device = CPU,
) -> WaveTile:
    """Sample the waves of one band of wavenumbers on a periodic tile.

    Args:
        flood: wind, fetch and depth.
        length: side of the tile, m.
        band: lowest and highest |k|, rad/m, half open.
        cutoff: cutoff k_c of the spectrum, rad/m.
        generator: CPU generator of the amplitudes.
        n: points along each side, a power of two.
        device: where the tile is stored.
    """
    index = np.fft.fftfreq(n) * n
    kx, ky = np.meshgrid(2 * math.pi * index / length, 2 * math.pi * index / length)
    k = np.hypot(kx, ky)
    omega = dispersion(k, flood.depth)
    # `wind_direction` is where the wind comes from; waves travel downwind.
    heading = math.atan2(-math.cos(flood.wind_direction), -math.sin(flood.wind_direction))
    angle = np.angle(np.exp(1j * (np.arctan2(ky, kx) - heading)))
    per_radian = spreading(omega, angle, flood)
    energy = wavenumber_spectrum(k, flood, cutoff) * per_radian / np.maximum(k, 1e-9)  # k = 0: 0/0
    # The Nyquist frequency has no conjugate partner, so a real surface cannot contain it.
    inside = (k >= band[0]) & (k < band[1]) & (k > 0)
    inside &= (np.abs(index) < n // 2)[:, None] & (np.abs(index) < n // 2)
    deviation = np.sqrt(np.where(inside, energy, 0) / 2) * 2 * math.pi / length
    noise = torch.randn(n, n, dtype=torch.complex128, generator=generator, device="cpu")
    forward = noise * torch.from_numpy(deviation)  # torch's complex normal has E|z|^2 = 1
    backward = forward.flip(0, 1).roll((1, 1), (0, 1)).conj().resolve_conj()
    power = (forward.abs() ** 2 + backward.abs() ** 2).numpy()  # mean over time of |h(k, t)|^2
    slope_power = k**2 * power / 2
    level_variance, level_covariance = _level_variances(slope_power, kx, ky, length)
    return WaveTile(
        length,
        to_device(np.stack([kx, ky], axis=-1), device).float(),
        to_device(omega, device),
        forward.to(device, torch.complex64),
        backward.to(device, torch.complex64),
        float(slope_power.sum()),
        to_device(level_variance, device).float(),
        to_device(level_covariance, device).float(),
    )


def _level_variances(
    slope_power: Float[np.ndarray, "n n"],
    kx: Float[np.ndarray, "n n"],
    ky: Float[np.ndarray, "n n"],
    length: float,
) -> tuple[Float[np.ndarray, "levels"], Float[np.ndarray, "levels"]]:
    """Return the slope variance per axis of each level, and its covariance with the next level.

    Both include the attenuation by bilinear interpolation: (2 + cos)/3 per axis of a wave's
    variance, and sinc^2 of its amplitude where two levels are blended.
    """
    n = len(slope_power)
    levels = int(math.log2(n)) + 1
    variance, coherent = np.zeros(levels), []
    for level in range(levels):
        texel = length / (n >> level)
        inside = np.maximum(abs(kx), abs(ky)) < math.pi / texel * (1 - 1e-9)
        blur = np.where(inside, _blur(kx**2 + ky**2, texel, level), 0)
        bilinear = (2 + np.cos(kx * texel)) * (2 + np.cos(ky * texel)) / 9
        variance[level] = (slope_power * blur**2 * bilinear).sum()
        phase = texel / (2 * math.pi)
        coherent.append(blur * (np.sinc(kx * phase) * np.sinc(ky * phase)) ** 2)
    pairs = zip(coherent, [*coherent[1:], 0 * kx], strict=True)
    return variance, np.array([(slope_power * a * b).sum() for a, b in pairs])


def _blur(k2: np.ndarray, texel: float, level: int) -> np.ndarray:
    """Return the transfer function of a level's Gaussian (deviation half a texel); 1 at level 0."""
    return np.exp(-k2 * (0.5 * texel) ** 2 / 2) if level else np.ones_like(k2)


def at_time(waves: Waves, time: float) -> WaveMaps:
    """Compute the maps of all tiles at `time` seconds; once per frame, before any lookup."""
    time = time / math.sqrt(waves.scale)  # Froude: s times the length, sqrt(s) times the period
    if not waves.tiles:
        device = waves.device
        none = torch.zeros(0, 1, device=device)
        start = torch.zeros(0, dtype=torch.int64, device=device)
        empty = torch.zeros(0, 3, device=device), start, none[:, 0]
        return WaveMaps(*empty, 0, none[:, 0], none, none, none, waves.unresolved)
    pyramids = [_pyramid(tile, time, waves.scale) for tile in waves.tiles]
    texels = torch.cat([each for each, _ in pyramids])
    device, count = texels.device, pyramids[0][0].shape[0]
    tiles = waves.tiles
    return WaveMaps(
        texels,
        count * torch.arange(len(tiles), device=device),
        torch.tensor([tile.length * waves.scale for tile in tiles], device=device),
        len(tiles[0].level_variance) - 1,
        torch.tensor([tile.slope_variance for tile in tiles], device=device),
        torch.stack([tile.level_variance for tile in tiles]),
        torch.stack([tile.level_covariance for tile in tiles]),
        torch.stack([highest for _, highest in pyramids]),
        waves.unresolved,
    )


def amplitudes(tile: WaveTile, time: float) -> Complex[Tensor, "n n"]:
    """Return the amplitude of every wave of the tile at `time` seconds (unscaled), m; Hermitian."""
    phase = tile.omega * time  # float64: accurate for hours
    rotation = torch.polar(torch.ones_like(phase), phase).to(tile.forward.dtype)
    return tile.forward * rotation.conj() + tile.backward * rotation


def _pyramid(
    tile: WaveTile, time: float, scale: float
) -> tuple[Float[Tensor, "texels 3"], Float[Tensor, "levels"]]:
    """Return the maps of height (m) and slopes from N x N down to 1 x 1, and each level's height.

    The levels are concatenated; lengths are scaled.
    """
    height = amplitudes(tile, time)
    # Both slopes are real, so one complex FFT computes both: i kx h + i (i ky h).
    slope = height * torch.complex(-tile.k[..., 1], tile.k[..., 0])
    height = height * scale
    k2 = (tile.k**2).sum(-1)
    n, maps, highest = len(height), [], []
    for level in range(len(tile.level_variance)):
        size = n >> level
        half = size // 2
        if half < 2:  # only the mean remains, and the mean is 0
            maps.append(k2.new_zeros(size * size, 3))
            highest.append(k2.new_zeros(()))
            continue
        row = torch.arange(n, device=height.device)
        rows = torch.cat([row[:half], row[n - half :]])
        parts = torch.stack([height[rows][:, rows], slope[rows][:, rows]])
        if level:
            parts = parts * torch.exp(-k2[rows][:, rows] * (0.5 * tile.length / size) ** 2 / 2)
        parts[:, half], parts[:, :, half] = 0, 0  # the Nyquist frequency has no conjugate partner
        fields = torch.fft.ifft2(parts, norm="forward").flatten(1)
        maps.append(torch.stack([fields[0].real, fields[1].real, fields[1].imag], dim=-1))
        highest.append(maps[-1][:, 0].abs().max())
    return torch.cat(maps), torch.stack(highest)
