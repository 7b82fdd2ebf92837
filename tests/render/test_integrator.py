"""Physics of smog, flood, snow and their composition, tested through the renderer."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from support.analytic_fields import AnalyticField, Box, HalfSpace
from support.random_field import directions, random_field
from support.threads import threads

from climatenerf.core.cameras import Camera
from climatenerf.core.samples import MIN_TAU, Samples
from climatenerf.ops import compositing
from climatenerf.render import integrator as trace_module
from climatenerf.render.frame import render_frame
from climatenerf.render.integrator import trace
from climatenerf.verification.closed_forms import returned_light
from climatenerf.weather.flood.fresnel import reflectance
from climatenerf.weather.flood.parameters import Flood
from climatenerf.weather.flood.surface import Water
from climatenerf.weather.flood.waves import at_time, make_waves
from climatenerf.weather.smog.medium import medium
from climatenerf.weather.smog.parameters import Smog
from climatenerf.weather.snow.layer import bake_snow
from climatenerf.weather.snow.parameters import Snow
from climatenerf.weather.world import World

WIDE = ((-3000.0, -3000.0, -20.0), (3000.0, 3000.0, 30.0))
CAMERA = Camera(96, 54, 60.0, 60.0, 48.0, 27.0)


def pose_along(direction, eye=(0.0, -3.0, 1.6)):
    """Pose with its axis along a direction and a level horizon."""
    forward = np.array(direction, float)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    c2w = np.eye(4)
    c2w[:3, 0], c2w[:3, 1], c2w[:3, 2] = right, np.cross(forward, right), forward
    c2w[:3, 3] = eye
    return c2w


def street():
    """Ground that rises along y, a wall, a box, and a sky with a vertical gradient."""
    slope = np.array([0.0, -0.1, 1.0])
    slope /= np.linalg.norm(slope)
    return AnalyticField(
        [
            HalfSpace(tuple(slope), 0.0, (0.30, 0.33, 0.2), checker=0.7),
            Box((-2.0, 6.0, -1.0), (0.5, 8.0, 3.0), (0.6, 0.3, 0.2)),
            Box((1.0, 2.0, -1.0), (2.0, 3.0, 1.0), (0.2, 0.2, 0.7)),
        ],
        zenith=(0.3, 0.5, 0.9),
        horizon=(0.8, 0.8, 0.8),
        box=((-60.0, -60.0, -20.0), (60.0, 60.0, 30.0)),
    )


def flooded(level=0.3, **changes):
    flood = dataclasses.replace(Flood(level=level), **changes)
    waves = at_time(make_waves(flood, 0), 0.4)
    return Water(flood, level, waves, torch.full((3,), math.pi * 0.6))


def values(seen, name):
    """An attribute or a layer of a render output."""
    return seen.layers[name] if name in seen.layers else getattr(seen, name)


def frame(world, eye=(0.0, -3.0, 1.6), direction=(0.0, 1.0, -0.2), camera=CAMERA):
    return render_frame(world, camera, pose_along(direction, eye))


def linear(world, direction=(0.0, 1.0, -0.2), eye=(0.0, -3.0, 1.6)):
    from climatenerf.render.volume import camera_rays

    o, d = camera_rays(CAMERA, pose_along(direction, eye))
    return trace(world, o, d, torch.full((o.shape[0],), 1 / 60))


# --- smog ---------------------------------------------------------------------------------------


def test_smog_contrast_decreases_exponentially_with_depth():
    air = medium(Smog(visibility=30.0), 0.0)
    dry, hazy = linear(World(street())), linear(World(street(), media=(air,)))
    colour = torch.tensor(air.colour)
    solid = torch.isfinite(dry.depth)
    for c in range(3):
        contrast = (hazy.rgb[solid, c] - colour[c]) / (dry.rgb[solid, c] - colour[c])
        y, x = contrast.log(), dry.depth[solid]
        slope = ((x - x.mean()) * (y - y.mean())).sum() / (x - x.mean()).square().sum()
        explained = torch.corrcoef(torch.stack([x, y]))[0, 1] ** 2
        assert abs(float(slope) / -(2.996 / 30) - 1) < 0.005
        assert explained > 0.999


def test_infinite_smog_hides_the_sky():
    seen = linear(World(street(), media=(medium(Smog(visibility=30.0), 0.0),)))
    sky = torch.isinf(seen.depth)
    assert sky.any()
    assert torch.allclose(seen.rgb[sky], torch.tensor(medium(Smog(sigma=1.0), 0.0).colour))
    assert (seen.transmittance[sky] == 0).all()


# --- flood --------------------------------------------------------------------------------------


def test_white_furnace():
    white = AnalyticField(
        [HalfSpace(colour=(1.0, 1.0, 1.0))], zenith=(1.0,) * 3, horizon=(1.0,) * 3, box=WIDE
    )
    flood = Flood(level=0.5, attenuation=(0.0, 0.0, 0.0), wind_speed=4.0)
    water = Water(flood, 0.5, at_time(make_waves(flood, 0), 0.3), torch.full((3,), math.pi))
    generator = torch.Generator().manual_seed(0)
    d = torch.randn(3000, 3, generator=generator)
    d[:, 2] = -d[:, 2].abs() - 0.02
    d = torch.nn.functional.normalize(d, dim=-1)
    o = torch.tensor([0.0, 0.0, 1.6]).expand_as(d).contiguous()
    seen = trace(World(white, surfaces=(water,)), o, d, torch.full((3000,), 2e-3))
    assert (seen.rgb - 1).abs().max() < 1e-3
    assert seen.layers["mask_water"].min() > 0.999


def test_a_perfect_mirror_equals_the_view_of_a_mirrored_camera():
    """R = 1 without waves: water shows the view of a mirrored camera, clipped at the plane."""
    level = 0.3
    still = flooded(level, wind_speed=0.0)
    water = dataclasses.replace(still, mirror_only=True)
    world = World(street(), surfaces=(water,))
    seen = linear(world)
    from climatenerf.render.volume import camera_rays

    o, d = camera_rays(CAMERA, pose_along((0.0, 1.0, -0.2)))
    t = (level - o[:, 2]) / d[:, 2]
    wet = (d[:, 2] < 0) & (seen.layers["mask_water"] > 0.999)
    assert wet.float().mean() > 0.1
    mirrored_o, mirrored_d = o.clone(), d.clone()
    mirrored_o[:, 2] = 2 * level - o[:, 2]
    mirrored_d[:, 2] *= -1
    start = mirrored_o[wet] + t[wet, None] * mirrored_d[wet]
    clean = trace(World(street()), start, mirrored_d[wet], torch.full((int(wet.sum()),), 1 / 60))
    error = (clean.rgb - seen.rgb[wet]).square().mean()
    assert -10 * math.log10(float(error) + 1e-12) >= 40


def test_still_water_is_as_sharp_as_a_mirror_by_default():
    """What black water reflects is the mirror's picture times R."""
    from climatenerf.render.volume import camera_rays

    dark = flooded(0.3, wind_speed=0.0, attenuation=(1e4,) * 3, colour=(0.0,) * 3)
    mirror = linear(World(street(), surfaces=(dataclasses.replace(dark, mirror_only=True),)))
    seen = linear(World(street(), surfaces=(dark,)))
    wet = seen.layers["mask_water"] > 0.999
    _, d = camera_rays(CAMERA, pose_along((0.0, 1.0, -0.2)))
    above = torch.zeros(int(wet.sum()), dtype=torch.bool)
    share = reflectance(-d[wet, 2], 1.333, above)
    error = (seen.rgb[wet] / share[:, None] - mirror.rgb[wet]).square().mean()
    assert -10 * math.log10(float(error) + 1e-12) >= 40


