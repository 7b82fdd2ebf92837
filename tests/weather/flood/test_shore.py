"""The shore: the terrain decides what is flooded, and a band above the water is wet."""

import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from support.holed_ground import GREY, LabelledField, terrain_of

from climatenerf.core.classes import BUILDING, ROAD, VEGETATION
from climatenerf.core.errors import UserError
from climatenerf.field.analytic import Box, HalfSpace
from climatenerf.field.capabilities import COMPLETES
from climatenerf.render.completed_ground import CompletedField
from climatenerf.render.integrator import trace
from climatenerf.weather.flood.parameters import Flood
from climatenerf.weather.flood.shore import WetField
from climatenerf.weather.flood.surface import FloodEntity, Water
from climatenerf.weather.flood.waves import at_time, make_waves
from climatenerf.weather.weather import Weather
from climatenerf.weather.world import World

LEVEL = 0.25
E = torch.full((3,), math.pi * 0.8)
LUMP, BLOCK = (-2.0, 0.0), (2.0, 0.0)  # x, y of two equal boxes; the first is rough ground


def scenery(top=0.4, kind=BUILDING, height=0.0):
    """Ground at z = 0 with two boxes, of which one has the ground's class; terrain at `height`."""
    solids = [HalfSpace(colour=GREY)]
    for x, y in (LUMP, BLOCK):
        solids.append(Box((x - 0.5, y - 0.5, -0.5), (x + 0.5, y + 0.5, top), (0.7, 0.7, 0.7)))
    field = LabelledField(solids, classes=[ROAD, ROAD, kind], zenith=(0.8,) * 3, horizon=(0.8,) * 3)
    return CompletedField(field, terrain_of(lambda x, y: 0 * x + height, half=0.0))


def seen_at(world, places, slant=0.4):
    """What rays see that would meet z = 0.4 at each place."""
    foot = torch.tensor([[x, y, 0.4] for x, y in places])
    d = torch.nn.functional.normalize(torch.tensor([[0.0, slant, -1.0]]), dim=-1).expand(
        len(foot), 3
    )
    return trace(world, foot - 3 * d, d.contiguous(), torch.full((len(foot),), 1e-3))


def water(**changes):
    flood = replace(Flood(level=LEVEL, wind_speed=0.0), **changes)
    return Water(flood, LEVEL, at_time(make_waves(flood, 0), 0.0), E)


@pytest.mark.parametrize("kind", [BUILDING, VEGETATION])
def test_lumps_of_ground_do_not_stand_out_of_the_water(kind):
    opaque = water(clarity=0.01)
    seen = seen_at(World(scenery(kind=kind), surfaces=(opaque,)), [LUMP, BLOCK, (0.0, 0.0)])
    assert seen.layers["mask_water"].tolist() == pytest.approx([1, 0, 1], abs=1e-3)
    assert seen.layers["water_depth"].tolist() == pytest.approx([LEVEL, 0, LEVEL], abs=5e-3)
    # Its reflected ray begins above the lump, so that it sees the sky as elsewhere.
    torch.testing.assert_close(seen.rgb[0], seen.rgb[2], atol=1e-3, rtol=0)


def test_without_terrain_lumps_are_what_they_look_like():
    bare = scenery().field
    assert COMPLETES not in bare.capabilities
    seen = seen_at(World(bare, surfaces=(water(),)), [LUMP, BLOCK])
    assert (seen.layers["mask_water"] < 1e-3).all()


def test_holes_in_dry_ground_hold_no_water():
    for height, wet in ((0.35, 0.0), (0.1, 1.0)):
        world = World(scenery(height=height), surfaces=(water(),))
        seen = seen_at(world, [(0.0, 0.0)])
        assert float(seen.layers["mask_water"]) == pytest.approx(wet, abs=1e-3), height


@pytest.mark.parametrize("depth", [0.25, 0.03])
def test_the_sides_of_lumps_leave_no_dry_pixels(depth):
    """Their normals are those of rough ground, and say nothing about the waterline."""
    world = World(scenery(height=LEVEL - depth), surfaces=(water(),))
    place = torch.linspace(-0.8, 0.8, 33)
    x, y = (each.ravel() for each in torch.meshgrid(place + LUMP[0], place, indexing="ij"))
    foot = torch.stack([x, y, torch.zeros_like(x)], dim=-1)
    d = torch.nn.functional.normalize(torch.tensor([[0.0, 0.9, -0.4]]), dim=-1).expand(len(x), 3)
    seen = trace(world, foot - 5 * d, d.contiguous(), torch.full((len(x),), 0.01))
    assert float(seen.layers["mask_water"].min()) > 0.99


