"""Optics of flood water: intersection, ray directions, radiance and energy conservation."""

import math

import numpy as np
import pytest
import torch

from climatenerf.verification.closed_forms import returned_light
from climatenerf.weather.flood import fresnel, waves
from climatenerf.weather.flood import optics as water
from climatenerf.weather.flood.parameters import Flood
from climatenerf.weather.flood.surface import PARTS

IOR = 1.333
PUDDLE = Flood(level=0.0)
SHARP = Flood(level=0.0, gloss=1e9)


def rays(n: int, seed: int = 0, below: bool = False) -> torch.Tensor:
    """Random directions towards the plane from above, or from below."""
    d = torch.randn(n, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    d[:, 2] = d[:, 2].abs() * (1 if below else -1)
    return d / d.norm(dim=-1, keepdim=True)


def above_water(d: torch.Tensor) -> torch.Tensor:
    """The argument `below` for rays that are all above water."""
    return torch.zeros(len(d), dtype=torch.bool)


def at_angle(degrees: float) -> torch.Tensor:
    angle = math.radians(degrees)
    return torch.tensor([[math.sin(angle), 0.0, -math.cos(angle)]], dtype=torch.float64)


UP = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)


# --- intersection -----------------------------------------------------------------------------


def test_distance_to_the_water_plane():
    o = torch.tensor([[0.0, 0.0, 3.0], [0, 0, 3], [0, 0, -1], [0, 0, -1], [0, 0, 3], [0, 0, 1]])
    d = torch.tensor(
        [[0.0, 0.0, -1.0], [0, 0, 1], [0, 0, 1], [0, 0, -1], [1, 0, 0], [0.6, 0, -0.8]]
    )
    t = water.plane_distance(o, d, 1.0)
    assert t[:5].tolist() == [2, math.inf, 2, math.inf, math.inf]
    assert t[5] == math.inf  # a ray that starts in the plane
    d.requires_grad_()
    t = water.plane_distance(o, d, 1.0)
    t[torch.isfinite(t)].sum().backward()
    assert torch.isfinite(d.grad).all()


def test_footprint_is_the_geometric_mean_of_width_and_length():
    t, pixel = torch.tensor([10.0, 10.0]).double(), 2e-3
    d = torch.cat([at_angle(0), at_angle(60)])
    seen = water.footprint(t, d, pixel)
    assert seen.tolist() == pytest.approx([0.02, math.sqrt(0.02 * 0.04)])


def test_coverage_equals_the_counted_fraction_of_the_pixel():
    """Sloping ground meets level water; the reference counts 400 sub-pixels."""
    slope = math.tan(math.radians(8))  # ground rises along +x and meets the water at x = 10
    normal = torch.tensor([-slope, 0.0, 1.0], dtype=torch.float64)
    normal = normal / normal.norm()
    pixel = 2e-3
    centre = math.atan2(10, 1.6)  # camera 1.6 m above the water

    angles = centre + pixel * torch.linspace(-1.2, 1.2, 25, dtype=torch.float64)
    d = torch.stack([torch.sin(angles), 0 * angles, -torch.cos(angles)], dim=-1)
    t_plane = -1.6 / d[:, 2]
    # The ground is z = slope (x - 10) over the water, so the camera is 1.6 + 10 slope above it.
    t_ground = -(1.6 + 10 * slope) * normal[2] / (d @ normal)
    seen = water.shore_coverage(t_plane, t_ground, d, pixel, normal.expand(25, 3))
    fine = angles[:, None] + pixel * (torch.arange(400, dtype=torch.float64) - 199.5) / 400
    counted = (fine < centre).double().mean(-1)
    assert (seen - counted).abs().max() < 0.02