def test_black_water_reflects_the_sky_by_fresnel():
    """Black opaque water under a white sky has the radiance of its reflectance."""
    black = AnalyticField(
        [HalfSpace(colour=(0.0, 0.0, 0.0))], zenith=(1.0,) * 3, horizon=(1.0,) * 3, box=WIDE
    )
    flood = Flood(level=0.5, wind_speed=0.0, attenuation=(1e4,) * 3, colour=(0.0,) * 3)
    water = Water(flood, 0.5, at_time(make_waves(flood, 0), 0.0), torch.ones(3))
    angles = torch.deg2rad(torch.tensor([0.0, 30.0, 60.0, 75.0, 80.0, 85.0]))
    d = torch.stack([torch.zeros(6), angles.sin(), -angles.cos()], dim=-1)
    o = torch.tensor([0.0, 0.0, 1.6]).expand(6, 3).contiguous()
    seen = trace(World(black, surfaces=(water,)), o, d, torch.full((6,), 1e-3))
    expected = torch.tensor([0.0204, 0.0214, 0.0597, 0.212, 0.348, 0.584])
    assert torch.allclose(seen.rgb[:, 0], expected, rtol=0.01)


def test_attenuation_per_channel_is_recovered_from_the_picture():
    """A white bottom at depth d, seen vertically: c = (1-R) L exp(-beta 2.2 d)."""
    betas = (0.5, 1.0, 2.0)
    values = []
    for depth in (0.4, 0.9):
        field = AnalyticField(
            [HalfSpace(offset=-depth, colour=(0.5,) * 3)],
            zenith=(0.0,) * 3, horizon=(0.0,) * 3, box=WIDE,
        )  # fmt: skip
        flood = Flood(level=0.0, wind_speed=0.0, attenuation=betas, colour=(0.0,) * 3)
        water = Water(flood, 0.0, at_time(make_waves(flood, 0), 0.0), torch.ones(3))
        o, d = torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[0.0, 0.0, -1.0]])
        values.append(trace(World(field, surfaces=(water,)), o, d, torch.full((1,), 1e-3)).rgb[0])
    path = 0.5 * (1 + 1 / 0.83)
    # The bottom counts as white under a black sky; it receives its own light back.
    shallow, deep = (1 - returned_light(np.array(betas) * d, 1.333) for d in (0.4, 0.9))
    found = -(values[1] / values[0] * torch.tensor(deep / shallow).float()).log() / path
    assert torch.allclose(found, torch.tensor(betas), rtol=0.01)