def test_a_bridge_stays_dry():
    """A road far above the terrain is no lump of it."""
    seen = seen_at(World(scenery(height=-3.0), surfaces=(water(),)), [LUMP])
    assert float(seen.layers["mask_water"]) < 1e-3


def test_the_waterline_of_rough_ground_is_antialiased():
    """A wide pixel over a hole in ground that is flooded by 5 mm is not wet all over."""
    world = World(scenery(height=LEVEL - 0.005), surfaces=(water(),))
    foot, d = torch.tensor([[0.0, 0.0, LEVEL]]), torch.tensor([[0.0, 0.6, -0.8]])
    for angle, low, high in ((1e-3, 0.99, 1.01), (0.05, 0.1, 0.9)):
        seen = trace(world, foot - 3 * d, d, torch.full((1,), angle))
        assert low < float(seen.layers["mask_water"]) < high


def test_lumps_below_the_surface_lie_as_deep_as_the_terrain():
    """Seen through an absorbing water, a shoal of rough ground is no brighter than the ground."""
    flood = {"attenuation": (6.0, 6.0, 6.0), "colour": (0.0, 0.0, 0.0)}
    world = World(scenery(top=0.15), surfaces=(water(**flood),))
    lump, block = seen_at(world, [LUMP, BLOCK], slant=0.0).rgb[:, 1]
    reflected = 0.0204 * 0.8  # R at vertical incidence times the sky
    # The way down and up is 2.2 and 1 times the depth; .25 m instead of .10 m.
    ratio = float((lump - reflected) / (block - reflected))
    assert ratio == pytest.approx(math.exp(-6.0 * 0.15 * (1 + 1 / 0.83)), rel=0.1)


