"""Skies: the CIE's closed forms, and colours that follow from the air."""

import math

import numpy as np
import pytest
import torch

from climatenerf.weather.light import skies
from climatenerf.weather.light.skies import NewSky, air_mass, cie_luminance, direct_sun
from climatenerf.weather.light.spherical import sphere_directions

LUMA = torch.tensor(skies.LUMA)
SUN = (0.0, math.cos(math.radians(40)), math.sin(math.radians(40)))


def half_sphere(count=200_000):
    d = sphere_directions(count)
    return d[d[:, 2] > 0], 4 * math.pi / count


def test_overcast_irradiance_on_ground_and_wall():
    """E_h/L_z = 7 pi/9 and E_v/E_h = .396 (CIE overcast sky)."""
    d, solid = half_sphere()
    sky = skies.overcast_sky(d, math.radians(40))[:, 1].double()
    zenith = float(skies.overcast_sky(torch.tensor([[0.0, 0.0, 1.0]]), math.radians(40))[0, 1])
    level = float((sky * d[:, 2]).sum()) * solid
    wall = float((sky * d[:, 0].clamp_min(0)).sum()) * solid
    assert level / zenith == pytest.approx(7 * math.pi / 9, rel=0.005)
    assert level / zenith == pytest.approx(2.443, rel=0.005)
    assert wall / level == pytest.approx(0.396, rel=0.005)
    assert level == pytest.approx(0.3 + 21 * math.sin(math.radians(40)), rel=0.005), "klx"


def test_snowy_ground_brightens_the_cloud_above_it():
    """Bounce after bounce between ground and cloud, by hand; each comes back evenly."""
    d, solid = half_sphere()
    dry = skies.overcast_sky(d, math.radians(40))[:, 1].double()
    snowy = skies.overcast_sky(d, math.radians(40), 0.8)[:, 1].double()
    first = float((dry * d[:, 2]).sum()) * solid
    even, arriving = 0.0, first
    for _ in range(60):
        arriving *= (0.8 - skies.USUAL_GROUND) * skies.CLOUD_BASE
        even += arriving
    level = float((snowy * d[:, 2]).sum()) * solid
    assert level == pytest.approx(first + even, rel=0.005)
    torch.testing.assert_close(snowy - dry, torch.full_like(dry, even / math.pi), rtol=0.01, atol=0)
    horizon = float(snowy[d[:, 2] < 0.01].mean())
    assert horizon / (0.9 * level / math.pi) > 0.65, "nearly as bright as the snow"
    covered = NewSky("clear", SUN, 1.0, 0.8)
    assert torch.equal(covered.radiance(d), NewSky("overcast", SUN, ground=0.8).radiance(d))
    assert torch.equal(NewSky("clear", SUN, 0.0, 0.8).radiance(d), NewSky("clear", SUN).radiance(d))


def test_general_sky_equals_its_formula():
    """CIE S 011 type 12, evaluated by hand in one direction."""
    d = torch.tensor([[0.6, 0.0, 0.8], [0.0, 0.0, 1.0]], dtype=torch.float64)
    found = cie_luminance(d, SUN, skies.CLEAR)
    a, b, c, e, f = skies.CLEAR
    angle = math.acos(0.8 * SUN[2])
    zenith_angle = math.acos(SUN[2])

    def indicatrix(x):
        return 1 + c * (math.exp(e * x) - math.exp(e * math.pi / 2)) + f * math.cos(x) ** 2

    expected = (1 + a * math.exp(b / 0.8)) * indicatrix(angle)
    expected /= (1 + a * math.exp(b)) * indicatrix(zenith_angle)
    assert float(found[0]) == pytest.approx(expected, rel=1e-6)
    assert float(found[1]) == pytest.approx(1.0, rel=1e-9)


def test_overcast_is_type_1_of_the_general_sky():
    """The old form (1 + 2 sin h)/3 and type 1 differ by up to a fifth, low in the sky."""
    d, _ = half_sphere(2000)
    d = d[d[:, 2] > 0.1]
    general = cie_luminance(d, SUN, skies.OVERCAST)
    np.testing.assert_allclose(general, (1 + 2 * d[:, 2]) / 3, rtol=0.21)


@pytest.mark.parametrize("elevation", [5, 20, 40, 70])
def test_clear_sky_has_the_illuminance_of_the_daylight_equations(elevation):
    h = math.radians(elevation)
    sun = (math.cos(h), 0.0, math.sin(h))
    d, solid = half_sphere()
    sky = NewSky("clear", sun).radiance(d)
    assert bool((sky > 0).all())
    level = float((sky @ LUMA).double() @ d[:, 2].double()) * solid
    assert level == pytest.approx(0.8 + 15.5 * math.sqrt(math.sin(h)), rel=0.02)


def test_a_clear_sky_is_blue_and_white_at_horizon_and_sun():
    d = torch.tensor([[0.0, -0.6, 0.8], [1.0, 0.0, 0.02], list(SUN)])
    blue = NewSky("clear", SUN).radiance(torch.nn.functional.normalize(d, dim=-1))
    ratio = (blue[:, 2] / blue[:, 0]).tolist()
    assert ratio[0] > 2.0 and ratio[0] > ratio[1] and ratio[0] > ratio[2]


def test_the_sun_reddens_towards_the_horizon():
    high, low = direct_sun(math.radians(60)), direct_sun(math.radians(3))
    assert low[0] / low[2] > 3 * high[0] / high[2]
    assert sum(low) < 0.4 * sum(high)
    assert direct_sun(-0.1) == (0.0, 0.0, 0.0)
    luma = sum(w * e for w, e in zip(skies.LUMA, high, strict=True))
    assert luma == pytest.approx(127.5 * math.exp(-0.21 * air_mass(math.radians(60))), rel=1e-6)


def test_air_mass_of_kasten_and_young():
    assert air_mass(math.radians(90)) == pytest.approx(1.0, abs=1e-3)
    assert air_mass(math.radians(30)) == pytest.approx(1.994, abs=2e-3)
    assert air_mass(0.0) == pytest.approx(37.9, abs=0.5)


def test_cloud_cover_leads_from_clear_to_overcast():
    d, _ = half_sphere(500)
    full = NewSky("clear", SUN, 1.0)
    assert torch.allclose(full.radiance(d), NewSky("overcast", SUN).radiance(d))
    assert max(full.sun_irradiance) == 0.0
    half = NewSky("clear", SUN, 0.5).sun_irradiance
    np.testing.assert_allclose(half, np.array(NewSky("clear", SUN).sun_irradiance) / 2)


def test_storm_is_dark_and_dusk_glows_above_the_sun():
    d = torch.tensor([[0.0, 0.0, 1.0]])
    storm, overcast = NewSky("storm", SUN).radiance(d), NewSky("overcast", SUN).radiance(d)
    assert float(storm.mean() / overcast.mean()) < 0.25
    below = (0.0, math.cos(0.04), -math.sin(0.04))
    low = torch.nn.functional.normalize(torch.tensor([[0.0, 1.0, 0.1], [0.0, -1.0, 0.1]]), dim=-1)
    towards, away = NewSky("dusk", below).radiance(low)
    assert towards[0] > 2 * away[0] and away[2] > away[0]
    deeper = (0.0, math.cos(0.09), -math.sin(0.09))
    assert NewSky("dusk", deeper).radiance(low).mean() < 0.5 * towards.mean()