def test_apparent_depth_near_the_nadir_is_depth_over_ior():
    """The edge of a block at depth d under water appears at the depth d / 1.333."""
    depth = 0.8
    bottom = AnalyticField(
        [HalfSpace(offset=-1.0, colour=(1.0,) * 3), Box((-9, -5, -9), (0.1, 5, -depth))],
        zenith=(0.0,) * 3, horizon=(0.0,) * 3, box=WIDE,
    )  # fmt: skip
    flood = Flood(level=0.0, wind_speed=0.0, attenuation=(0.0,) * 3)
    water = Water(flood, 0.0, at_time(make_waves(flood, 0), 0.0), torch.ones(3))
    slant = torch.linspace(0.0, 0.1, 4001)
    d = torch.nn.functional.normalize(
        torch.stack([slant, torch.zeros_like(slant), -torch.ones_like(slant)], dim=-1), dim=-1
    )
    o = torch.tensor([0.0, 0.0, 1.0]).expand_as(d).contiguous()
    green = trace(World(bottom, surfaces=(water,)), o, d, torch.full((4001,), 1e-5)).rgb[:, 1]
    edge = slant[(green[1:] - green[:-1]).abs().argmax()]
    apparent = 0.1 / float(edge) - 1.0
    assert abs(apparent / (depth / 1.333) - 1) < 0.01


def test_refracted_rays_use_the_minimum_pruning_threshold(monkeypatch):
    """Refracted rays start with short steps of small optical depth; camera rays do not."""
    thresholds, march = [], AnalyticField.march

    def recorded(self, *rays, stop=1e-3, pruning_threshold=None):
        thresholds.append(pruning_threshold)
        return march(self, *rays, stop=stop, pruning_threshold=pruning_threshold)

    monkeypatch.setattr(AnalyticField, "march", recorded)
    linear(World(street()))
    assert set(thresholds) == {None}
    linear(World(street(), surfaces=(flooded(),)))
    assert set(thresholds) == {None, MIN_TAU}


def test_coverage_of_each_pixel_increases_with_the_level():
    before = torch.zeros(CAMERA.width * CAMERA.height)
    for level in (0.05, 0.2, 0.35, 0.6):
        coverage = linear(World(street(), surfaces=(flooded(level),))).layers["mask_water"]
        assert (coverage >= before - 1e-4).all()
        assert coverage.mean() > before.mean()
        before = coverage


def test_the_water_depth_layer_is_level_minus_ground():
    level = 0.3
    seen = linear(World(street(), surfaces=(flooded(level),)))
    dry = linear(World(street()))
    wet = (seen.layers["mask_water"] > 0.999) & torch.isfinite(dry.depth)
    from climatenerf.render.volume import camera_rays

    o, d = camera_rays(CAMERA, pose_along((0.0, 1.0, -0.2)))
    bottom = o[:, 2] + dry.depth * d[:, 2]
    assert (seen.layers["water_depth"][wet] - (level - bottom[wet])).abs().max() < 0.01
    assert (seen.layers["water_depth"][seen.layers["mask_water"] < 1e-4] == 0).all()