def test_coverage_increases_with_the_level():
    d = rays(300)
    t_ground = 1 + 30 * torch.rand(300, generator=torch.Generator().manual_seed(1)).double()
    t_ground[:20] = torch.inf
    normal = rays(300, seed=2, below=True)
    o = torch.zeros(300, 3, dtype=torch.float64)
    for normals in (None, normal):
        last = torch.zeros(300, dtype=torch.float64)
        for level in torch.linspace(-8, -0.1, 40):
            t_plane = water.plane_distance(o, d, float(level))
            now = water.shore_coverage(t_plane, t_ground, d, 2e-3, normals)
            assert ((now >= 0) & (now <= 1)).all()
            assert (now >= last - 1e-12).all()
            last = now
    missed = water.shore_coverage(torch.full((300,), torch.inf).double(), t_ground, d, 2e-3)
    assert not missed.any()
    sky = water.shore_coverage(t_plane, torch.full((300,), torch.inf).double(), d, 2e-3)
    assert (sky == 1).all()


def test_coverage_is_continuous_with_finite_gradients():
    d = at_angle(80).expand(2001, 3)
    t_ground = torch.linspace(9.9, 10.1, 2001, dtype=torch.float64, requires_grad=True)
    t_plane = torch.full((2001,), 10.0, dtype=torch.float64, requires_grad=True)
    for normal in (None, UP.expand(2001, 3)):  # ground parallel to the water is singular
        seen = water.shore_coverage(t_plane, t_ground, d, 2e-3, normal)
        assert seen.diff().max() < 0.06 and (seen.diff() >= 0).all()
        seen.sum().backward()
        assert torch.isfinite(t_ground.grad).all() and torch.isfinite(t_plane.grad).all()


# --- directions -------------------------------------------------------------------------------


def test_refraction_obeys_snells_law():
    for degrees in (0, 30, 60, 89):
        out, total = water.refract(at_angle(degrees), UP, IOR, torch.tensor([False]))
        assert not total.item()
        sine = math.sin(math.radians(degrees)) / IOR
        assert out[0].tolist() == pytest.approx([sine, 0, -math.sqrt(1 - sine**2)], abs=1e-6)


def test_refraction_is_reversible_up_to_the_critical_angle():
    d = rays(500)
    normal = water.normal_of(0.02 * torch.randn(500, 2, dtype=torch.float64))
    down, total = water.refract(d, normal, IOR, above_water(d))
    usable = (d * normal).sum(-1) < 0
    assert not total[usable].any()
    back, total = water.refract(-down, normal, IOR, ~above_water(d))
    assert not total[usable].any()
    torch.testing.assert_close(back[usable], -d[usable], atol=1e-5, rtol=0)
    critical = math.degrees(math.asin(1 / IOR))
    for degrees, expected in ((critical - 0.1, False), (critical + 0.1, True)):
        _, total = water.refract(-at_angle(degrees), UP, IOR, torch.tensor([True]))
        assert total.item() is expected


def test_apparent_depth_near_the_nadir_is_depth_over_ior():
    d = at_angle(2)
    out, _ = water.refract(d, UP, IOR, torch.tensor([False]))
    offset = 2.0 / -out[0, 2] * out[0, 0]  # on the bottom, 2 m down
    apparent = offset / math.tan(math.radians(2))
    assert apparent.item() == pytest.approx(2.0 / IOR, rel=0.01)


def test_parts_of_a_pixel_lie_within_it_in_rows_and_columns():
    d = rays(50)
    angle = torch.full((50,), 0.01, dtype=torch.float64)
    parts = water.subpixels(d, angle, PARTS)
    torch.testing.assert_close(parts.norm(dim=-1), torch.ones(50, PARTS, dtype=torch.float64))
    torch.testing.assert_close(parts.mean(1), d, atol=1e-4, rtol=0)
    off = parts - d[:, None]
    assert off.norm(dim=-1).max() < 0.01
    level = torch.stack([-d[:, 1], d[:, 0], 0 * d[:, 0]], -1)
    within = torch.linalg.cross(d, torch.nn.functional.normalize(level, dim=-1))
    row = (off * within[:, None]).sum(-1).sort(dim=1).values
    torch.testing.assert_close(
        row.diff(dim=1), torch.full((50, PARTS - 1), 0.01 / PARTS).double(), atol=1e-5, rtol=0
    )
    torch.testing.assert_close(water.subpixels(d, angle, 1)[:, 0], d)


