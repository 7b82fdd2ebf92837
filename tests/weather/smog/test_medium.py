"""Optical depth of smog: against quadrature, known visibilities, and at singular points."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from climatenerf.weather import media
from climatenerf.weather.smog import medium as smog
from climatenerf.weather.smog.parameters import Smog

STRATIFIED = smog.Medium(sigma=0.03, falloff=12.0, base_z=2.0, colour=(0.8, 0.7, 0.6))


def directions(elevations_deg) -> torch.Tensor:
    elevation = torch.deg2rad(torch.as_tensor(elevations_deg, dtype=torch.float64))
    return torch.stack(
        [torch.cos(elevation), torch.zeros_like(elevation), torch.sin(elevation)], dim=-1
    )


def origins(heights) -> torch.Tensor:
    z = torch.as_tensor(heights, dtype=torch.float64)
    return torch.stack([torch.ones_like(z), -torch.ones_like(z), z], dim=-1)


def quadrature(air: smog.Medium, o: torch.Tensor, d: torch.Tensor, t: float) -> float:
    """Reference: sum sigma over a million short segments."""
    n = 1_000_000
    s = (np.arange(n) + 0.5) * t / n
    u = o[2].item() + s * d[2].item() - air.base_z
    return float(np.sum(air.sigma * np.exp(-np.maximum(u, 0) / air.falloff)) * t / n)


def test_extinction_of_known_visibilities():
    assert smog.sigma_from_visibility(100) == pytest.approx(0.02996, rel=1e-3)
    assert smog.sigma_from_visibility(100, contrast=0.02) == pytest.approx(0.03912, rel=1e-3)


def test_medium_from_user_parameters():
    assert smog.medium(Smog(), 3.0) is None
    air = smog.medium(Smog(visibility=50, base=1.5, height_falloff=9), ground_z=3.0)
    assert air is not None
    assert (air.base_z, air.falloff) == (4.5, 9)
    assert air.sigma == pytest.approx(2.9957 / 50, rel=1e-4)
    assert air.colour[0] == pytest.approx(0.8375, abs=2e-3)  # sRGB .925, decoded
    given = smog.medium(Smog(sigma=0.2), 0.0)
    assert given is not None and given.sigma == 0.2


@pytest.mark.parametrize("height", [-3.0, 2.0, 2.5, 30.0])
@pytest.mark.parametrize("elevation", [-80.0, -20.0, -1e-4, 0.0, 1e-6, 0.05, 3.0, 89.0])
def test_closed_form_against_quadrature(height, elevation):
    o, d = origins([height]), directions([elevation])
    for t in (0.5, 40.0, 300.0):
        tau = smog.optical_depth(STRATIFIED, o, d, torch.tensor([t], dtype=torch.float64))
        assert tau.item() == pytest.approx(quadrature(STRATIFIED, o[0], d[0], t), rel=1e-6)


def test_regression_recovers_sigma_of_a_homogeneous_medium():
    air = smog.Medium(sigma=0.02, falloff=None, base_z=0.0, colour=(0.83, 0.8, 0.53))
    generator = torch.Generator().manual_seed(0)
    t = 1 + 99 * torch.rand(500, generator=generator)
    clean = 0.1 + 0.4 * torch.rand(500, 3, generator=generator)
    o, d = torch.zeros(500, 3), torch.tensor([1.0, 0.0, 0.0]).expand(500, 3)
    hazy = media.attenuate([air], clean, o, d, t)
    for channel in range(3):
        air_colour = air.colour[channel]
        y = torch.log((hazy[:, channel] - air_colour) / (clean[:, channel] - air_colour))
        slope, offset = np.polyfit(t.numpy(), y.numpy(), 1)
        assert slope == pytest.approx(-air.sigma, rel=0.005)
        assert offset == pytest.approx(0, abs=1e-3)
        assert np.corrcoef(t.numpy(), y.numpy())[0, 1] ** 2 > 0.999


def test_five_elevations_recover_the_falloff():
    o, d = origins([1.0] * 5), directions([2.0, 10.0, 25.0, 45.0, 80.0])
    expected = np.array([math.exp(-quadrature(STRATIFIED, o[i], d[i], 60.0)) for i in range(5)])
    candidates = np.linspace(6, 24, 361)
    errors = []
    for falloff in candidates:
        air = smog.Medium(STRATIFIED.sigma, float(falloff), STRATIFIED.base_z, STRATIFIED.colour)
        t = torch.full((5,), 60.0, dtype=torch.float64)
        errors.append(float(((smog.transmittance(air, o, d, t).numpy() - expected) ** 2).sum()))
    assert candidates[int(np.argmin(errors))] == pytest.approx(STRATIFIED.falloff, rel=0.02)


def test_sky_has_the_optical_depth_of_the_whole_atmosphere():
    o, d = origins([2.0, 2.0, 8.0, 0.0]), directions([90.0, 30.0, 10.0, 30.0])
    infinite = torch.full((4,), torch.inf, dtype=torch.float64)
    tau = smog.optical_depth(STRATIFIED, o, d, infinite)
    expected = [0.36, 0.72, 0.36 * math.exp(-0.5) / math.sin(math.radians(10)), 0.72 + 0.12]
    assert tau.tolist() == pytest.approx(expected)
    far = smog.optical_depth(STRATIFIED, o, d, torch.full((4,), 1e5, dtype=torch.float64))
    torch.testing.assert_close(tau, far)


def test_infinite_rays_that_stay_in_the_medium_transmit_nothing():
    o, d = origins([5.0, 5.0]), directions([0.0, -5.0])
    infinite = torch.full((2,), torch.inf, dtype=torch.float64)
    assert smog.transmittance(STRATIFIED, o, d, infinite).tolist() == [0, 0]
    homogeneous = smog.Medium(0.01, None, 0.0, (1.0, 1.0, 1.0))
    assert smog.transmittance(homogeneous, o, directions([90.0, 3.0]), infinite).tolist() == [0, 0]
    empty = smog.Medium(0.0, 10.0, 0.0, (1.0, 1.0, 1.0))
    assert smog.transmittance(empty, o, d, infinite).tolist() == [1, 1]


def test_gradients_match_finite_differences():
    o = origins([1.0, 2.5, 30.0, 2.2, 7.0, 7.0]).requires_grad_()
    d = directions([5.0, -3.0, -60.0, 1e-3, 0.0, 40.0]).requires_grad_()
    t = torch.tensor([40.0, 30.0, 50.0, 9.0, 20.0, 3.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda *x: smog.optical_depth(STRATIFIED, *x), (o, d, t))


@pytest.mark.parametrize("length", [0.0, 1e-6, 1.0, 1e6, torch.inf])
def test_float32_values_and_gradients_stay_finite(length):
    slopes = torch.tensor([0.0, 1e-30, -1e-30, 1e-7, -1e-7, 0.5, -0.5, 1.0, -1.0])
    d = torch.stack([torch.sqrt(1 - slopes**2), 0 * slopes, slopes], dim=-1)
    for height in (-1e4, 2.0, 2.0 + 1e-6, 50.0, 1e5):
        o = torch.tensor([0.0, 0.0, height]).expand(len(d), 3).clone().requires_grad_()
        rays_d = d.clone().requires_grad_()
        t = torch.full((len(d),), length, requires_grad=True)
        transmitted = smog.transmittance(STRATIFIED, o, rays_d, t)
        transmitted.sum().backward()
        assert ((transmitted >= 0) & (transmitted <= 1)).all()
        for leaf in (o, rays_d, t):
            assert leaf.grad is None or torch.isfinite(leaf.grad).all()


def test_optical_depth_is_monotone_and_additive():
    generator = torch.Generator().manual_seed(1)
    d = torch.nn.functional.normalize(torch.randn(200, 3, generator=generator).double(), dim=-1)
    o = origins(20 * torch.rand(200, generator=generator) - 5)
    a, b = (100 * torch.rand(2, 200, generator=generator)).double()
    first = smog.optical_depth(STRATIFIED, o, d, a)
    second = smog.optical_depth(STRATIFIED, o + a[:, None] * d, d, b)
    whole = smog.optical_depth(STRATIFIED, o, d, a + b)
    torch.testing.assert_close(first + second, whole)
    assert (whole >= first).all()


def test_full_transmittance_leaves_colours_unchanged():
    colour = torch.rand(100, 3, generator=torch.Generator().manual_seed(2))
    o, d = torch.zeros(100, 3), torch.tensor([0.0, 0.6, 0.8]).expand(100, 3)
    clear = dataclasses.replace(STRATIFIED, sigma=0.0)
    assert torch.equal(media.attenuate([clear], colour, o, d, torch.full((100,), 50.0)), colour)