def test_the_waterline_is_antialiased_and_follows_the_ground():
    level = 0.3
    seen = linear(World(street(), surfaces=(flooded(level),)))
    dry = linear(World(street()))
    from climatenerf.render.volume import camera_rays

    o, d = camera_rays(CAMERA, pose_along((0.0, 1.0, -0.2)))
    ground = o[:, 2] + dry.depth * d[:, 2]
    solid = torch.isfinite(dry.depth)
    assert (seen.layers["mask_water"][solid & (ground < level - 0.1)] > 0.95).all()
    assert (seen.layers["mask_water"][solid & (ground > level + 0.1)] < 0.05).all()
    assert ((seen.layers["mask_water"] > 0.05) & (seen.layers["mask_water"] < 0.95)).any()


def test_a_camera_under_water_has_snells_window_and_total_reflection():
    field = street()
    water = flooded(1.5, wind_speed=0.0, attenuation=(0.0,) * 3)
    o = torch.tensor([[0.0, -3.0, 1.0], [0.0, -3.0, 1.0]])
    d = torch.nn.functional.normalize(torch.tensor([[0.0, 0.0, 1.0], [0.0, -1.0, 0.3]]), dim=-1)
    seen = trace(World(field, surfaces=(water,)), o, d, torch.full((2,), 1e-3))
    zenith = field.sky(torch.tensor([[0.0, 0.0, 1.0]]))[0]
    assert torch.allclose(seen.rgb[0], zenith * (1 - 0.0204), atol=0.03)
    assert torch.isfinite(seen.rgb).all()
    # Total reflection: the second ray ends on the bottom, which is darker than the sky.
    assert seen.rgb[1, 2] < 0.6


# --- composition ------------------------------------------------------------------------------


def snowed(depth, field=None):
    return bake_snow(
        field or street(), Snow(depth=depth), np.array([[0.0, -3.0, 1.6]]), np.full(3, 0.6)
    )


def test_smog_of_zero_extinction_is_bit_identical():
    clean, layers = frame(World(street()))
    same, same_layers = frame(World(street(), media=(medium(Smog(sigma=0.0), 0.0),)))
    assert np.array_equal(clean, same)
    for key in layers:
        assert np.array_equal(layers[key], same_layers[key])


@pytest.mark.slow
@pytest.mark.parametrize("what", ["smog", "flood", "snow"])
def test_vanishing_weather_changes_no_pixel_by_more_than_one_level(what):
    flat = AnalyticField(
        [HalfSpace(colour=(0.3, 0.3, 0.3), checker=0.5), Box((1, 2, 0), (2, 3, 1))], box=WIDE
    )
    small = dataclasses.replace(flat, box=((-30, -30, -5), (30, 30, 10)))
    if what == "smog":
        world = World(small, media=(medium(Smog(visibility=1e6), 0.0),))
    elif what == "flood":
        world = World(small, surfaces=(flooded(-0.01),))
    else:
        world = World(small, matters=(snowed(1e-4, small),))
    clean, layers = frame(World(small))
    other, _ = frame(world)
    # The sky is excluded: infinite smog hides it at any visibility, and the ground ends at 30 m.
    solid = np.isfinite(layers["depth"])
    difference = np.abs(clean.astype(int) - other.astype(int)).max(-1)
    assert difference[solid].max() <= 1


def test_all_weathers_compose():
    level = 0.3
    snow = snowed(0.15)
    air = medium(Smog(visibility=60.0), 0.0)
    world = World(street(), None, (air,), (snow.above(level),), (flooded(level),))
    seen = linear(world)
    assert seen.layers["mask_water"].max() > 0.99 and seen.layers["mask_snow"].max() > 0.99
    assert (seen.layers["snow_thickness"][seen.layers["mask_water"] > 0.99] == 0).all()
    snowy = (seen.layers["mask_snow"] > 0.9) & (seen.layers["snow_thickness"] > 0)
    assert 0.05 < seen.layers["snow_thickness"][snowy].mean() < 0.25
    assert torch.isfinite(seen.rgb).all()
    # Snow is reflected in the water, since reflected rays are traced with all weathers.
    without = linear(dataclasses.replace(world, matters=()))
    wet = seen.layers["mask_water"] > 0.999
    assert (seen.rgb[wet] - without.rgb[wet]).abs().max() > 0.02


