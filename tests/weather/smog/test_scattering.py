"""Smog in the light of the place: phase function, similarity, the top, and limits."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
import torch

from climatenerf.weather import media
from climatenerf.weather.smog.medium import medium
from climatenerf.weather.smog.parameters import Smog
from climatenerf.weather.smog.scattering import (
    particles_of,
    phase,
    scaled_extinction,
    scattering_medium,
    sun_transmittance,
)

EYE = torch.tensor([[0.0, 0.0, 1.7]])


@dataclass
class EvenLight:
    """The same radiance from everywhere, and perhaps a sun."""

    radiance: float = 0.4
    sun: tuple | None = None

    def mean_radiance(self, x):
        return torch.full_like(x, self.radiance)

    def beam(self):
        return self.sun


def lit(smog, light=None, ground=0.0):
    air = medium(smog, ground)
    return scattering_medium(smog, air, ground + smog.top, light or EvenLight(), EYE)


def ray(*d):
    d = torch.nn.functional.normalize(torch.tensor([d], dtype=torch.float32), dim=-1)
    return EYE.clone(), d


def test_the_phase_function_integrates_to_one():
    cosine = torch.linspace(-1, 1, 200_001, dtype=torch.float64)
    for g in (0.0, 0.5, 0.8):
        total = 2 * math.pi * torch.trapezoid(phase(cosine, g), cosine)
        assert float(total) == pytest.approx(1.0, abs=1e-3)
    forward, back = phase(torch.tensor([1.0, -1.0], dtype=torch.float64), 0.8)
    assert float(forward / back) == pytest.approx(729, abs=1)


def test_airlight_follows_the_light():
    smog = Smog(visibility=50.0)
    dim, bright = (lit(smog, EvenLight(level)).source(*ray(0, 1, 0)) for level in (0.3, 0.6))
    torch.testing.assert_close(bright, 2 * dim)


def test_particles_that_absorb_nothing_leave_an_even_world_as_it_is():
    """White furnace: fog with albedo 1 in even light has the radiance of its surroundings."""
    fog = lit(Smog(visibility=30.0, kind="fog"))
    radiance = torch.full((1, 3), 0.4)
    arriving = media.attenuate([fog], radiance, *ray(0, 1, 0), torch.tensor([80.0]))
    torch.testing.assert_close(arriving, radiance)


def test_forward_scattering_counts_as_unscattered():
    smog = Smog(sigma=0.02, albedo=(1.0, 1.0, 1.0), asymmetry=0.75)
    black = media.attenuate(
        [lit(smog, EvenLight(0.0))], torch.ones(1, 3), *ray(0, 1, 0), torch.tensor([50.0])
    )
    np.testing.assert_allclose(black, math.exp(-0.02 * 50 * 0.25), rtol=1e-5)
    none = Smog(sigma=0.02, albedo=(0.0, 0.0, 0.0), asymmetry=0.75)
    black = media.attenuate([lit(none)], torch.ones(1, 3), *ray(0, 1, 0), torch.tensor([50.0]))
    np.testing.assert_allclose(black, math.exp(-1.0), rtol=1e-5)


def test_the_sky_changes_continuously_with_the_extinction():
    """Smog has a top, so thin smog leaves the sky almost as it was."""
    sky, endless = torch.full((1, 3), 0.9), torch.tensor([torch.inf])
    before = sky
    for sigma in (0.0, 1e-8, 1e-6, 1e-5):
        after = media.attenuate([lit(Smog(sigma=sigma))], sky, *ray(0, 0.3, 1), endless)
        assert float((after - before).abs().max()) < 2e-3
        before = after
    zenith = lit(Smog(sigma=0.01, top=200.0), ground=5.0)
    depth = zenith.optical_depth(*ray(0, 0, 1), endless)
    assert float(depth) == pytest.approx(0.01 * (205 - 1.7), rel=1e-5)


def test_rays_from_above_the_smog():
    low = lit(Smog(sigma=0.1, top=2.0))
    o, d = torch.tensor([[0.0, 0.0, 10.0]]), ray(0, 0, -1)[1]
    assert float(low.optical_depth(o, d, torch.tensor([9.0]))) == pytest.approx(0.1, rel=1e-4)
    assert float(low.optical_depth(o, d, torch.tensor([7.0]))) == 0.0
    assert float(low.optical_depth(o, -d, torch.tensor([torch.inf]))) == 0.0
    level = ray(0, 1, 0)[1]
    assert float(low.optical_depth(o, level, torch.tensor([torch.inf]))) == 0.0


def test_smog_glows_towards_the_sun():
    sun = torch.tensor([0.0, math.cos(0.3), math.sin(0.3)])
    hazy = lit(Smog(visibility=100.0, kind="haze"), EvenLight(0.2, (sun, torch.ones(3))))
    towards, away = hazy.source(*ray(0, 1, 0.3)), hazy.source(*ray(0, -1, 0.3))
    assert float(towards.mean()) > 3 * float(away.mean())


def test_spectral_laws_of_the_kinds():
    blue = {kind: scaled_extinction(particles_of(Smog(kind=kind))) for kind in ("fog", "haze")}
    assert blue["fog"][2] == pytest.approx(blue["fog"][0])
    g, a = 0.7, 1.3
    expected = (465 / 550) ** -a * (1 - 0.96 * g)
    assert blue["haze"][2] == pytest.approx(expected, rel=1e-6)


def test_smoke_takes_the_sun_and_reddens_it():
    red, green, blue = sun_transmittance(Smog(sigma=0.01, kind="smoke", top=300.0), 0.01, 0.7)
    assert 0 < blue < green < red < 0.3
    assert sun_transmittance(Smog(sigma=0.0, kind="smoke"), 0.0, 0.7) == (1.0, 1.0, 1.0)


def test_ambient_is_the_even_part_of_what_particles_scatter():
    smog = Smog(sigma=0.02, albedo=(0.9, 0.9, 0.9), asymmetry=0.6)
    source = lit(smog, EvenLight(0.5)).source(*ray(0, 1, 0))
    np.testing.assert_allclose(source, 0.5 * 0.9 * 0.4 / (1 - 0.9 * 0.6), rtol=1e-5)


def test_a_level_ray_leaves_thin_smog():
    endless = torch.tensor([torch.inf])
    thin = media.attenuate([lit(Smog(sigma=1e-8))], torch.ones(1, 3), *ray(0, 1, 0), endless)
    assert float((1 - thin).abs().max()) < 1 / 255


@pytest.mark.parametrize("base", [-3.0, 0.0, 8.0, 50.0])
def test_the_suns_path_through_smog_that_thins_with_height(base):
    smog = Smog(sigma=0.002, kind="fog", height_falloff=5.0, base=base, top=30.0)
    z = (np.arange(60000) + 0.5) * 30.0 / 60000
    column = np.exp(-np.clip(z - base, 0, None) / 5.0).mean() * 30.0
    even = Smog(sigma=0.002, kind="fog", top=float(column))
    expected = sun_transmittance(even, 0.002, 0.7)
    np.testing.assert_allclose(sun_transmittance(smog, 0.002, 0.7), expected, rtol=1e-5)
