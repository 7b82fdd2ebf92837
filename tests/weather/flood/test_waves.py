"""Waves: integrals of the spectrum, statistics of the animated surface, filtered lookups."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from support.threads import threads

from climatenerf.weather.flood import spectrum, waves
from climatenerf.weather.flood.parameters import Flood

STREET = Flood(level=0.0)
SEA = Flood(level=0.0, wind_speed=10.0, fetch=1e5, depth=200.0)


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """Run on one thread: thousands of small FFTs are slower on several."""
    with threads(1):
        yield


def single_tile(flood: Flood, seed: int, peaks: float = 16, n: int = 64):
    """A tile whose side is `peaks` peak wavelengths, and its band of wavenumbers."""
    length = peaks * 2 * math.pi / spectrum.peak_wavenumber(flood)
    band = [0.0, 0.9 * math.pi * n / length]
    generator = torch.Generator().manual_seed(seed)
    return waves.make_tile(flood, length, band, 370.0, generator, n), band


def as_waves(tile: waves.WaveTile, scale: float = 1.0) -> waves.Waves:
    return waves.Waves((tile,), scale=scale)


def heights(tile: waves.WaveTile, time: float) -> torch.Tensor:
    n = len(tile.omega)
    return waves.at_time(as_waves(tile), time).texels[: n * n, 0].reshape(n, n)


# --- spectrum ---------------------------------------------------------------------------------


def test_dispersion_limits_and_slowest_wave():
    k = np.array([0.01, 1.0])
    assert spectrum.dispersion(k, 1e4) == pytest.approx(np.sqrt(9.81 * k), rel=1e-4)  # deep
    shallow = spectrum.dispersion(np.array([0.01]), 0.5)
    assert shallow == pytest.approx(0.01 * math.sqrt(9.81 * 0.5), rel=1e-4)
    # The slowest gravity-capillary wave has a length of 1.7 cm and a speed of 23 cm/s.
    fine = np.geomspace(50, 2000, 2000)
    speed = spectrum.dispersion(fine, 10.0) / fine
    assert speed.min() == pytest.approx(0.232, rel=0.01)
    assert 2 * math.pi / fine[speed.argmin()] == pytest.approx(0.0172, rel=0.02)


def test_group_velocity_is_the_derivative_of_dispersion():
    k = np.geomspace(0.05, 1000, 50)
    for depth in (0.05, 1.0, 100.0):
        step = 1e-5 * k
        slope = spectrum.dispersion(k + step, depth) - spectrum.dispersion(k - step, depth)
        assert spectrum.group_velocity(k, depth) == pytest.approx(slope / (2 * step), rel=1e-6)


def test_tma_spectrum_at_the_peak():
    wind, fetch = 10.0, 1e5
    peak = spectrum.peak_frequency(wind, fetch)
    assert peak == pytest.approx(22 * (9.81**2 / 1e6) ** (1 / 3))
    alpha = 0.076 * (100 / (1e5 * 9.81)) ** 0.22
    at_peak = alpha * 9.81**2 * peak**-5 * math.exp(-1.25) * 3.3
    deep = spectrum.tma(np.array([peak, 0.0]), wind, fetch, 1e4)
    assert deep == pytest.approx([at_peak, 0])
    # Depth factor: (omega sqrt(d/g))^2/2 in the shallows, 1 in deep water.
    depth = 0.25 * 9.81 / peak**2
    shallow = spectrum.tma(np.array([peak]), wind, fetch, depth)
    assert shallow == pytest.approx([at_peak * 0.25 / 2])


@pytest.mark.parametrize("law", ["hasselmann", "donelan-banner"])
def test_spreading_is_normalised_and_points_downwind(law):
    flood = replace(STREET, spreading=law)
    peak = spectrum.peak_frequency(flood.wind_speed, flood.fetch)
    angle = (np.arange(4000) + 0.5) / 4000 * 2 * math.pi - math.pi
    for ratio in (0.3, 0.8, 1.0, 1.5, 3.0, 30.0):
        density = spectrum.spreading(np.full_like(angle, ratio * peak), angle, flood)
        assert density.mean() * 2 * math.pi == pytest.approx(1, abs=1e-4)
        assert abs(angle[density.argmax()]) < 0.01


def test_spreading_by_hasselmann_has_his_exponents():
    """Known values: s = 6.97 at the peak; waves as old as U/c = 1.17 have s = 9.77 r^-2.33."""
    angle = np.linspace(-math.pi, math.pi, 20001)
    for ratio, s in ((1.0, 6.97), (1.5, 9.77 * 1.5**-2.33), (3.0, 9.77 * 3**-2.33)):
        density = spectrum.hasselmann(np.full_like(angle, ratio), angle, 1.17)
        power = np.cos(angle / 2) ** (2 * s)
        np.testing.assert_allclose(density, power / np.trapezoid(power, angle), rtol=1e-4)
    gale = spectrum.hasselmann(np.array([0.0, 1.0, 50.0]), np.zeros(3), 120.0)
    assert gale == pytest.approx([1 / (2 * math.pi), gale[1], 1 / (2 * math.pi)])  # s = 0


def test_slopes_along_the_wind_are_little_steeper_than_across_it():
    """Cox and Munk (1954): .92 for a clean sea at 2 m/s; 3.2 looked like corrugated iron."""
    ratios = []
    for law in (Flood().spreading, "donelan-banner"):
        along = across = 0.0
        for seed in range(4):
            maps = waves.at_time(waves.make_waves(replace(STREET, spreading=law), seed, 128), 0.0)
            for start in maps.start:
                slope = maps.texels[start : start + 128**2, 1:]
                across, along = (
                    across + slope[:, 0].var(),
                    along + slope[:, 1].var(),
                )  # wind from +y
        ratios.append(float(along / across))
    assert 1 < ratios[0] < 1.6
    assert ratios[1] > 2.5


@pytest.mark.parametrize(("wind", "tolerance"), [(5.0, 0.15), (10.0, 0.35)])
def test_open_sea_is_near_cox_and_munk(wind, tolerance):
    """Developed sea, cut off at 370 rad/m where capillary waves begin; moderate wind."""
    sea = replace(SEA, wind_speed=wind)
    k = spectrum.log_axis(sea)
    energy = spectrum.wavenumber_spectrum(k, sea, spectrum.MAX_CUTOFF)
    slope = np.trapezoid(k**3 * energy, np.log(k))
    assert slope == pytest.approx(spectrum.cox_munk(wind), rel=tolerance)
    # Slope variance that no tile resolves counts as unresolved.
    sampled = waves.make_waves(sea, 0, 64)
    total = sampled.mean_square_slope + 2 * sampled.unresolved
    assert total == pytest.approx(spectrum.cox_munk(wind))


def test_significant_height_of_the_open_sea():
    """10 m/s over 100 km: 2.1 m, near JONSWAP's fetch law 0.0016 F^0.5."""
    sampled = waves.make_waves(SEA, 0, 64)
    law = 0.0016 * math.sqrt(9.81 * 1e5 / 100) * 100 / 9.81
    assert sampled.significant_height == pytest.approx(law, rel=0.35)
    assert sampled.significant_height == pytest.approx(2.14, abs=0.02)