@pytest.mark.parametrize("tilt", [0.0, 5.0, 20.0])
def test_snow_on_planes_has_the_requested_thickness(tilt):
    """Layers have the vertical thickness and coverage of snow on planes."""
    angle = math.radians(tilt)
    plane = HalfSpace((0.0, -math.sin(angle), math.cos(angle)), 0.0, (0.3,) * 3)
    field = AnalyticField([plane], box=((-8.0, -8.0, -4.0), (8.0, 8.0, 4.0)))
    snow = bake_snow(field, Snow(depth=0.15), np.array([[0.0, 0.0, 1.6]]), np.full(3, 0.6))
    generator = torch.Generator().manual_seed(0)
    foot = torch.rand(400, 3, generator=generator) * 2 - 1
    foot[:, 2] = foot[:, 1] * math.tan(angle)
    o = torch.tensor([0.0, -1.5, 2.5]).expand(400, 3).contiguous()
    d = torch.nn.functional.normalize(foot - o, dim=-1)
    seen = trace(World(field, matters=(snow,)), o, d, torch.full((400,), 2e-3))
    assert seen.layers["mask_snow"].min() > 0.99
    assert (seen.layers["snow_thickness"] - 0.15).abs().max() < 0.15 * 0.1
    # The depth layer is the distance to the snow, not to the ground.
    height = (o + seen.depth[:, None] * d)[:, 2] - (o + seen.depth[:, None] * d)[:, 1] * math.tan(
        angle
    )
    assert (height - 0.15).abs().max() < 0.15 * 0.15


@pytest.mark.slow
def test_snow_is_not_marched_behind_opaque_surfaces(monkeypatch):
    """Fewer samples give the same picture up to rounding, with all snow in front of a wall."""
    world = World(street(), matters=(snowed(0.2),))
    few = linear(world)
    limits = []
    march = type(world.matters[0]).march

    def everywhere(self, rays_o, rays_d, t_min, t_max):
        """Snow in front of what is opaque, and in steps of its own behind it."""
        limits.append(t_max)
        front = march(self, rays_o, rays_d, t_min, t_max)
        behind = march(self, rays_o, rays_d, t_max, torch.full_like(t_max, torch.inf))
        order, offsets = compositing.merge_order(front.t, front.offsets, behind.t, behind.offsets)
        names = ("t", "dt", "sigma")
        both = [torch.cat([getattr(front, k), getattr(behind, k)])[order] for k in names]
        return Samples(offsets, *both)

    monkeypatch.setattr(type(world.matters[0]), "march", everywhere)
    every = linear(world)
    assert 0.1 < torch.isfinite(torch.cat(limits)).float().mean() < 0.9
    for name in ("rgb", "mask_snow", "snow_thickness"):
        assert (values(few, name) - values(every, name)).abs().max() < 2e-3, name
    assert few.layers["mask_snow"].max() > 0.99


def test_no_snow_lies_under_a_roof():
    roof = Box((-2.0, -2.0, 2.2), (2.0, 2.0, 2.3))
    field = AnalyticField([HalfSpace(), roof], box=((-8.0, -8.0, -1.0), (8.0, 8.0, 4.0)))
    snow = bake_snow(field, Snow(depth=0.15), np.array([[0.0, 0.0, 1.6]]), np.full(3, 0.6))
    o = torch.tensor([[0.0, -4.0, 1.5]]).expand(300, 3).contiguous()
    generator = torch.Generator().manual_seed(1)
    foot = torch.cat([torch.rand(300, 2, generator=generator) * 3 - 1.5, torch.zeros(300, 1)], -1)
    d = torch.nn.functional.normalize(foot - o, dim=-1)
    world = World(field, matters=(snow,))
    under = trace(world, o, d, torch.full((300,), 2e-3))
    assert under.layers["mask_snow"].max() < 0.01 and under.layers["snow_thickness"].max() == 0
    down = torch.tensor([[0.0, 0.0, -1.0]]).expand(300, 3).contiguous()
    above = trace(world, foot + torch.tensor([0.0, 0.0, 3.5]), down, torch.full((300,), 2e-3))
    assert above.layers["mask_snow"].min() > 0.99, "snow lies on the roof"


