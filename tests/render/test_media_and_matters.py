"""Two media and two matters together: depth order and closed forms."""

import math
from dataclasses import dataclass, field

import pytest
import torch
from support.analytic_fields import AnalyticField, HalfSpace

from climatenerf.core.samples import Samples
from climatenerf.render.integrator import trace
from climatenerf.weather import media
from climatenerf.weather.smog.medium import Medium
from climatenerf.weather.world import World

RED, BLUE = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)
AIR = AnalyticField([HalfSpace(offset=-1e3)], zenith=(0.2, 0.4, 0.2), horizon=(0.2, 0.4, 0.2))


@dataclass(frozen=True)
class Slab:
    """A homogeneous medium between two heights (m)."""

    sigma: float
    bottom: float
    top: float
    colour: tuple[float, float, float]
    mask: str = "mask_slab"

    def crossings(self, o, d):
        dz = torch.where(d[:, 2].abs() < 1e-9, torch.full_like(d[:, 2], 1e-9), d[:, 2])
        ends = torch.stack([(self.bottom - o[:, 2]) / dz, (self.top - o[:, 2]) / dz], -1)
        return ends.sort(-1).values.clamp_min(0)

    def optical_depth(self, o, d, t):
        start, end = self.crossings(o, d).unbind(-1)
        return self.sigma * (torch.minimum(end, t) - torch.minimum(start, t))

    def source(self, o, d):
        return torch.tensor(self.colour)

    def breaks(self, o, d):
        return self.crossings(o, d)


@dataclass(frozen=True)
class Sheet:
    """Matter in a thin horizontal sheet of known opacity."""

    height: float
    opacity: float
    own_colour: tuple[float, float, float]
    mask: str
    thickness_layer: str

    def march(self, rays_o, rays_d, t_min, t_max):
        t = (self.height - rays_o[:, 2]) / rays_d[:, 2]
        hit = (t > t_min) & (t < t_max)
        offsets = torch.cat([torch.zeros(1, dtype=torch.long), hit.long().cumsum(0)])
        dt = torch.full((int(hit.sum()),), 1e-3)
        return Samples(offsets, t[hit], dt, -math.log(1 - self.opacity) / dt)

    def colour(self, x):
        return torch.tensor(self.own_colour).expand_as(x)

    def normal(self, x):
        return torch.tensor([0.0, 0.0, 1.0]).expand_as(x)

    def thickness(self, x):
        return torch.full((len(x),), 0.5)


@dataclass(frozen=True)
class Glitter(Sheet):
    """A sheet that adds light where a pixel on it is narrower than 20 mm."""

    def colour_towards(self, x, d, width):
        return self.colour(x) + torch.where(width < 0.02, 0.25, 0.0)[:, None]


def rays(n=200, seed=0, height=20.0):
    generator = torch.Generator().manual_seed(seed)
    d = torch.randn(n, 3, generator=generator)
    d[:, 2] = -d[:, 2].abs() - 0.2
    d = torch.nn.functional.normalize(d, dim=-1)
    return torch.tensor([0.0, 0.0, height]).expand(n, 3).contiguous(), d


def seen(world, o, d):
    return trace(world, o, d, torch.full((len(o),), 1e-3))


def test_two_slabs_attenuate_in_depth_order():
    """A downward ray crosses the upper slab, then the lower one, and ends on white ground."""
    upper, lower = Slab(0.05, 10.0, 20.0, RED), Slab(0.2, 0.0, 10.0, BLUE)
    field = AnalyticField(
        [HalfSpace(colour=(1.0, 1.0, 1.0))], box=((-2e2, -2e2, -2), (2e2, 2e2, 30))
    )
    o, d = rays()
    inside = (20 / -d[:, 2]) < 100
    for order in ((upper, lower), (lower, upper)):
        rgb = seen(World(field, media=order), o, d).rgb[inside]
        length = 10 / -d[inside, 2:]
        first, second = torch.exp(-0.05 * length), torch.exp(-0.2 * length)
        ground = second * torch.ones(3) + (1 - second) * torch.tensor(BLUE)
        expected = first * ground + (1 - first) * torch.tensor(RED)
        assert (rgb - expected).abs().max() < 2e-3, "for any order of the tuple"