def spread_over(d, slope, variance, flood, below, count=PARTS):
    """`facets` for parts that all have the same direction and slope."""
    given = (each[:, None].expand(-1, count, *each.shape[1:]) for each in (d, slope, variance))
    return water.facets(*given, flood, below)


def test_facets_reflect_as_a_rough_surface_does():
    """Mean and variance of the reflected direction, per component, by brute force."""
    deviation, n = 0.03, 200_000
    generator = torch.Generator().manual_seed(0)
    slope = deviation * torch.randn(n, 2, generator=generator, dtype=torch.float64)
    for degrees in (5, 50, 75):
        d = at_angle(degrees)
        normal = water.normal_of(slope)
        weight = -(d * normal).sum(-1) / normal[:, 2]
        true = water.mirror(d.expand(n, 3), normal)
        variance = torch.tensor([deviation**2], dtype=torch.float64)
        flat = torch.zeros(1, 2, dtype=torch.float64)
        seen, _ = spread_over(d, flat, variance, SHARP, above_water(d))
        for component in range(3):
            mean = (weight * true[:, component]).sum() / weight.sum()
            spread = (weight * (true[:, component] - mean) ** 2).sum() / weight.sum()
            actual = seen[0, :, component].mean()
            assert actual.item() == pytest.approx(mean.item(), abs=2e-3)
            actual_spread = seen[0, :, component].var(unbiased=False)
            assert actual_spread.item() == pytest.approx(spread.item(), rel=0.06, abs=2e-5)


def test_no_two_facets_are_alike():
    d, flat = at_angle(50), torch.zeros(1, 2, dtype=torch.float64)
    seen, _ = spread_over(d, flat, torch.full((1,), 1e-3).double(), SHARP, above_water(d))
    apart = torch.cdist(seen[0], seen[0]) + torch.eye(PARTS)
    assert apart.min() > 0.02


@pytest.mark.parametrize("sky", ["zenith", "horizon"])
@pytest.mark.parametrize("degrees", [30, 60, 70, 80, 85])
def test_each_facet_reflects_by_its_own_angle(degrees, sky):
    """A sky whose radiance changes with elevation, against brute force over facets."""
    deviation, n = 0.08, 400_000
    generator = torch.Generator().manual_seed(1)
    slope = deviation * torch.randn(n, 2, generator=generator, dtype=torch.float64)
    d, normal = at_angle(degrees), water.normal_of(slope)
    cos = -(d * normal).sum(-1)
    weight = (cos / normal[:, 2]).clamp_min(0)

    def radiance(direction):
        up = direction[..., 2].clamp(0, 1)
        return 0.2 + up if sky == "zenith" else 1.2 - up

    true = radiance(water.mirror(d.expand(n, 3), normal)) * fresnel.reflectance(cos, IOR)
    expected = (weight * true).sum() / weight.sum()
    variance = torch.tensor([deviation**2], dtype=torch.float64)
    flat = torch.zeros(1, 2, dtype=torch.float64)
    seen, share = spread_over(d, flat, variance, SHARP, above_water(d))
    assert (share * radiance(seen)).sum().item() == pytest.approx(expected.item(), rel=0.05)


def test_reflected_rays_stay_on_their_side_of_the_water():
    for below in (False, True):
        d = rays(400, below=below)
        slope = 0.3 * torch.randn(400, 2, dtype=torch.float64)
        variance = 0.05 * torch.rand(400, dtype=torch.float64)
        under = torch.full((400,), below)
        seen, share = spread_over(d, slope, variance, PUDDLE, under)
        assert (seen[..., 2] <= 0).all() if below else (seen[..., 2] >= 0).all()
        torch.testing.assert_close(seen.norm(dim=-1), torch.ones(400, PARTS, dtype=torch.float64))
        assert ((share >= 0) & (share.sum(1, keepdim=True) <= 1 + 1e-9)).all()