def test_radiance_of_muddy_water_is_proportional_to_irradiance():
    """Radiance of deep mud at the nadir is its colour times the irradiance over pi."""
    black = AnalyticField([HalfSpace(offset=-5.0, colour=(0.0,) * 3)], zenith=(0.0,) * 3,
                          horizon=(0.0,) * 3, box=WIDE)  # fmt: skip
    flood = Flood(level=0.0, wind_speed=0.0, clarity=0.05)
    o, d = torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[0.0, 0.0, -1.0]])
    radiance = []
    for light in (0.5, 1.0):
        waves = at_time(make_waves(flood, 0), 0.0)
        water = Water(flood, 0.0, waves, torch.full((3,), math.pi * light))
        radiance.append(trace(World(black, surfaces=(water,)), o, d, torch.full((1,), 1e-3)).rgb[0])
    albedo = ((torch.tensor([0.488, 0.406, 0.32]) + 0.055) / 1.055) ** 2.4
    assert torch.allclose(radiance[0] * 2, radiance[1], rtol=1e-4)
    assert torch.allclose(radiance[1], albedo * (1 - 0.0204), rtol=0.01)


@pytest.mark.parametrize("albedo", [0.1, 0.3, 0.6])
def test_the_bed_does_not_jump_when_the_eye_goes_under(albedo):
    """1 cm above and below the surface, net of what it mirrors."""
    bed = AnalyticField(
        [HalfSpace(offset=-0.8, colour=(albedo,) * 3)],
        zenith=(1.0,) * 3, horizon=(1.0,) * 3, box=WIDE,
    )  # fmt: skip
    flood = Flood(level=0.0, wind_speed=0.0, attenuation=(0.4,) * 3, colour=(0.0,) * 3)
    water = Water(flood, 0.0, at_time(make_waves(flood, 0), 0.0), torch.full((3,), math.pi))
    world = World(bed, surfaces=(water,))
    down, angle = torch.tensor([[0.0, 0.0, -1.0]]), torch.full((1,), 1e-3)
    over, under = (
        trace(world, torch.tensor([[0.0, 0.0, z]]), down, angle).rgb for z in (0.01, -0.01)
    )
    mirrored = 0.0204
    net = (over - mirrored) / (1 - mirrored)
    assert net[0, 0].item() == pytest.approx(under[0, 0].item(), rel=0.02)


def test_white_furnace_from_under_water():
    """White ground and sky, clear water: white in all directions, also under total reflection."""
    white = AnalyticField(
        [HalfSpace(colour=(1.0,) * 3)], zenith=(1.0,) * 3, horizon=(1.0,) * 3, box=WIDE
    )
    flood = Flood(level=2.0, attenuation=(0.0,) * 3, colour=(0.0,) * 3, wind_speed=4.0)
    water = Water(flood, 2.0, at_time(make_waves(flood, 0), 0.3), torch.full((3,), math.pi))
    elevation = torch.deg2rad(torch.linspace(5, 90, 400))
    d = torch.stack([torch.zeros(400), elevation.cos(), elevation.sin()], dim=-1)
    o = torch.tensor([0.0, 0.0, 1.0]).expand(400, 3).contiguous()
    for angle in (2e-3, 0.5):  # waves resolved, and filtered
        seen = trace(World(white, surfaces=(water,)), o, d, torch.full((400,), angle))
        assert (seen.rgb - 1).abs().max() < 1e-3