def test_overlapping_homogeneous_media_equal_their_mixture():
    one, other = Medium(0.02, None, 0.0, RED), Medium(0.06, None, 0.0, BLUE)
    mixed = Medium(0.08, None, 0.0, (0.25, 0.0, 0.75))
    o, d = rays()
    t = torch.linspace(0.0, 80.0, 200)
    t[-1] = torch.inf
    radiance = torch.rand(200, 3, generator=torch.Generator().manual_seed(1))
    both = media.attenuate([one, other], radiance, o, d, t)
    assert torch.allclose(both, media.attenuate([mixed], radiance, o, d, t), atol=1e-5)
    clear = media.transmittance([one, other], o, d, t)
    assert torch.allclose(clear, torch.exp(-0.08 * t), atol=1e-6)


@pytest.mark.parametrize("falloff", [2.0, 15.0])
def test_stratified_media_equal_fine_quadrature(falloff):
    """Media of different scale heights have no joint closed form: compare with 20 000 steps."""
    one, other = Medium(0.1, falloff, 0.0, RED), Medium(0.05, None, 0.0, BLUE)
    o, d = rays(20)
    t = torch.linspace(5.0, 60.0, 20)
    ours = media.attenuate([one, other], torch.ones(20, 3), o, d, t).double()
    steps = 20_000
    for r in range(20):
        s = (torch.arange(steps).double() + 0.5) / steps * float(t[r])
        z = 20.0 + s * float(d[r, 2])
        a = 0.1 * torch.exp(-z.clamp_min(0) / falloff)
        b = torch.full_like(a, 0.05)
        tau = (a + b) * float(t[r]) / steps
        before = torch.exp(-(tau.cumsum(0) - tau))
        source = a[:, None] * torch.tensor(RED) + b[:, None] * torch.tensor(BLUE)
        source = source / (a + b)[:, None]
        expected = (before * (1 - torch.exp(-tau)))[:, None] * source
        expected = expected.sum(0) + torch.exp(-tau.sum()) * torch.ones(3)
        assert (ours[r] - expected).abs().max() < 0.02


def test_two_matters_are_merged_by_distance_and_have_their_own_layers():
    high = Sheet(5.0, 0.3, RED, "mask_high", "high_thickness")
    low = Sheet(2.0, 0.6, BLUE, "mask_low", "low_thickness")
    o, d = rays()
    sky = torch.tensor([0.2, 0.4, 0.2])
    expected = 0.3 * torch.tensor(RED) + 0.7 * (0.6 * torch.tensor(BLUE) + 0.4 * sky)
    for matters in ((high, low), (low, high)):
        found = seen(World(AIR, matters=matters), o, d)
        assert (found.rgb - expected).abs().max() < 1e-4
        assert torch.allclose(found.layers["mask_high"], torch.tensor(0.3), atol=1e-5)
        assert torch.allclose(found.layers["mask_low"], torch.tensor(0.42), atol=1e-5)
        assert torch.allclose(found.layers["low_thickness"], torch.tensor(0.5), atol=1e-5)