def test_flat_water_of_high_gloss_is_a_mirror():
    d = rays(100)
    flat = torch.zeros(100, 2, dtype=torch.float64)
    still = torch.zeros(100, dtype=torch.float64)
    seen, share = spread_over(d, flat, still, SHARP, above_water(d), count=1)
    expected = d * torch.tensor([1, 1, -1])
    assert (seen - expected[:, None]).norm(dim=-1).max() < 6e-5
    torch.testing.assert_close(
        share[:, 0], fresnel.reflectance(-d[:, 2], IOR), atol=1e-6, rtol=1e-5
    )


# --- radiance ---------------------------------------------------------------------------------


def test_wet_bottom_equals_path_traced_radiance():
    """At the nadir under a uniform sky: .076 .202 .453 for dry albedos .1 .3 .6."""
    sky = torch.tensor([math.pi] * 3)
    for albedo, expected in ((0.1, 0.076), (0.3, 0.202), (0.6, 0.453)):
        bottom = water.bottom_radiance(torch.full((1, 3), albedo), sky, IOR)
        reflectance = fresnel.reflectance(torch.ones(1), IOR)
        seen = water.shade(torch.ones(1, 3), reflectance, bottom, torch.ones(1, 3), torch.zeros(3))
        assert seen[0, 0].item() == pytest.approx(expected, abs=0.002)


@pytest.mark.parametrize("albedo", [0.1, 0.3, 0.6])
def test_light_between_surface_and_bed_is_absorbed_on_every_way(albedo):
    """A bed 0.6 m deep, attenuation 1.2/m; without it a bed of .6 was 37 % too bright."""
    sky, dry = torch.tensor([math.pi] * 3), torch.full((1, 3), albedo)
    thick = torch.full((1, 3), 1.2 * 0.6)
    free = water.bottom_radiance(dry, sky, IOR)
    seen = water.bottom_radiance(dry, sky, IOR, optical_depth=thick)
    expected = (1 - albedo * 0.4746) / (1 - albedo * returned_light(np.array(0.72), IOR))
    assert (seen / free)[0, 0].item() == pytest.approx(float(expected), rel=1e-3)
    torch.testing.assert_close(
        water.bottom_radiance(dry, sky, IOR, optical_depth=0 * thick), free, atol=1e-6, rtol=1e-5
    )


def test_white_bottom_stays_white_and_black_stays_finite():
    white = water.bottom_radiance(torch.ones(1, 3), torch.tensor([math.pi] * 3), IOR)
    torch.testing.assert_close(white, torch.ones(1, 3), atol=1e-6, rtol=0)
    dark = water.bottom_radiance(torch.zeros(1, 3), torch.zeros(3), IOR)
    assert torch.equal(dark, torch.zeros(1, 3))
    wet = water.bottom_radiance(torch.rand(50, 3), torch.tensor([math.pi] * 3), IOR)
    assert (wet <= 1).all()


@pytest.mark.parametrize("below", [False, True])
def test_white_furnace(below):
    """Radiance 1 everywhere, white bottom, clear water, waves on: 1 at every pixel."""
    d = rays(2000, below=below).float()
    under = torch.full((2000,), below)
    frame = waves.at_time(waves.make_waves(PUDDLE, 0, 64), 0.4)
    x = 10 * torch.rand(2000, 2)
    _, slope, removed = frame.at(x, torch.rand(2000))
    _, share = spread_over(d, slope, removed, PUDDLE, under)
    reflectance, reflected = share.sum(1), torch.ones(2000, 3)
    white = torch.tensor([math.pi] * 3)
    background = (
        torch.ones(2000, 3) if below else water.bottom_radiance(torch.ones(2000, 3), white, IOR)
    )
    path = 5 * torch.rand(2000)
    transmittance = water.water_transmittance(torch.zeros(3), path, 0.8 * path, 0.83)
    result = water.shade(
        reflected, reflectance, background, transmittance, water.body_colour(PUDDLE, white)
    )
    assert (result - 1).abs().max() < 1e-3