@pytest.mark.parametrize("wind", [0.5, 2.0, 6.0])
def test_slope_variance_at_short_fetch_equals_cox_and_munk(wind):
    flood = Flood(level=0.0, wind_speed=wind)
    sea = waves.make_waves(flood, 0, n=64)
    total = sea.mean_square_slope + 2 * sea.unresolved
    assert total == pytest.approx(spectrum.cox_munk(wind), rel=0.01)
    assert sea.unresolved < 0.02 * total


def test_default_waves_are_ripples_of_centimetres():
    sea = waves.make_waves(STREET, 0)
    assert 0.004 < sea.significant_height < 0.02  # metres
    assert 0.05 < math.sqrt(sea.mean_square_slope / 2) < 0.1


# --- surface ----------------------------------------------------------------------------------


@pytest.mark.parametrize("flood", [STREET, SEA, Flood(wind_speed=5.0, fetch=300.0, depth=0.2)])
def test_variance_of_height_and_slope_equals_the_spectrum_integral(flood):
    height, slope = [], []
    for seed in range(64):
        tile, band = single_tile(flood, seed)
        height.append(heights(tile, 0.7).var(unbiased=False).item())
        maps = waves.at_time(as_waves(tile), 0.7).texels[: 64 * 64]
        slope.append((maps[:, 1:] ** 2).sum(-1).mean().item())
    k = spectrum.log_axis(flood)
    k = k[k < band[1]]
    energy = k * spectrum.wavenumber_spectrum(k, flood, 370.0)
    assert np.mean(height) == pytest.approx(np.trapezoid(energy, np.log(k)), rel=0.03)
    assert np.mean(slope) == pytest.approx(np.trapezoid(k**2 * energy, np.log(k)), rel=0.03)


def test_surface_is_real_at_all_times():
    tile, _ = single_tile(STREET, 3)
    for time in (0.0, 0.3, 1000.0):
        field = torch.fft.ifft2(waves.amplitudes(tile, time), norm="forward")
        assert field.imag.abs().max() < 1e-5 * field.real.abs().max()


