"""Fresnel reflectance: known values, Mitsuba, slope averages by brute force, gradients."""

import math

import pytest
import torch

from climatenerf.weather.flood import fresnel

WATER = 1.333


def cosine(degrees) -> torch.Tensor:
    return torch.cos(torch.deg2rad(torch.as_tensor(degrees, dtype=torch.float64)))


def test_known_reflectances():
    actual = fresnel.reflectance(cosine([0, 30, 60, 75, 80, 85]), WATER)
    expected = [0.0204, 0.0214, 0.0597, 0.212, 0.348, 0.584]
    assert actual.tolist() == pytest.approx(expected, rel=0.01)
    assert fresnel.reflectance(cosine([0]), WATER).item() == pytest.approx((0.333 / 2.333) ** 2)


def test_grazing_incidence_and_total_internal_reflection():
    assert fresnel.reflectance(torch.zeros(1), WATER).item() == 1
    critical = math.degrees(math.asin(1 / WATER))
    angles = cosine([critical - 0.01, critical + 1e-9, critical + 1, 89])
    actual = fresnel.reflectance(angles, WATER, below=True)
    assert actual[1:].tolist() == [1, 1, 1]
    assert 0.8 < actual[0] < 1


def test_reflectance_is_reciprocal():
    above = cosine(torch.linspace(0, 89, 50))
    in_water = torch.sqrt(1 - (1 - above**2) / WATER**2)
    torch.testing.assert_close(
        fresnel.reflectance(above, WATER), fresnel.reflectance(in_water, WATER, below=True)
    )


def test_reflectance_equals_mitsuba():
    mi = pytest.importorskip("mitsuba", reason="needs mitsuba (extra 'street')")
    mi.set_variant("scalar_rgb")
    cos = torch.linspace(0.02, 1, 50, dtype=torch.float64)
    for below, sign in ((False, 1), (True, -1)):
        expected = [mi.fresnel(sign * c, WATER)[0] for c in cos.tolist()]
        actual = fresnel.reflectance(cos, WATER, below)
        # scalar_rgb computes in single precision.
        assert actual.tolist() == pytest.approx(expected, abs=2e-5)


def brute_force(degrees: float, deviation: float, cross: float) -> tuple[float, float, float]:
    """Mean reflectance, slope and slope variance on a dense lattice, by projected area."""
    x = torch.linspace(-9, 9, 2401, dtype=torch.float64)[:, None]
    y = torch.linspace(-6, 6, 101, dtype=torch.float64)
    p, q = x * deviation, y * cross
    angle = math.radians(degrees)
    mu = math.cos(angle) - p * math.sin(angle)
    weight = mu.clamp(min=0) * torch.exp(-(x**2 + y**2) / 2)
    actual = fresnel.reflectance(mu / torch.sqrt(1 + p**2 + q**2), WATER)
    weight = weight / weight.sum()
    tilt = float((weight * -p).sum())
    return float((weight * actual).sum()), tilt, float((weight * (p + tilt) ** 2).sum())


@pytest.mark.parametrize("degrees", [0, 40, 70, 80, 85, 88, 89.9, 91])
@pytest.mark.parametrize("deviation", [0.003, 0.03, 0.1, 0.25])
def test_slope_average_equals_brute_force(degrees, deviation):
    expected, tilt, spread = brute_force(degrees, deviation, deviation)
    variance = torch.tensor([deviation**2], dtype=torch.float64)
    actual, actual_tilt, actual_spread = fresnel.slope_averaged(cosine([degrees]), variance, WATER)
    assert actual.item() == pytest.approx(expected, abs=0.002)
    assert actual_tilt.item() == pytest.approx(tilt, abs=0.01 * deviation)
    assert actual_spread.item() == pytest.approx(spread, abs=0.01 * deviation**2)


def test_rough_water_reflects_less_at_grazing():
    """0.40 at 85 deg and slope deviation 0.1; slopes across the view have little effect."""
    variance = torch.tensor([0.01], dtype=torch.float64)
    rough = fresnel.slope_averaged(cosine([85]), variance, WATER)[0]
    assert rough.item() == pytest.approx(0.40, abs=0.01)
    across = fresnel.slope_averaged(cosine([70]), 0 * variance + 1e-9, WATER, False, variance)[0]
    assert across.item() == pytest.approx(brute_force(70, 1e-5, 0.1)[0], abs=0.002)


def test_zero_variance_equals_the_flat_surface():
    cos = torch.linspace(0, 1, 101)
    mean, tilt, spread = fresnel.slope_averaged(cos, torch.zeros(101), WATER)
    assert torch.equal(mean, fresnel.reflectance(cos, WATER))
    assert not tilt.any() and not spread.any()
    nearly = fresnel.slope_averaged(cos, torch.full((101,), 1e-10), WATER)[0]
    torch.testing.assert_close(nearly, fresnel.reflectance(cos, WATER), atol=1e-3, rtol=0)


def test_below_may_differ_per_ray():
    cos = torch.tensor([0.5, 0.5])
    variance = torch.tensor([1e-4, 1e-4])
    actual = fresnel.slope_averaged(cos, variance, WATER, torch.tensor([False, True]))[0]
    assert actual[0] < 0.1 and actual[1] == 1


@pytest.mark.parametrize("below", [False, True])
def test_gradients_are_finite_everywhere(below):
    critical = math.sqrt(1 - 1 / WATER**2)
    cos = torch.tensor([-1, -0.3, -1e-6, 0, 1e-7, 1e-3, critical, 0.5, 0.999999, 1.0, 1.1])
    for size in (0.0, 1e-14, 1e-6, 1e-2, 0.1):
        c = cos.clone().requires_grad_()
        variance = torch.full_like(cos, size, requires_grad=True)
        flat = fresnel.reflectance(c, WATER, below)
        rough, tilt, spread = fresnel.slope_averaged(c, variance, WATER, below)
        (flat.sum() + rough.sum() + tilt.sum() + spread.sum()).backward()
        for value in (flat, rough):
            assert ((value >= 0) & (value <= 1 + 1e-6)).all()
        assert c.grad is not None and torch.isfinite(c.grad).all()
        assert variance.grad is not None and torch.isfinite(variance.grad).all()


def test_diffuse_reflectances():
    r_e, r_i = fresnel.diffuse_reflectances(WATER)
    assert r_e == pytest.approx(0.0664, abs=2e-4)
    assert r_i == pytest.approx(0.4746, abs=2e-4)
    # Integrate r_i directly, total internal reflection included.
    cos = (torch.arange(200_000, dtype=torch.float64) + 0.5) / 200_000
    integral = (fresnel.reflectance(cos, WATER, below=True) * 2 * cos).mean().item()
    assert integral == pytest.approx(r_i, abs=1e-4)