def test_two_media_and_two_matters_have_the_closed_form():
    """Light of each sheet is attenuated by the media in front of it only."""
    high = Sheet(5.0, 0.3, RED, "mask_high", "high_thickness")
    low = Sheet(2.0, 0.6, BLUE, "mask_low", "low_thickness")
    one, other = Slab(0.05, 0.0, 30.0, (0.5, 0.5, 0.5)), Slab(0.1, 0.0, 4.0, (0.9, 0.9, 0.9))
    other = Slab(0.1, 0.0, 4.0, (0.9, 0.9, 0.9), mask="mask_low_air")
    o, d = rays()
    found = seen(World(AIR, media=(one, other), matters=(low, high)), o, d)
    path = 1 / -d[:, 2:]
    grey, white = torch.tensor([0.5] * 3), torch.tensor([0.9] * 3)
    above = torch.exp(-0.05 * 15 * path)  # 20 m to 5 m
    at_high = above * torch.tensor(RED) + (1 - above) * grey
    to_top = torch.exp(-0.05 * 16 * path)  # 20 m to 4 m, where the second medium begins
    mean = (0.05 * grey + 0.1 * white) / 0.15
    through = torch.exp(-0.15 * 2 * path)  # 4 m to 2 m, both
    at_low = to_top * (through * torch.tensor(BLUE) + (1 - through) * mean) + (1 - to_top) * grey
    down = torch.exp(-0.15 * 4 * path)  # 4 m to 0 m; the sky is below
    sky = torch.tensor([0.2, 0.4, 0.2])
    at_sky = to_top * (down * sky + (1 - down) * mean) + (1 - to_top) * grey
    expected = 0.3 * at_high + 0.42 * at_low + 0.28 * at_sky
    assert (found.rgb - expected).abs().max() < 1e-3
    assert {"mask_slab", "mask_low_air", "mask_high", "mask_low"} <= found.layers.keys()


def test_matter_may_add_light_that_depends_on_the_pixel():
    o, d = rays()
    plain = Sheet(0.0, 0.9999, BLUE, "mask_blue", "blue_thickness")
    glitter = Glitter(0.0, 0.9999, BLUE, "mask_blue", "blue_thickness")
    narrow, wide = (torch.full((len(d),), angle) for angle in (1e-6, 1.0))
    seen = [
        trace(World(AIR, matters=(matter,)), o, d, angle).rgb
        for matter, angle in ((plain, narrow), (glitter, narrow), (glitter, wide))
    ]
    assert seen[1] - seen[0] == pytest.approx(0.25, abs=1e-3)
    assert torch.equal(seen[2], seen[0])


@dataclass(frozen=True)
class Layers(Sheet):
    """Two layers of samples, each 6 mm thick and 0.4 m apart, in the colour of their height."""

    asked: list = field(default_factory=list)

    def march(self, rays_o, rays_d, t_min, t_max):
        n, each = len(rays_o), 4
        steps = torch.arange(2 * each)
        down = 0.4 * (steps // each) + 1.5e-3 * (steps % each)
        t = (self.height - down - rays_o[:, 2, None]) / rays_d[:, 2, None]
        offsets = torch.arange(n + 1) * 2 * each
        dt = 1.5e-3 / rays_d[:, 2, None].abs().expand_as(t).reshape(-1)
        return Samples(offsets, t.reshape(-1), dt, 100.0 + 0 * dt)

    def colour(self, x):
        self.asked.append(len(x))
        return x[:, 2:] * torch.tensor(self.own_colour)


def test_a_layer_of_samples_has_the_colour_of_its_mean_position():
    o, d = rays()
    layers = Layers(0.5, 1.0, BLUE, "mask_blue", "blue_thickness")
    seen = trace(World(AIR, matters=(layers,)), o, d, torch.full((len(d),), 1e-6)).rgb
    assert layers.asked == [2 * len(o)], "one colour a layer, and two layers"
    samples = layers.march(o, d, None, None)
    depth = (samples.sigma * samples.dt).view(len(o), 8)
    before = depth.cumsum(1) - depth
    weight = torch.exp(-before) * -torch.expm1(-depth)
    height = o[:, 2, None] + samples.t.view(len(o), 8) * d[:, 2, None]
    behind = torch.exp(-depth.sum(1, keepdim=True)) * AIR.sky(d)
    expected = (weight * height).sum(1)[:, None] * torch.tensor(BLUE) + behind
    assert seen == pytest.approx(expected.numpy(), abs=1e-4)