def test_slopes_are_the_gradient_of_the_height():
    tile, _ = single_tile(STREET, 0, peaks=4, n=128)
    smooth = waves.WaveTile(
        tile.length,
        tile.k,
        tile.omega,
        torch.where(tile.k.norm(dim=-1) < 10 * tile.k[0, 1, 0], tile.forward, 0),
        torch.where(tile.k.norm(dim=-1) < 10 * tile.k[0, 1, 0], tile.backward, 0),
        tile.slope_variance,
        tile.level_variance,
        tile.level_covariance,
    )
    h = heights(smooth, 0.4)
    maps = waves.at_time(as_waves(smooth), 0.4).texels[: 128 * 128].reshape(128, 128, 3)
    direct = torch.fft.ifft2(waves.amplitudes(smooth, 0.4), norm="forward").real
    torch.testing.assert_close(h, direct)
    step = 2 * tile.length / 128
    along_x = (h.roll(-1, 1) - h.roll(1, 1)) / step
    along_y = (h.roll(-1, 0) - h.roll(1, 0)) / step
    for slope, expected in zip(maps[..., 1:].unbind(-1), (along_x, along_y), strict=True):
        assert (slope - expected).abs().max() < 0.05 * slope.abs().max()


@pytest.mark.parametrize("index", [(0, 16), (5, 20), (-9, 14)])
def test_waves_oscillate_at_the_dispersion_frequency(index):
    tile, _ = single_tile(STREET, 1)
    period, steps = 10.0, 256
    series = [torch.fft.fft2(heights(tile, period * i / steps))[index].item() for i in range(steps)]
    power = np.abs(np.fft.fft(np.array(series) * np.hanning(steps))) ** 2
    actual = abs(np.fft.fftfreq(steps, period / steps)[power.argmax()]) * 2 * math.pi
    k = 2 * math.pi / tile.length * math.hypot(*index)
    expected = spectrum.dispersion(np.array([k]), STREET.depth)[0]
    assert actual == pytest.approx(expected, abs=2 * math.pi / period)


@pytest.mark.parametrize(("degrees", "downwind"), [(0, (0, -1)), (90, (-1, 0)), (180, (0, 1))])
def test_waves_travel_downwind(degrees, downwind):
    """Wind from +y drives waves to -y: the cross-correlation peak moves downwind."""
    tile, _ = single_tile(Flood(wind_direction=math.radians(degrees)), 0)
    before, after = (heights(tile, t) for t in (0.0, 0.06))
    match = torch.fft.ifft2(torch.fft.fft2(before).conj() * torch.fft.fft2(after)).real
    row, column = divmod(int(match.argmax()), 64)
    moved = np.array([(column + 32) % 64 - 32, (row + 32) % 64 - 32])
    assert moved @ downwind > 0.8 * np.linalg.norm(moved) > 0


def test_seed_reproduces_and_time_animates():
    x = torch.rand(500, 2, generator=torch.Generator().manual_seed(0)) * 10
    narrow = torch.full((500,), 0.01)

    def slope(seed, time):
        return waves.at_time(waves.make_waves(STREET, seed, 64), time).at(x, narrow)[1]

    assert torch.equal(slope(5, 1.0), slope(5, 1.0))
    between_seeds = (slope(5, 1.0) - slope(6, 1.0)).pow(2).mean()
    after_a_millisecond = (slope(5, 1.0) - slope(5, 1.001)).pow(2).mean()
    assert after_a_millisecond < 1e-2 * between_seeds
    assert (slope(5, 1.0) - slope(5, 1.5)).pow(2).mean() > 0.1 * between_seeds


def test_no_wind_is_perfectly_flat():
    sea = waves.make_waves(Flood(wind_speed=0.0), 0)
    _, slope, removed = waves.at_time(sea, 3.0).at(torch.rand(9, 2), torch.full((9,), 0.1))
    assert not slope.any() and not removed.any()
    assert sea.significant_height == 0


def test_wave_scale_keeps_the_slope():
    small = waves.make_waves(STREET, 0, 64)
    large = waves.make_waves(Flood(wave_scale=3.0), 0, 64)
    assert large.significant_height == pytest.approx(3 * small.significant_height)
    x = torch.rand(200, 2)
    low, a, va = waves.at_time(small, 1.0).at(x, torch.full((200,), 0.02))
    high, b, vb = waves.at_time(large, math.sqrt(3)).at(3 * x, torch.full((200,), 0.06))
    torch.testing.assert_close(a, b, atol=1e-4, rtol=1e-3)
    torch.testing.assert_close(3 * low, high, atol=1e-5, rtol=1e-3)
    torch.testing.assert_close(va, vb, atol=1e-7, rtol=1e-3)


