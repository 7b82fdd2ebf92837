"""Rays against waves: the kernel, the twin on any device, brute force, closed forms."""

import dataclasses
import math

import pytest
import torch

from climatenerf.ops import wave_tracing
from climatenerf.ops.wave_tracing import WaveMaps, first_hits
from climatenerf.weather.flood.parameters import Flood
from climatenerf.weather.flood.waves import at_time, make_waves

LEVEL = 0.4
FAST = pytest.mark.parametrize("find", [first_hits, wave_tracing._first_hits])


@pytest.fixture(scope="module")
def sea():
    """Waves 4 cm high whose crests hide troughs."""
    return at_time(make_waves(Flood(wind_speed=3.0, wave_scale=4.0), 0, 64), 1.0)


@pytest.fixture(scope="module")
def still():
    return at_time(make_waves(Flood(wind_speed=0.0), 0), 0.0)


def rays(n, seed=0, height=2.0, steepest=1.0):
    generator = torch.Generator().manual_seed(seed)
    d = torch.randn(n, 3, generator=generator)
    d[:, 2] = -d[:, 2].abs() * steepest - 0.02
    o = torch.tensor([0.3, -0.2, height]).expand(n, 3).contiguous()
    return o, torch.nn.functional.normalize(d, dim=-1)


def above(n):
    return torch.zeros(n, dtype=torch.bool)


def footprint(o, d, angle):
    return (o[:, 2] - LEVEL) / -d[:, 2] * angle / d[:, 2].abs().sqrt()


def test_kernel_and_twin_agree(sea):
    o, d = rays(4000, steepest=0.3)
    angle = torch.full((4000,), 2e-3)
    a, b = (find(sea, LEVEL, o, d, above(4000), angle) for find in (first_hits, _twin))
    same = (a.t - b.t).abs() < 1e-3 * a.t
    assert same.float().mean() > 0.995, "but rays that graze a crest"
    close = (a.t - b.t).abs() < 2e-4 * a.t  # ripples change their slope within the tolerance of t
    assert close.float().mean() > 0.995
    torch.testing.assert_close(a.slope[close], b.slope[close], atol=5e-3, rtol=0)
    torch.testing.assert_close(a.variance, b.variance, atol=1e-7, rtol=1e-4)


def _twin(*given):
    return wave_tracing._first_hits(*given)


@FAST
def test_hits_lie_on_the_surface(find, sea):
    o, d = rays(2000)
    angle = torch.full((2000,), 1e-3)
    found = find(sea, LEVEL, o, d, above(2000), angle)
    assert torch.isfinite(found.t).all()
    x = o + found.t[:, None] * d
    height, slope, variance = sea.at(x[:, :2], footprint(o, d, angle))
    off = (x[:, 2] - LEVEL - height).abs()
    assert off.max() < 1e-2 and off.quantile(0.99) < 1e-3
    torch.testing.assert_close(found.slope, slope, atol=1e-4, rtol=0)
    torch.testing.assert_close(found.variance, variance, atol=1e-7, rtol=1e-4)


@FAST
def test_crests_hide_troughs(find, sea):
    """The first crossing of finely marched rays; some meet the level plane metres further on."""
    o, d = rays(300, seed=3, steepest=0.05)
    angle = torch.full((300,), 5e-4)
    found = find(sea, LEVEL, o, d, above(300), angle).t
    plane = (LEVEL - o[:, 2]) / d[:, 2]
    share = torch.linspace(0, 1, 4000)
    crest = sea.crest()
    begin, end = (LEVEL + crest - o[:, 2]) / d[:, 2], (LEVEL - crest - o[:, 2]) / d[:, 2]
    t = begin[:, None] + share * (end - begin)[:, None]
    x = o[:, None] + t[..., None] * d[:, None]
    width = footprint(o, d, angle)[:, None].expand_as(t).reshape(-1)
    height = sea.at(x[..., :2].reshape(-1, 2), width)[0].view_as(t)
    under = x[..., 2] - LEVEL - height <= 0
    expected = t.gather(1, under.int().argmax(1)[:, None])[:, 0]
    assert under.any(1).all()
    close = (found - expected).abs() < 0.02
    assert close.float().mean() > 0.97, "steps may jump a ripple's tip"
    assert (found >= expected - 0.02).all(), "nothing is met before it is there"
    assert (expected - plane).abs().max() > 0.3


@FAST
def test_still_water_is_a_plane(find, still):
    o, d = rays(500)
    found = find(still, LEVEL, o, d, above(500), torch.full((500,), 1e-3))
    torch.testing.assert_close(found.t, (LEVEL - o[:, 2]) / d[:, 2])
    assert not found.slope.any() and not found.variance.any()
    up = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    missed = find(still, LEVEL, o[:2], up, above(2), torch.full((2,), 1e-3))
    assert torch.isinf(missed.t).all()


@FAST
def test_from_below_the_same_surface_is_met(find, sea):
    o, d = rays(500)
    o, d = o - torch.tensor([0.0, 0.0, 2 * (2.0 - LEVEL)]), d * torch.tensor([1.0, 1.0, -1.0])
    angle = torch.full((500,), 1e-3)
    found = find(sea, LEVEL, o, d, ~above(500), angle)
    x = o + found.t[:, None] * d
    width = (LEVEL - o[:, 2]) / d[:, 2] * angle / d[:, 2].abs().sqrt()
    off = (x[:, 2] - LEVEL - sea.at(x[:, :2], width)[0]).abs()
    assert off.max() < 1e-2 and off.quantile(0.99) < 1e-3


