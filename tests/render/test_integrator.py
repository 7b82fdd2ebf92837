"""Smog, flood and their composition: the checks of the physics, through the renderer."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from support.analytic_fields import AnalyticField, Box, HalfSpace
from support.random_field import directions, random_field

from climatenerf.core.cameras import Camera
from climatenerf.core.samples import MIN_TAU, Samples
from climatenerf.render import integrator as trace_module
from climatenerf.render.frame import render_frame
from climatenerf.render.integrator import trace
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


def looking(direction, eye=(0.0, -3.0, 1.6)):
    """Pose that looks along a direction with a level horizon."""
    forward = np.array(direction, float)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    c2w = np.eye(4)
    c2w[:3, 0], c2w[:3, 1], c2w[:3, 2] = right, np.cross(forward, right), forward
    c2w[:3, 3] = eye
    return c2w


def street():
    """Ground that rises along y, a wall, a box; a sky that brightens upwards."""
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
    """A part of a render's output, or one of its layers."""
    return seen.layers[name] if name in seen.layers else getattr(seen, name)


def frame(world, eye=(0.0, -3.0, 1.6), direction=(0.0, 1.0, -0.2), camera=CAMERA):
    return render_frame(world, camera, looking(direction, eye))


def linear(world, direction=(0.0, 1.0, -0.2), eye=(0.0, -3.0, 1.6)):
    from climatenerf.render.volume import camera_rays

    o, d = camera_rays(CAMERA, looking(direction, eye))
    return trace(world, o, d, torch.full((o.shape[0],), 1 / 60))


# --- smog ---------------------------------------------------------------------------------------


def test_smog_contrast_falls_with_depth_at_the_rate_asked_for():
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


def test_an_endless_smog_swallows_the_sky_and_layers_say_so():
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


def test_a_perfect_mirror_shows_what_a_mirrored_camera_sees():
    """Snowless, waveless, R = 1: the water shows the scene as from under it, cut at the plane."""
    level = 0.3
    still = flooded(level, wind_speed=0.0)
    water = dataclasses.replace(still, mirror_only=True)
    world = World(street(), surfaces=(water,))
    seen = linear(world)
    from climatenerf.render.volume import camera_rays

    o, d = camera_rays(CAMERA, looking((0.0, 1.0, -0.2)))
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


def test_fresnel_governs_how_much_the_sky_shows():
    """Black opaque water under a white sky shows exactly its reflectance."""
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
    """A white bed under depth d, seen from straight above: c = (1-R) L exp(-beta 2.2 d)."""
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
    found = -(values[1] / values[0]).log() / path
    assert torch.allclose(found, torch.tensor(betas), rtol=0.01)