def test_transmittance_recovers_the_attenuation():
    beta = torch.tensor([0.4, 1.1, 2.5])
    depth = torch.linspace(0.1, 3, 50)
    path = depth / 0.9
    seen = water.water_transmittance(beta, path, depth, 0.83)
    recovered = -torch.log(seen) / (path + depth / 0.83)[:, None]
    torch.testing.assert_close(recovered, beta.expand(50, 3), rtol=0.01, atol=0)
    infinite = torch.tensor([torch.inf])
    for attenuation, expected in ((torch.zeros(3), 1), (beta, 0)):
        seen = water.water_transmittance(attenuation, infinite, infinite, 0.83)
        assert seen.tolist() == [[expected] * 3]


def test_clarity_is_the_depth_of_two_percent_contrast():
    """A white disc at the depth `clarity` keeps 2 % of its contrast, mean over channels."""
    beta = torch.tensor(water.attenuation(Flood(clarity=0.3)))
    assert math.exp(-2 * 0.3 * beta.mean().item()) == pytest.approx(0.02, rel=0.1)
    assert beta[0] < beta[1] < beta[2]  # muddy water is brown
    clear = water.attenuation(Flood(clarity=100.0))
    assert clear[0] > clear[1] > clear[2]  # deep clear water is blue
    assert water.attenuation(Flood(attenuation=(1, 2, 3))) == (1, 2, 3)


def test_body_colour_is_proportional_to_irradiance():
    noon = water.body_colour(PUDDLE, torch.tensor([math.pi] * 3))
    assert noon.tolist() == pytest.approx([0.2029, 0.1373, 0.0836], abs=1e-3)  # sRGB decoded
    torch.testing.assert_close(water.body_colour(PUDDLE, torch.tensor([0.1] * 3)), noon / 31.416)


def test_light_cosine_of_sun_and_uniform_sky():
    assert water.light_cosine(PUDDLE, math.radians(90)) == pytest.approx(1)
    assert water.light_cosine(PUDDLE, math.radians(30)) == pytest.approx(0.760, abs=1e-3)
    # Mean of 1/cos under water over refracted diffuse light.
    mu = (torch.arange(100_000, dtype=torch.float64) + 0.5) / 100_000
    weight = 2 * mu * (1 - fresnel.reflectance(mu, IOR))
    inside = torch.sqrt(1 - (1 - mu**2) / IOR**2)
    mean = (weight / inside).sum() / weight.sum()
    assert water.light_cosine(PUDDLE, None) == pytest.approx(1 / mean.item(), abs=0.01)


def test_gradients_are_finite_everywhere():
    d = torch.cat([rays(20), rays(20, below=True), UP, -UP, at_angle(90), at_angle(89.9)]).float()
    under = d[:, 2] > 0
    for deviation in (0.0, 0.05):
        ray = d.clone().requires_grad_()
        slope = (deviation * torch.randn(len(d), 2)).requires_grad_()
        variance = torch.full((len(d),), deviation**2, requires_grad=True)
        seen, reflectance = spread_over(ray, slope, variance, PUDDLE, under)
        out, _ = water.refract(ray, water.normal_of(slope), IOR, under)
        (seen[..., :2].sum() + seen[..., 2].sum() + reflectance.sum() + out.sum()).backward()
        for value in (seen, reflectance, out, ray.grad, slope.grad, variance.grad):
            assert torch.isfinite(value).all()