@FAST
def test_an_eye_among_the_waves_meets_the_crest_before_it(find):
    """A single wave h = a cos(k x), in closed form: from a trough, level, half a wavelength on."""
    n, side, a = 64, 8.0, 0.1
    x = torch.arange(n) * side / n
    k = 2 * math.pi / side
    height = (a * torch.cos(k * x)).expand(n, n)
    slope = (-a * k * torch.sin(k * x)).expand(n, n)
    levels = [torch.stack([height, slope, 0 * height], -1).reshape(-1, 3)]
    levels += [torch.zeros((n >> i) ** 2, 3) for i in range(1, 7)]
    none = torch.zeros(1, 7)
    highest = torch.cat([torch.full((1, 1), a), none[:, 1:]], 1)
    zero = torch.zeros(1)
    maps = WaveMaps(
        torch.cat(levels), torch.zeros(1, dtype=torch.int64), torch.tensor([side]), 6, zero,
        none, none, highest, 0.0,
    )  # fmt: skip
    o = torch.tensor([[side / 2, 0.0, -0.05]])
    ahead = torch.tensor([[1.0, 0.0, 0.0]])
    found = find(maps, 0.0, o, ahead, above(1), torch.full((1,), 1e-6))
    expected = side / 2 - math.acos(-0.5) / k
    assert found.t.item() == pytest.approx(expected, abs=0.02)
    over = find(maps, 0.0, o + torch.tensor([0.0, 0.0, 0.2]), ahead, above(1), zero + 1e-6)
    assert torch.isinf(over.t).all()


def test_waves_far_away_are_flat_and_leave_their_variance(sea):
    o, d = rays(200, height=60.0)
    found = first_hits(sea, LEVEL, o, d, above(200), torch.full((200,), 1.0))
    torch.testing.assert_close(found.t, (LEVEL - o[:, 2]) / d[:, 2])
    assert found.slope.abs().max() < 1e-3
    assert found.variance == pytest.approx(float(sea.slope_variance.sum()) + sea.unresolved)


def test_maps_may_hold_a_single_tile(sea):
    first = dataclasses.replace(
        sea, **{
            name: getattr(sea, name)[:1]
            for name in ("start", "side", "slope_variance", "level_variance",
                         "level_covariance", "highest")
        }
    )  # fmt: skip
    o, d = rays(100)
    assert torch.isfinite(
        first_hits(first, LEVEL, o, d, above(100), torch.full((100,), 1e-3)).t
    ).all()


@FAST
def test_descending_rays_reach_the_sea_whatever_its_waves(find):
    """Waves of a gale are metres high; rays stay between crest and trough for longer than REACH."""
    gale = at_time(make_waves(Flood(wind_speed=40.0, fetch=1e6, depth=100.0), 0, 64), 0.0)
    o, d = rays(500, seed=5, height=LEVEL + 12.0, steepest=0.02)
    found = find(gale, LEVEL, o, d, above(500), torch.full((500,), 1e-3))
    assert torch.isfinite(found.t).all() and (found.t > 0).all()
    assert (found.t > wave_tracing.REACH).any()


@dataclasses.dataclass(frozen=True)
class Hump:
    """A mound of water h = a exp(-r^2 / 2 s^2), as a modelled surface might have: no waves."""

    a: float = 0.3
    s: float = 1.0
    still = False

    def crest(self):
        return self.a

    def crest_of(self, footprint):
        return torch.full_like(footprint, self.a)

    def at(self, x, footprint):
        h = self.a * torch.exp(-x.square().sum(-1) / (2 * self.s**2))
        return h, -h[:, None] * x / self.s**2, torch.zeros_like(h)


def test_any_surface_is_met_where_finely_marched_rays_meet_it():
    """Also by rays that climb, and from beyond the mound, which hides the water behind it."""
    o, d = rays(400, seed=5, height=0.9, steepest=0.2)
    o = o + torch.tensor([-3.0, 0.0, 0.0])
    d[:, 0] = d[:, 0].abs()
    d[:100, 2] = 0.05
    d = torch.nn.functional.normalize(d, dim=-1)
    hump = Hump()
    found = first_hits(hump, LEVEL, o, d, above(400), torch.full((400,), 1e-3))
    t = torch.linspace(0, 40, 40001)
    expected = torch.full((400,), torch.inf)
    for r in range(400):
        x = o[r] + t[:, None] * d[r]
        under = (x[:, 2] - LEVEL - hump.at(x[:, :2], t)[0] <= 0).nonzero()
        if len(under):
            expected[r] = t[under[0, 0]]
    met = torch.isfinite(expected)
    plane = (LEVEL - o[:, 2]) / d[:, 2]
    assert int((met & ((expected - plane).abs() > 0.5)).sum()) > 50, "the mound matters"
    assert (found.t[met] - expected[met]).abs().max() < 0.02
    torch.testing.assert_close(
        found.slope[met], hump.at((o + found.t[:, None] * d)[met, :2], t)[1], atol=1e-5, rtol=0
    )
    assert torch.isinf(found.t[~met & (d[:, 2] > 0)]).all()