def test_rays_that_do_not_descend_keep_their_samples():
    """Seen from under water or along it, a lump is what it looks like."""
    field = scenery()
    o = torch.tensor([[-2.0, -3.0, 0.3], [-2.0, -3.0, 0.1]])
    d = torch.tensor([[0.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
    dry, wet = (trace(World(field, surfaces=s), o, d, torch.full((2,), 1e-3))
                for s in ((), (water(),)))  # fmt: skip
    torch.testing.assert_close(dry.depth, wet.depth)


# --- the wet band -------------------------------------------------------------------------------


def test_a_film_darkens_what_lies_low_over_the_water():
    """Lekner and Dorf's film: .61 of an albedo of .3, and all of white."""
    wall = LabelledField(
        [Box((-1.0, 0.0, -1.0), (1.0, 1.0, 3.0), (0.24, 0.24, 0.8))], classes=[BUILDING]
    )
    field = WetField(wall, LEVEL, 0.1, 0.06, 1.333, lambda x: E.expand(len(x), 3))
    x = torch.tensor(
        [[0.0, 0.0, LEVEL + h] for h in (-0.05, 0.01, 0.05, 0.075, 0.099, 0.11, -0.07)]
    )
    d = torch.tensor([[0.0, 1.0, 0.0]]).expand(len(x), 3)
    dry, wet = wall.colour(x, d), field.colour(x, d)
    ratio = (wet / dry)[:, 0].tolist()
    assert ratio[-2:] == [1, 1], "what lies deeper is left to the water's own optics"
    assert ratio[:3] == pytest.approx([0.61] * 3, abs=0.01), "wet in a trough, too"
    assert ratio[2] < ratio[3] < ratio[4] < 1, "it dries upwards"
    torch.testing.assert_close(wet[:, 2], dry[:, 2], atol=2e-3, rtol=0)


def test_the_band_reaches_over_the_crests_and_can_be_left_out():
    field, light = scenery(), E
    for wind, band in ((0.0, 0.03), (8.0, 0.03), (8.0, 0.0)):
        flood = Flood(level=LEVEL, wind_speed=wind, wet_band=band)
        waves = make_waves(flood, 0)
        world = FloodEntity(waves, light, 0.0, 3.0).place(World(field), Weather(flood=flood), 0.0)
        if band == 0:
            assert world.field is field
        else:
            assert isinstance(world.field, WetField)
            assert world.field.band == pytest.approx(band + waves.significant_height / 2)
            assert (wind == 0) == (world.field.band == pytest.approx(0.03))


def test_holes_in_dry_ground_are_wet_as_the_ground_around():
    """The terrain lies in the wet band, the field's ground below the water."""
    flood = Flood(level=LEVEL, wind_speed=0.0)
    entity = FloodEntity(make_waves(flood, 0), E, 0.0, 3.0)
    seen = []
    for height in (LEVEL + 0.01, LEVEL + 0.2):
        field = scenery(height=height)
        world = entity.place(World(field), Weather(flood=flood), 0.0)
        assert float(seen_at(world, [(0.0, 0.0)]).layers["mask_water"]) < 1e-3
        seen.append(
            seen_at(world, [(0.0, 0.0)]).rgb[0] / seen_at(World(field), [(0.0, 0.0)]).rgb[0]
        )
    assert float(seen[0].max()) < 0.75
    torch.testing.assert_close(seen[1], torch.ones(3), atol=5e-3, rtol=0)


def test_rays_under_water_see_the_field_without_the_film():
    """A clear bed is darkened once: by the water's own optics, also where troughs come near it."""
    field = scenery()
    for level, wind in ((LEVEL, 0.0), (4e-3, 2.0)):
        flood = Flood(level=level, wind_speed=wind, attenuation=(0.0, 0.0, 0.0))
        entity = FloodEntity(make_waves(flood, 0), E, 0.0, 3.0)
        with_band = entity.place(World(field), Weather(flood=flood), 0.0)
        without = World(field, surfaces=with_band.surfaces)
        for slant in (0.0, 0.4):
            a, b = (seen_at(world, [(0.0, 0.0)], slant) for world in (with_band, without))
            assert float(a.layers["mask_water"]) > 0.99
            torch.testing.assert_close(a.rgb, b.rgb)


def test_shoals_darken_smoothly_with_their_height():
    flood = {"attenuation": (6.0, 6.0, 6.0), "colour": (0.0, 0.0, 0.0)}
    seen = []
    for top in torch.arange(0.01, 0.12, 0.005).tolist():
        world = World(scenery(top=top), surfaces=(water(**flood),))
        seen.append(float(seen_at(world, [LUMP], slant=0.0).rgb[0, 1]))
    assert max(abs(b - a) for a, b in pairwise(seen)) < 0.002


def test_cameras_under_murky_water_are_refused():
    flood = Flood(level=5.0, clarity=0.3)
    entity = FloodEntity(make_waves(flood, 0), E, 0.0, 9.0, 1.6)
    with pytest.raises(UserError, match="all cameras are under water"):
        entity.check((Weather(flood=flood),))
    thick = Flood(level=5.0, attenuation=(8.0, 8.0, 8.0))
    with pytest.raises(UserError, match=r"deeper than its clarity of 0.24 m"):
        entity.check((Weather(flood=thick),))
    entity.check((Weather(flood=replace(thick, attenuation=(0.3, 0.06, 0.01))),))
    for changed in (replace(flood, clarity=6.0), replace(flood, level=1.0)):
        entity.check((Weather(flood=flood), Weather(flood=changed)))


@pytest.mark.parametrize("wind", [0.0, 2.0])
def test_an_eye_under_water_sees_the_bed_as_without_the_band(wind):
    """The water's optics make the bed wet; a film on top would darken it twice."""
    flood = Flood(level=LEVEL, wind_speed=wind, attenuation=(0.0, 0.0, 0.0))
    entity = FloodEntity(make_waves(flood, 0), E, 0.0, 3.0)
    field = scenery()
    with_band = entity.place(World(field), Weather(flood=flood), 0.0)
    o, d = torch.tensor([[0.0, 0.0, 0.15]]), torch.tensor([[0.0, 0.6, -0.8]])
    a, b = (
        trace(World(each, surfaces=with_band.surfaces), o, d, torch.full((1,), 1e-3)).rgb
        for each in (with_band.field, field)
    )
    torch.testing.assert_close(a, b)