def test_snell_apparent_depth_near_the_nadir():
    """The edge of a block under water appears where a block at d / 1.333 would show it."""
    depth = 0.8
    bed = AnalyticField(
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
    green = trace(World(bed, surfaces=(water,)), o, d, torch.full((4001,), 1e-5)).rgb[:, 1]
    edge = slant[(green[1:] - green[:-1]).abs().argmax()]
    apparent = 0.1 / float(edge) - 1.0
    assert abs(apparent / (depth / 1.333) - 1) < 0.01


def test_a_bed_s_rays_leave_out_next_to_nothing(monkeypatch):
    """They begin at the water, with short steps, of which each is thin; the eye's do not."""
    asked, march = [], AnalyticField.march

    def noting(self, *rays, stop=1e-3, pruning_threshold=None):
        asked.append(pruning_threshold)
        return march(self, *rays, stop=stop, pruning_threshold=pruning_threshold)

    monkeypatch.setattr(AnalyticField, "march", noting)
    linear(World(street()))
    assert set(asked) == {None}
    linear(World(street(), surfaces=(flooded(),)))
    assert set(asked) == {None, MIN_TAU}


def test_flooded_pixels_are_nested_as_the_level_rises():
    before = torch.zeros(CAMERA.width * CAMERA.height)
    for level in (0.05, 0.2, 0.35, 0.6):
        share = linear(World(street(), surfaces=(flooded(level),))).layers["mask_water"]
        assert (share >= before - 1e-4).all()
        assert share.mean() > before.mean()
        before = share


def test_water_depth_layer_against_the_true_ground():
    level = 0.3
    seen = linear(World(street(), surfaces=(flooded(level),)))
    dry = linear(World(street()))
    wet = (seen.layers["mask_water"] > 0.999) & torch.isfinite(dry.depth)
    from climatenerf.render.volume import camera_rays

    o, d = camera_rays(CAMERA, looking((0.0, 1.0, -0.2)))
    bed = o[:, 2] + dry.depth * d[:, 2]
    assert (seen.layers["water_depth"][wet] - (level - bed[wet])).abs().max() < 0.01
    assert (seen.layers["water_depth"][seen.layers["mask_water"] < 1e-4] == 0).all()


def test_the_waterline_is_soft_and_lies_where_water_meets_ground():
    level = 0.3
    seen = linear(World(street(), surfaces=(flooded(level),)))
    dry = linear(World(street()))
    from climatenerf.render.volume import camera_rays

    o, d = camera_rays(CAMERA, looking((0.0, 1.0, -0.2)))
    ground = o[:, 2] + dry.depth * d[:, 2]
    solid = torch.isfinite(dry.depth)
    assert (seen.layers["mask_water"][solid & (ground < level - 0.1)] > 0.95).all()
    assert (seen.layers["mask_water"][solid & (ground > level + 0.1)] < 0.05).all()
    assert ((seen.layers["mask_water"] > 0.05) & (seen.layers["mask_water"] < 0.95)).any()


def test_an_eye_under_water_sees_the_air_in_snells_window_and_mirrors_outside_it():
    field = street()
    water = flooded(1.5, wind_speed=0.0, attenuation=(0.0,) * 3)
    o = torch.tensor([[0.0, -3.0, 1.0], [0.0, -3.0, 1.0]])
    d = torch.nn.functional.normalize(torch.tensor([[0.0, 0.0, 1.0], [0.0, -1.0, 0.3]]), dim=-1)
    seen = trace(World(field, surfaces=(water,)), o, d, torch.full((2,), 1e-3))
    zenith = field.sky(torch.tensor([[0.0, 0.0, 1.0]]))[0]
    assert torch.allclose(seen.rgb[0], zenith * (1 - 0.0204), atol=0.03)
    assert torch.isfinite(seen.rgb).all()
    # Total reflection: the second ray sees the bed, which is darker than the sky at that height.
    assert seen.rgb[1, 2] < 0.6


# --- composition and anything ---


def snowed(depth, field=None):
    return bake_snow(
        field or street(), Snow(depth=depth), np.array([[0.0, -3.0, 1.6]]), np.full(3, 0.6)
    )


def test_weather_that_does_nothing_is_bit_identical():
    clean, layers = frame(World(street()))
    same, same_layers = frame(World(street(), media=(medium(Smog(sigma=0.0), 0.0),)))
    assert np.array_equal(clean, same)
    for key in layers:
        assert np.array_equal(layers[key], same_layers[key])


@pytest.mark.parametrize("what", ["smog", "flood", "snow"])
def test_weather_in_the_limit_changes_no_pixel_by_more_than_one_step(what):
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
    # Not the sky: an endless smog swallows it at any visibility, and the ground here ends at 30 m.
    solid = np.isfinite(layers["depth"])
    difference = np.abs(clean.astype(int) - other.astype(int)).max(-1)
    assert difference[solid].max() <= 1


def test_all_weathers_at_once_compose():
    level = 0.3
    snow = snowed(0.15)
    air = medium(Smog(visibility=60.0), 0.0)
    world = World(street(), None, (air,), (snow.above(level),), (flooded(level),))
    seen = linear(world)
    assert seen.layers["mask_water"].max() > 0.99 and seen.layers["mask_snow"].max() > 0.99
    assert (seen.layers["snow_thickness"][seen.layers["mask_water"] > 0.99] == 0).all()
    shown = (seen.layers["mask_snow"] > 0.9) & (seen.layers["snow_thickness"] > 0)
    assert 0.05 < seen.layers["snow_thickness"][shown].mean() < 0.25
    assert torch.isfinite(seen.rgb).all()
    # The snow of the bank shows in the water: reflections see the other weathers.
    without = linear(dataclasses.replace(world, matters=()))
    wet = seen.layers["mask_water"] > 0.999
    assert (seen.rgb[wet] - without.rgb[wet]).abs().max() > 0.02


@pytest.mark.parametrize("tilt", [0.0, 5.0, 20.0])
def test_snow_shows_its_depth_in_the_picture(tilt):
    """Vertical thickness over planes, and whether it is there at all, by the layers."""
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
    # And the layer's depth is to the snow, not to the ground.
    height = (o + seen.depth[:, None] * d)[:, 2] - (o + seen.depth[:, None] * d)[:, 1] * math.tan(
        angle
    )
    assert (height - 0.15).abs().max() < 0.15 * 0.15


def test_snow_is_not_looked_for_behind_what_is_opaque(monkeypatch):
    """Fewer samples, the same picture but for rounding; and what is before a wall all shows."""
    world = World(street(), matters=(snowed(0.2),))
    few = linear(world)
    wanted = []
    march = type(world.matters[0]).march

    def noted(self, rays_o, rays_d, t_min, t_max):
        wanted.append(t_max)
        return march(self, rays_o, rays_d, t_min, t_max)

    monkeypatch.setattr(type(world.matters[0]), "march", noted)
    linear(world)
    assert 0.1 < torch.isfinite(torch.cat(wanted)).float().mean() < 0.9
    monkeypatch.setattr(trace_module, "HIDDEN", 0.0)
    every = linear(world)
    for name in ("rgb", "mask_snow", "snow_thickness"):
        assert (values(few, name) - values(every, name)).abs().max() < 2e-3, name
    assert few.layers["mask_snow"].max() > 0.99


def test_no_snow_shows_under_a_roof_or_on_a_steep_slope():
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
    assert above.layers["mask_snow"].min() > 0.99, "the roof itself carries it"


def test_muddy_water_is_lit_by_the_scene():
    """Deep mud seen steeply is its colour times the light; twice the light, twice the radiance."""
    black = AnalyticField([HalfSpace(offset=-5.0, colour=(0.0,) * 3)], zenith=(0.0,) * 3,
                          horizon=(0.0,) * 3, box=WIDE)  # fmt: skip
    flood = Flood(level=0.0, wind_speed=0.0, clarity=0.05)
    o, d = torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[0.0, 0.0, -1.0]])
    shown = []
    for light in (0.5, 1.0):
        waves = at_time(make_waves(flood, 0), 0.0)
        water = Water(flood, 0.0, waves, torch.full((3,), math.pi * light))
        shown.append(trace(World(black, surfaces=(water,)), o, d, torch.full((1,), 1e-3)).rgb[0])
    albedo = ((torch.tensor(flood.colour) + 0.055) / 1.055) ** 2.4
    assert torch.allclose(shown[0] * 2, shown[1], rtol=1e-4)
    assert torch.allclose(shown[1], albedo * (1 - 0.0204), rtol=0.01)