# --- lookups ----------------------------------------------------------------------------------


def test_lookup_is_periodic_and_exact_at_texels():
    tile, _ = single_tile(STREET, 2)
    frame = waves.at_time(as_waves(tile), 0.2)
    maps = frame.texels[: 64 * 64]
    rows, columns = torch.meshgrid(torch.arange(64), torch.arange(64), indexing="ij")
    x = torch.stack([columns, rows], dim=-1).reshape(-1, 2) * tile.length / 64
    zero = torch.zeros(len(x))
    height, slope, _ = frame.at(x, zero)
    torch.testing.assert_close(slope, maps[:, 1:], atol=1e-4, rtol=0)
    torch.testing.assert_close(height, maps[:, 0], atol=1e-6, rtol=0)
    shifted = x + 0.3 + torch.tensor([2.0, -3.0]) * tile.length
    torch.testing.assert_close(
        frame.at(x + 0.3, zero)[1],
        frame.at(shifted, zero)[1],
        atol=1e-3,
        rtol=0,
    )


@pytest.mark.parametrize("level", [1, 2, 3])
def test_levels_equal_a_direct_blur(level):
    """Each level is the slope map convolved with a Gaussian of half its texel."""
    tile, _ = single_tile(STREET, 2)
    texels = waves.at_time(as_waves(tile), 0.2).texels[:, 1:].contiguous()
    pyramid = torch.view_as_complex(texels)
    size = 64 >> level
    start = sum((64 >> i) ** 2 for i in range(level))
    actual = pyramid[start : start + size**2].reshape(size, size)
    step = torch.arange(64)
    distance = torch.minimum(step, 64 - step).float() / (1 << level)
    kernel = torch.exp(-(distance**2) / (2 * 0.5**2))
    kernel = kernel / kernel.sum()
    circulant = torch.stack([kernel.roll(i) for i in range(64)]).to(torch.complex64)
    blurred = circulant @ pyramid[: 64 * 64].reshape(64, 64) @ circulant
    expected = blurred[:: 1 << level, :: 1 << level]
    # Cropping in frequency also removes the Gaussian's tail beyond the level's Nyquist frequency.
    assert (actual - expected).abs().pow(2).mean() < 0.02 * pyramid[: 64 * 64].abs().pow(2).mean()


@pytest.mark.parametrize("flood", [STREET, Flood(wind_speed=6.0, fetch=300.0)])
def test_filtering_conserves_slope_variance(flood):
    x = torch.rand(6000, 2, generator=torch.Generator().manual_seed(0)) * 200
    sums = {width: 0.0 for width in (0.0, 0.013, 0.07, 0.3, 100.0)}
    total, last = 0.0, -1.0
    for seed in range(4):
        sea = waves.make_waves(flood, seed, 128)
        frame = waves.at_time(sea, 0.5)
        total += sea.unresolved + sum(t.slope_variance for t in sea.tiles)
        for width in sums:
            _, slope, removed = frame.at(x, torch.full((len(x),), width))
            assert (removed >= 0).all()
            sums[width] += slope.pow(2).mean().item() + removed.mean().item()
            last = removed.mean().item()
    assert list(sums.values()) == pytest.approx([total] * len(sums), rel=0.04)
    assert last == pytest.approx(total / 4, rel=0.2)  # at 100 m all waves are filtered out


def test_removed_variance_grows_with_the_footprint():
    frame = waves.at_time(waves.make_waves(STREET, 0, 64), 0.0)
    width = torch.logspace(-4, 3, 200)
    _, _, removed = frame.at(torch.rand(200, 2), width)
    assert (removed.diff() >= -1e-7).all()


@pytest.mark.parametrize("wind", [1e-4, 0.01, 0.1, 40.0])
@pytest.mark.parametrize("fetch", [1.0, 1e6])
@pytest.mark.parametrize("depth", [0.01, 1000.0])
def test_slopes_are_finite_over_the_parameter_range(wind, fetch, depth):
    flood = Flood(wind_speed=wind, fetch=fetch, depth=depth, wave_scale=0.1)
    sea = waves.make_waves(flood, 0, 32)
    x = torch.tensor([[0.0, 0.0], [1e5, -1e5], [-1e-9, -0.0]])
    for width in (0.0, 1e-6, 1.0, 1e8):
        _, slope, removed = waves.at_time(sea, 1e4).at(x, torch.full((3,), width))
        assert torch.isfinite(slope).all() and torch.isfinite(removed).all()
        assert (removed >= 0).all()