@pytest.mark.slow
@pytest.mark.all_cores
def test_renders_of_a_hash_field_do_not_depend_on_threads_or_chunks(monkeypatch):
    """A hash field with snow and water uses Numba kernels, unlike the analytic field."""

    from climatenerf.field import compositing as module

    field = random_field(full=True)
    field.occupancy.occupied[..., field.occupancy.side // 2 :] = 0  # air above the middle
    with torch.no_grad():
        field.geometry_net[-1].add_(5.0)
    cameras = (field.centre + torch.tensor([0.0, 0.0, 1.5]))[None].numpy().astype(np.float64)
    air, ground = medium(Smog(visibility=60.0), 0.0), float(field.centre[2])
    snow = bake_snow(field, Snow(depth=0.1), cameras, np.full(3, 0.6))
    snowy = World(field, None, (air,), (snow,))
    wet = World(field, None, (air,), (), (flooded(ground + 0.3),))
    o = (field.centre + torch.tensor([0.0, -1.0, 1.5])).expand(600, 3).contiguous()
    d = directions(600)
    d[:, 2] = -d[:, 2].abs()
    angle = torch.full((600,), 1 / 60)
    whole = trace(snowy, o, d, angle), trace(wet, o, d, angle)
    monkeypatch.setattr(module, "RAYS_AT_ONCE", 77)
    with threads(1):
        parts = trace(snowy, o, d, angle), trace(wet, o, d, angle)
    assert (whole[0].layers["mask_snow"] > 0.5).sum() > 50
    assert (whole[1].layers["mask_water"] > 0.5).sum() > 50
    for one, other in zip(whole, parts, strict=True):
        for name in ("rgb", *one.layers):
            assert (values(one, name) - values(other, name)).abs().max() < 1e-4, name


@pytest.mark.all_cores
def test_renders_of_an_analytic_field_do_not_depend_on_threads_or_chunks(monkeypatch):
    from climatenerf.field import compositing as module

    world = World(street(), None, (medium(Smog(visibility=60.0), 0.0),), (), (flooded(0.3),))
    whole = linear(world).rgb
    monkeypatch.setattr(module, "RAYS_AT_ONCE", 777)
    with threads(1):
        parts = linear(world).rgb
    assert (whole - parts).abs().max() < 1e-5


def test_extreme_parameters_stay_finite():
    for flood in (
        Flood(level=0.3, wind_speed=20.0, fetch=1e4),
        Flood(level=0.3, clarity=50.0),
        Flood(level=1.6),  # camera at the surface
        Flood(level=2.5, clarity=0.01),
    ):
        assert flood.level is not None
        water = Water(flood, flood.level, at_time(make_waves(flood, 0), 3.0), torch.full((3,), 1.0))
        for media in ((), (medium(Smog(visibility=5.0, height_falloff=2.0), 0.0),)):
            seen = linear(World(street(), media=media, surfaces=(water,)))
            for name in ("rgb", "water_depth", "mask_water", "transmittance", "normal"):
                assert torch.isfinite(values(seen, name)).all(), (flood, name)
            assert not torch.isnan(seen.depth).any()
            assert (seen.rgb >= 0).all()


class EmptyMatter:
    """Matter without samples."""

    mask, thickness_layer = "mask_nothing", "nothing_thickness"

    def march(self, rays_o, rays_d, t_min, t_max):
        none = torch.zeros(0)
        return Samples(torch.zeros(len(t_min) + 1, dtype=torch.long), none, none, none)

    def colour(self, x):
        return torch.zeros_like(x)

    def thickness(self, x):
        return torch.zeros(len(x))

    def normal(self, x):
        return torch.zeros_like(x)


@pytest.mark.parametrize("water", [None, flooded(wind_speed=4.0)])
def test_the_fast_path_without_weather_equals_the_general_path(monkeypatch, water):
    """Also for reflected rays and cameras under water; any matter disables the fast path."""
    field = random_field()
    with torch.no_grad():
        field.geometry_net[-1] += 2.0
    if water is not None:
        water = dataclasses.replace(water, level=float(field.centre[2]))
    original, calls = trace_module.trace_field, []
    monkeypatch.setattr(
        trace_module,
        "trace_field",
        lambda *given, **named: calls.append(given[1]) or original(*given, **named),
    )
    d = directions(300)
    o = (field.centre + torch.tensor([0.0, 0.0, 1.5])).repeat(300, 1)
    o[:40, 2] -= 3.0  # below the water
    angle = torch.full((300,), 0.01)
    surfaces = () if water is None else (water,)
    fast = trace(World(field, surfaces=surfaces), o, d, angle)
    if water is None:
        assert sum(map(len, calls)) == 300
    else:
        rise = (d[40:, 2] >= 0).sum()
        assert len(calls[0]) == rise and sum(map(len, calls)) > rise + 100, "and reflected rays"
    calls.clear()
    general = trace(World(field, matters=(EmptyMatter(),), surfaces=surfaces), o, d, angle)
    assert not calls
    assert torch.isfinite(general.depth).float().mean() > 0.1
    for name in ("rgb", "depth", "normal", "transmittance", *fast.layers):
        ours, theirs = values(fast, name), values(general, name)
        assert torch.allclose(ours, theirs, atol=1e-5, rtol=1e-4), name