def test_white_furnace_from_under_water():
    """White walls and sky, water that takes nothing: white in every direction, also where the
    surface reflects all or nearly all."""
    white = AnalyticField(
        [HalfSpace(colour=(1.0,) * 3)], zenith=(1.0,) * 3, horizon=(1.0,) * 3, box=WIDE
    )
    flood = Flood(level=2.0, attenuation=(0.0,) * 3, colour=(0.0,) * 3, wind_speed=4.0)
    water = Water(flood, 2.0, at_time(make_waves(flood, 0), 0.3), torch.full((3,), math.pi))
    elevation = torch.deg2rad(torch.linspace(5, 90, 400))
    d = torch.stack([torch.zeros(400), elevation.cos(), elevation.sin()], dim=-1)
    o = torch.tensor([0.0, 0.0, 1.0]).expand(400, 3).contiguous()
    for angle in (2e-3, 0.5):  # waves resolved, and averaged over
        seen = trace(World(white, surfaces=(water,)), o, d, torch.full((400,), angle))
        assert (seen.rgb - 1).abs().max() < 1e-3


def test_the_kernels_that_users_run_do_not_depend_on_threads_or_chunks(monkeypatch):
    """A fitted kind of field, snow and water: Numba's kernels, not the closed form's torch."""
    import numba

    from climatenerf.field import compositing as module

    field = random_field(full=True)
    field.occupancy.occupied[..., field.occupancy.side // 2 :] = 0  # air above the middle
    with torch.no_grad():
        field.geometry_net[-1].add_(5.0)
    places = (field.centre + torch.tensor([0.0, 0.0, 1.5]))[None].numpy().astype(np.float64)
    air, ground = medium(Smog(visibility=60.0), 0.0), float(field.centre[2])
    snow = bake_snow(field, Snow(depth=0.1), places, np.full(3, 0.6))
    snowy = World(field, None, (air,), (snow,))
    wet = World(field, None, (air,), (), (flooded(ground + 0.3),))
    o = (field.centre + torch.tensor([0.0, -1.0, 1.5])).expand(600, 3).contiguous()
    d = directions(600)
    d[:, 2] = -d[:, 2].abs()
    angle = torch.full((600,), 1 / 60)
    whole = trace(snowy, o, d, angle), trace(wet, o, d, angle)
    monkeypatch.setattr(module, "RAYS_AT_ONCE", 77)
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        parts = trace(snowy, o, d, angle), trace(wet, o, d, angle)
    finally:
        numba.set_num_threads(threads)
    assert (whole[0].layers["mask_snow"] > 0.5).sum() > 50
    assert (whole[1].layers["mask_water"] > 0.5).sum() > 50
    for one, other in zip(whole, parts, strict=True):
        for name in ("rgb", *one.layers):
            assert (values(one, name) - values(other, name)).abs().max() < 1e-4, name


def test_chunks_and_threads_do_not_change_the_picture(monkeypatch):
    from climatenerf.field import compositing as module

    world = World(street(), None, (medium(Smog(visibility=60.0), 0.0),), (), (flooded(0.3),))
    whole = linear(world).rgb
    monkeypatch.setattr(module, "RAYS_AT_ONCE", 777)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    parts = linear(world).rgb
    torch.set_num_threads(threads)
    assert (whole - parts).abs().max() < 1e-5


def test_no_parameters_give_nan():
    for flood in (
        Flood(level=0.3, wind_speed=20.0, fetch=1e4),
        Flood(level=0.3, clarity=50.0),
        Flood(level=1.6),  # the eye is on the surface
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


class Nothing:
    """Matter that is nowhere."""

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
def test_what_meets_no_weather_takes_a_short_way_to_the_same(monkeypatch, water):
    """Also reflected rays, and eyes under water; where matter could be leads the long way."""
    field = random_field()
    with torch.no_grad():
        field.geometry_net[-1] += 2.0
    if water is not None:
        water = dataclasses.replace(water, level=float(field.centre[2]))
    plain, taken = trace_module._trace_field, []
    monkeypatch.setattr(
        trace_module, "_trace_field", lambda *given: taken.append(given[1]) or plain(*given)
    )
    d = directions(300)
    o = (field.centre + torch.tensor([0.0, 0.0, 1.5])).repeat(300, 1)
    o[:40, 2] -= 3.0  # all of them meet water at once
    angle = torch.full((300,), 0.01)
    surfaces = () if water is None else (water,)
    short = trace(World(field, surfaces=surfaces), o, d, angle)
    if water is None:
        assert sum(map(len, taken)) == 300
    else:
        rise = (d[40:, 2] >= 0).sum()
        assert len(taken[0]) == rise and sum(map(len, taken)) > rise + 100, "and what is mirrored"
    taken.clear()
    long = trace(World(field, matters=(Nothing(),), surfaces=surfaces), o, d, angle)
    assert not taken
    assert torch.isfinite(long.depth).float().mean() > 0.1
    for name in ("rgb", "depth", "normal", "transmittance", *short.layers):
        ours, theirs = values(short, name), values(long, name)
        assert torch.allclose(ours, theirs, atol=1e-5, rtol=1e-4), name
