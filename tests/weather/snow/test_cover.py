"""Where snow stays: crowns, lumps and gaps of a fitted field, what slides."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from support.holed_ground import LabelledField

from climatenerf.core.classes import BUILDING, ROAD, SOLID_OF, TERRAIN, VEGETATION, VEHICLE
from climatenerf.field.analytic import Box, HalfSpace
from climatenerf.field.capabilities import CLASSES, DENSITY, OBSERVED
from climatenerf.render.completed_ground import CompletedField
from climatenerf.render.integrator import trace
from climatenerf.scene.terrain import Terrain
from climatenerf.weather.snow.cover import (
    CROWN_HOLDS,
    bridged,
    cushions,
    eaves,
    ground_share,
    held_by_crowns,
    mean_within,
    slope_share,
)
from climatenerf.weather.snow.deposition import among_leaves, surfaces_and_leaves
from climatenerf.weather.snow.lattice import SnowGrid
from climatenerf.weather.snow.layer import bake_snow
from climatenerf.weather.snow.parameters import Snow
from climatenerf.weather.world import World

H = 0.05


def test_shares_of_the_standard_and_of_the_paper():
    degrees = np.array([0.0, 30.0, 45.0, 60.0, 80.0])
    cosine = np.cos(np.radians(degrees))
    assert slope_share(cosine, Snow()) == pytest.approx([1, 1, 0.5, 0, 0], abs=1e-6)
    paper = slope_share(cosine, Snow(slope=math.radians(45)))
    assert paper[2] == pytest.approx(0.5)
    assert np.all(np.diff(paper) < 0)
    assert slope_share(np.array([1.0 + 1e-7]), Snow()) == pytest.approx([1])
    for degrees, sharpness in ((0.0, 50.0), (20.0, 50.0), (37.0, 1.0), (90.0, 1000.0)):
        snow = Snow(slope=math.radians(degrees), slope_sharpness=sharpness)
        shares = slope_share(np.array([1.0, 0.9, 0.0]), snow)
        assert shares[0] == pytest.approx(1), "level ground keeps all"
        assert np.all(np.diff(shares) <= 0) and shares.min() >= 0


def test_banks_keep_what_roofs_shed():
    cosine = np.cos(np.radians([30.0, 50.0, 62.5, 75.0, 90.0]))
    assert ground_share(cosine, Snow()) == pytest.approx([1, 1, 0.5, 0, 0], abs=1e-6)
    paper = Snow(slope=math.radians(37))
    assert np.array_equal(ground_share(cosine, paper), slope_share(cosine, paper))
    normal = (math.sin(math.radians(42)), 0.0, math.cos(math.radians(42)))
    shares = []
    for kind in (TERRAIN, BUILDING):
        field = LabelledField([HalfSpace(normal, 0.3)], classes=[kind], box=BOX)
        baked = bake_snow(field, Snow(depth=0.1), np.zeros((1, 3)), np.ones(3), grid=GRID)
        assert baked is not None
        catch, position = columns(baked, 0)
        middle = (np.abs(position[..., :2]) < 0.8).all(-1) & (catch.weight > 0)
        shares.append(np.median(catch.of_fall[middle]))
    assert shares == pytest.approx([1.0, 0.6], abs=0.03)


def test_rims_of_thin_snow_are_as_white_as_the_rest():
    """The layer ends on a dark table in a slope of some centimetres, which shows no dark line."""
    top = Box((-0.8, 0.9, 0.0), (0.8, 2.1, 1.0), (0.02, 0.02, 0.02))
    field = LabelledField([HalfSpace(), top], classes=[ROAD, BUILDING], box=BOX)
    baked = bake_snow(field, Snow(depth=0.02), np.array([[0.0, 0.0, 1.6]]), np.ones(3), grid=GRID)
    # Without the table before it: leaves and tiles of a fitted field are drawn back as well.
    bare = LabelledField([HalfSpace()], classes=[ROAD], box=BOX)
    world = World(bare, matters=(dataclasses.replace(baked, ground=field),))
    eye = torch.tensor([0.0, -1.0, 1.6])
    y, z = torch.linspace(0.8, 1.4, 200), torch.full((200,), 1.0)
    d = torch.nn.functional.normalize(torch.stack([0 * y + 0.13, y, z], -1) - eye, dim=-1)
    seen = trace(world, eye.expand(200, 3).contiguous(), d, torch.full((200,), 1e-3))
    snowy = seen.layers["mask_snow"] > 0.99
    white = float(seen.rgb[-40:, 0].mean())
    assert snowy.sum() > 100 and white > 0.6
    assert float(seen.rgb[snowy, 0].min()) > 0.55 * white


def test_crowns_hold_little_of_deep_snow():
    depths = np.array([0.0, 1e-3, 0.03, 0.15, 2.0])
    held = np.array([held_by_crowns(depth) for depth in depths])
    assert held[0] == 0
    assert held[1] == pytest.approx(0.678e-3, rel=0.01), "the first snow mostly stays"
    assert np.all(np.diff(held) > 0)
    assert held[-1] == pytest.approx(0.678 * CROWN_HOLDS, rel=0.01)
    assert np.all(held <= depths)


def test_cushions_bridge_leaves_and_end_at_the_rim():
    rng = np.random.default_rng(0)
    crown = np.full((60, 60), np.nan)
    inside = np.hypot(*(np.mgrid[:60, :60] - 30)) < 18
    crown[inside] = 3.0 + 0.05 * rng.normal(size=inside.sum())
    crown[inside & (rng.random(crown.shape) < 0.2)] = np.nan
    found = cushions(crown, H)
    middle = np.hypot(*(np.mgrid[:60, :60] - 30)) < 12
    assert np.all(found.keeps[middle] > 0.9)
    assert found.height[middle] == pytest.approx(3.0, abs=0.08)
    assert np.all(found.keeps[np.hypot(*(np.mgrid[:60, :60] - 30)) > 22] == 0)
    assert np.all(np.isfinite(found.keeps))
    nothing = cushions(np.full((20, 20), np.nan), H)
    assert not nothing.keeps.any()


def test_the_steep_side_of_a_hedge_carries_no_cushion():
    x = np.arange(60) * H
    steep = np.broadcast_to(np.clip(3.0 * (2.0 - x), 0.5, 2.0), (60, 60))
    found = cushions(steep, H)
    face = (steep > 0.8) & (steep < 1.7)
    assert found.keeps[10:50][face[10:50]].max() < 0.1
    assert found.keeps[30, 10] == 1


@pytest.mark.parametrize(("share", "keeps"), [(0.95, 1.0), (0.7, 0.5), (0.4, 0.0)])
def test_leaves_far_below_the_highest_lie_at_a_face(share, keeps):
    """Rays that graze a blurred face end on all heights of it, and the mean of these is level."""
    random = np.random.default_rng(4)
    crown = 2.0 + 0.02 * random.normal(size=(200, 200))
    crown[random.random(crown.shape) > share] -= 1.0
    found = cushions(crown, H).keeps[20:-20, 20:-20]
    assert found.mean() == pytest.approx(keeps, abs=0.06)
    assert cushions(crown, H).height[100, 100] == pytest.approx(2.0, abs=0.05)


def test_gaps_in_the_ground_are_bridged_up_to_some_metres():
    surface = np.zeros((200, 200))
    surface[50:70, 50:70] = np.nan
    surface[:, 100:] = np.nan
    everywhere = np.ones(surface.shape, bool)
    found = bridged(surface, everywhere, everywhere, 0.1)
    assert found[50:70, 50:70] == pytest.approx(0.0, abs=1e-6)
    assert np.isfinite(found[100, 140]) and np.isnan(found[100, 160])
    unknown = bridged(np.full((5, 5), np.nan), np.zeros((5, 5), bool), np.ones((5, 5), bool), 0.1)
    assert np.isnan(unknown).all()


def roof_raster(degrees):
    """Heights of a roof that falls along the columns, 3 m wide, over ground at 0, and its end."""
    slope = math.tan(math.radians(degrees))
    height = np.zeros((60, 80))
    height[:, :60] = 5.0 - slope * H * np.arange(60)
    return height, slope


@pytest.mark.parametrize("degrees", [30.0, 45.0])
def test_eaves_continue_the_slope_of_a_roof(degrees):
    height, slope = roof_raster(degrees)
    height[:, 58:60] -= np.array([0.05, 0.2])  # a rounded edge
    found, inside, rim, roof = eaves(height, height > 1.0, H)
    known = np.isfinite(found)
    assert rim[30].nonzero()[0].tolist() == [54, 55, 56, 57, 58, 59]
    over = known[30].nonzero()[0]
    assert over.min() == 60, "the roof itself is no overhang"
    assert len(over) == 2, "a decimetre"
    assert found[30, over] == pytest.approx(5.0 - slope * H * over, abs=1e-9)
    assert np.all(height[roof][known | rim] > 1.0)
    assert not known[:, :60].any(), "none before the eaves"


def test_flat_roofs_walls_and_small_slopes_have_no_eaves():
    for degrees in (5.0, 75.0):
        height, _ = roof_raster(degrees)
        assert not np.isfinite(eaves(height, height > 1.0, H).overhang).any()
    height, _ = roof_raster(40.0)
    assert not np.isfinite(eaves(height, np.zeros(height.shape, bool), H).overhang).any(), "a bank"
    onto = np.where(height > 0, height, height[:, 59:60] - 0.3)  # a step lower than eaves are high
    assert not np.isfinite(eaves(onto, height > 1.0, H).overhang).any()
    narrow = np.where(np.abs(np.arange(60) - 30)[:, None] < 8, height, 0.0)  # 75 cm wide
    assert not np.isfinite(eaves(narrow, narrow > 1.0, H).overhang).any()


def test_means_within_a_mask_leave_out_what_is_outside():
    mask = np.zeros((40, 40), bool)
    mask[10:30, 5:20] = True
    found = mean_within(np.where(mask, 0.7, np.nan), mask, 3.0)
    assert found[mask] == pytest.approx(0.7)
    assert np.all(np.isfinite(found))
    assert found[39, 39] == 0


def test_lumps_of_the_ground_are_ignored_and_holes_filled():
    nan = np.nan
    road, leaf, wall = (int(SOLID_OF[kind]) for kind in (TERRAIN, VEGETATION, BUILDING))
    #            ground, veil, hole, pit,  crown, grass, wall, roof labelled as ground
    height = np.array([[0.02, 0.6, nan, -1.0, 3.0, 0.2, 2.0, 5.0]])
    kind = np.array([[road, road, -1, road, leaf, leaf, wall, road]])
    ground = np.zeros(height.shape)
    surface, leaves = surfaces_and_leaves(height, kind, ground)
    assert surface[0] == pytest.approx([0.02, 0, 0, 0, 0, 0.2, 2.0, 5.0])
    assert np.isfinite(leaves[0]).tolist() == [False] * 4 + [True] + [False] * 3
    surface, leaves = surfaces_and_leaves(height, kind, np.full(height.shape, nan))
    assert surface[0] == pytest.approx([0.02, 0.6, nan, -1, nan, nan, 2, 5], nan_ok=True)


def test_solid_nodes_among_leaves_count_as_leaves():
    road, leaf, wall = (int(SOLID_OF[kind]) for kind in (ROAD, VEGETATION, BUILDING))
    random = np.random.default_rng(3)
    level, inside = np.full((80, 80), 2.0), np.zeros((80, 80), bool)
    inside[8:-8, 8:-8] = True
    for solid, most, some in ((wall, 0.5, 0.9), (road, 0.35, 0.7), (-1, 0.5, 0.9)):
        noise = random.uniform(size=inside.shape)
        for share, wrong in ((most, 1.0), (some, 0.0)):
            kind = np.where(noise < share, solid, leaf)
            found = among_leaves(level, kind, H)[inside & (kind == solid)].mean()
            assert found == pytest.approx(wrong, abs=0.02), (solid, share)
    # Near half a metre of leaves the edge of a roof is lost, and no more of it.
    kind = np.full((80, 80), wall)
    kind[:, 40:50], kind[10, 10] = leaf, leaf
    lost = among_leaves(level, kind, H)
    assert not lost[:, :37].any() and lost[5:-5, 39].all() and not lost[kind == leaf].any()
    post = np.full((80, 80), road)
    post[40, 40] = wall
    assert not among_leaves(level, post, H).any()
    thin = np.full((80, 80), -1)  # a bush that stops few rays
    thin[::5, ::5], thin[40, 40] = leaf, wall
    found = among_leaves(np.where(thin >= 0, level, np.nan), thin, H)
    assert found[40, 40] and found.sum() == 1
    speck = np.full((40, 40), leaf)  # of a coarse raster
    speck[20, 20] = wall
    assert among_leaves(level[:40, :40], speck, 0.96)[20, 20]


def test_what_lies_far_below_leaves_is_none_of_them():
    """A car, and ground, that are seen through a crown keep their class."""
    road, leaf, car = (int(SOLID_OF[kind]) for kind in (ROAD, VEGETATION, VEHICLE))
    crown = np.random.default_rng(1).uniform(size=(80, 80)) < 0.7
    for kind, height in ((car, 1.5), (road, 0.0)):
        below = among_leaves(np.where(crown, 4.0, height), np.where(crown, leaf, kind), H)
        assert not below.any()


def test_a_solid_speck_on_a_hedge_builds_no_tower():
    hedge, speck = (
        Box((-1.0, -0.5, 0.0), (1.0, 0.5, 1.5)),
        Box((-0.05, -0.05, 1.4), (0.05, 0.05, 1.55)),
    )
    baked = snow_on([HalfSpace(), hedge, speck], [ROAD, VEGETATION, BUILDING], depth=0.3)
    z = torch.linspace(1.5, 2.0, 101)
    x = torch.stack([0 * z, 0 * z, z], -1)
    highest = z[baked.density(x) > 1.0].max()
    assert highest < 1.5 + held_by_crowns(0.3) + 0.06
    post = snow_on([HalfSpace(), speck], [ROAD, BUILDING], depth=0.3)
    assert z[post.density(x) > 1.0].max() > 1.62, "what stands alone carries a cap"


BOX = ((-4.0, -4.0, -1.0), (4.0, 4.0, 3.0))
GRID = SnowGrid((0.013, 0.027), (-1.0, 2.8), 0.05, 32)


def flat_terrain() -> Terrain:
    n = 41
    zero = np.zeros((n, n), np.float32)
    label = np.full((n, n), ROAD, np.uint8)
    yes = np.ones((n, n), bool)
    return Terrain((-4.0, -4.0), 0.2, zero, zero + 0.02, label, yes, ~yes)


def snow_on(solids, classes, depth=0.15, **snow):
    field = CompletedField(LabelledField(solids, classes=classes, box=BOX), flat_terrain())
    baked = bake_snow(
        field, Snow(depth=depth, **snow), np.array([[0.0, 0.0, 1.6]]), np.ones(3), grid=GRID
    )
    assert baked is not None
    return baked


def columns(baked, which, attribute="position"):
    catch = baked.deposits.cascades[0][which]
    return catch, np.asarray(getattr(catch, attribute))


def test_a_crown_carries_a_cap_and_lets_the_rest_through():
    crown = Box((-0.5, -0.5, 1.5), (0.5, 0.5, 2.5))
    baked = snow_on([HalfSpace(), crown], [ROAD, VEGETATION])
    catch, position = columns(baked, 0)
    below = (np.abs(position[..., :2]) < 0.3).all(-1) & (catch.weight > 0)
    assert below.any()
    assert position[below][:, 2] == pytest.approx(0.0, abs=0.02), "on the terrain"
    assert catch.of_held[below] == pytest.approx(-1, abs=0.05)
    cap, position = columns(baked, 1)
    top = (np.abs(position[..., :2]) < 0.3).all(-1) & (cap.weight > 0)
    assert position[top][:, 2] == pytest.approx(2.5, abs=0.02)
    assert cap.of_fall[top].max() == 0 and cap.of_held[top] == pytest.approx(1, abs=0.05)
    assert cap.hidden[top] == pytest.approx(0, abs=1e-3)
    rim = (cap.weight > 0) & (cap.of_held < 0.9)
    assert rim.any()
    assert cap.hidden[rim].min() > 1e-3, "between leaves"
    open_ground = (np.abs(position[..., :2]) > 1.0).any(-1) & (catch.weight > 0)
    assert catch.of_held[open_ground] == pytest.approx(0, abs=1e-3)


def test_thin_snow_is_thinner_below_a_crown_and_whitens_it_without_steps():
    grey = (0.12, 0.12, 0.12)
    solids = [HalfSpace(colour=grey), Box((-0.5, -0.5, 1.5), (0.5, 0.5, 2.5), grey)]
    baked = snow_on(solids, [ROAD, VEGETATION])
    field = LabelledField(solids, classes=[ROAD, VEGETATION], box=BOX)
    below, apart = [], []
    for depth in np.arange(1, 40) * 1e-3:
        snow = dataclasses.replace(baked.with_depth(depth), ground=field)
        left = depth - held_by_crowns(depth)
        feet = torch.tensor([[0.0, 0.0, left], [1.2, 1.2, depth]], dtype=torch.float32)
        colour = snow.colour(feet)[:, 0]
        below.append(float(colour[0]))
        apart.append(float(colour[1]))
    assert below[2] < 0.8 * apart[2], "a third of 3 mm lies there"
    for seen in (below, apart):
        assert np.diff(seen).min() > -2e-3
        assert np.diff(seen)[2:].max() < 0.1


def test_a_house_shelters_the_ground_and_carries_all():
    house = Box((-0.5, -0.5, 0.0), (0.5, 0.5, 2.5))
    baked = snow_on([HalfSpace(), house], [ROAD, BUILDING])
    catch, position = columns(baked, 0)
    roof = (np.abs(position[..., :2]) < 0.3).all(-1) & (catch.weight > 0)
    assert position[roof][:, 2] == pytest.approx(2.5, abs=0.02)
    assert catch.of_fall[roof] == pytest.approx(1, abs=0.01)
    assert len(baked.deposits.cascades[0]) == baked.deposits.passes[0], "no crowns"


def test_snow_covers_roughness_that_faces_up_and_not_what_stands_in_it():
    baked = snow_on([HalfSpace()], [ROAD], depth=0.03)
    near = torch.tensor([[0.1, 0.1, 0.045], [0.2, 0.0, 0.02], [0.0, 0.3, 0.3]])
    assert baked.covers(near).tolist() == [True, True, False]
    wet = baked.above(0.1)
    assert not wet.covers(near).any()


def snow_seen(solids, classes, eye, towards, **terrain):
    """The snow's mask and thickness (m) along one ray."""
    ground = dataclasses.replace(flat_terrain(), **terrain)
    field = CompletedField(LabelledField(solids, classes=classes, box=BOX), ground)
    baked = bake_snow(field, Snow(depth=0.15), np.array([eye]), np.ones(3), grid=GRID)
    assert baked is not None
    world = World(field, matters=(dataclasses.replace(baked, ground=field),))
    d = torch.nn.functional.normalize(torch.tensor([towards]), dim=-1)
    seen = trace(world, torch.tensor([eye]), d, torch.full((1,), 1e-3))
    return float(seen.layers["mask_snow"][0]), float(seen.layers["snow_thickness"][0])


def test_veils_of_ground_classes_over_snowy_ground_are_white():
    """The terrain carries the snow; a ray that meets a veil above it sees snow as well."""
    veil = Box((-0.6, -0.6, 0.7), (0.6, 0.6, 0.8))
    from_above = [0.0, -2.0, 1.6], [0.0, 2.0, -0.8]
    mask, thickness = snow_seen([HalfSpace(), veil], [ROAD, ROAD], *from_above)
    assert mask == pytest.approx(1, abs=0.02)
    assert thickness == pytest.approx(0.15, abs=0.01)
    side = [0.0, -2.0, 0.75], [0.0, 1.0, 0.0]
    assert snow_seen([HalfSpace(), veil], [ROAD, ROAD], *side)[0] < 0.02, "it does not face up"
    # Under a roof lies no snow, hence none on veils there.
    roof = Box((-1.5, -1.5, 2.4), (1.5, 1.5, 2.5))
    scene = [HalfSpace(), veil, roof], [ROAD, ROAD, BUILDING]
    assert snow_seen(*scene, [0.0, -1.2, 1.4], [0.0, 1.2, -0.6])[0] < 0.02


def test_veils_over_flooded_ground_are_bare():
    ground = dataclasses.replace(flat_terrain())
    field = CompletedField(LabelledField([HalfSpace()], classes=[ROAD], box=BOX), ground)
    snow = dataclasses.replace(snow_on([HalfSpace()], [ROAD]), ground=field)
    veils = torch.tensor([[0.1, 0.1, height] for height in (0.3, 0.8, 1.8)])
    assert snow.veiled(veils).all()
    assert not snow.above(0.5).veiled(veils).any()
    assert snow.above(-0.5).veiled(veils).all()


def test_ground_beyond_the_known_terrain_is_white():
    # Wide, so that no open ground is near that would be continued below it.
    crowns = Box((-4.0, -4.0, 1.4), (4.0, 4.0, 2.0))
    scene = [HalfSpace(), crowns], [ROAD, VEGETATION]
    below = [0.0, -1.4, 0.8], [0.0, 1.4, -0.8]
    lost = {"height": np.full((41, 41), np.nan, np.float32), "open": np.zeros((41, 41), bool)}
    assert snow_seen(*scene, *below, **lost)[0] == pytest.approx(1, abs=0.02)


def test_deposits_know_how_much_of_a_scene_carries_snow():
    level = snow_on([HalfSpace()], [ROAD]).deposits
    beyond = 1 + 3 / GRID.half_cells  # with what balls at the rim need
    assert level.coverage() == pytest.approx(beyond**2, rel=0.02)
    slope = HalfSpace((math.sin(math.radians(75)), 0.0, math.cos(math.radians(75))), 0.0)
    steep = LabelledField([slope], classes=[BUILDING], box=BOX)
    baked = bake_snow(steep, Snow(depth=0.1), np.array([[0.0, 0.0, 1.6]]), np.ones(3), grid=GRID)
    assert baked is not None and baked.deposits.coverage() < 0.01


@pytest.mark.parametrize("tilt", [0.0, 45.0])
def test_a_wall_gets_no_heap_of_what_it_stops(tilt):
    wall = Box((1.0, -4.0, 0.0), (1.2, 4.0, 2.8))
    baked = snow_on([HalfSpace(), wall], [ROAD, BUILDING], 0.1, fall_tilt=math.radians(tilt),
                    wind_direction=math.radians(270))  # fmt: skip
    for catch in baked.deposits.cascades[0]:
        near = (np.abs(catch.position[..., 1]) < 1) & (np.abs(catch.position[..., 0]) < 0.95)
        near &= (catch.position[..., 2] < 0.1) & (catch.weight > 0)
        assert near.any()
        assert catch.of_fall[near].max() < 1.2


def test_slanted_snow_falls_through_a_crown_to_the_ground_of_its_own_place():
    crown = Box((-0.5, -0.5, 1.5), (0.5, 0.5, 2.5))
    rise = 0.1
    normal = np.array([-rise, 0.0, 1.0]) / math.hypot(rise, 1.0)
    field = LabelledField([HalfSpace(tuple(normal)), crown], classes=[ROAD, VEGETATION], box=BOX)
    x = np.linspace(-4, 4, 41, dtype=np.float32)
    sloped = dataclasses.replace(flat_terrain(), height=np.tile(rise * x, (41, 1)))
    snow = Snow(depth=0.1, fall_tilt=math.radians(45), wind_direction=math.radians(90))
    baked = bake_snow(
        CompletedField(field, sloped), snow, np.array([[0.0, 0.0, 1.6]]), np.ones(3), grid=GRID
    )
    assert baked is not None
    catch = baked.deposits.cascades[0][0]
    below = (catch.weight > 0) & (catch.of_held < -0.5) & (np.abs(catch.position[..., 0]) < 3.5)
    assert below.any()
    error = catch.position[below][:, 2] - rise * catch.position[below][:, 0]
    assert np.abs(error).max() < 0.05


def test_classes_count_without_learned_normals():
    crown = Box((-0.5, -0.5, 1.5), (0.5, 0.5, 2.5))
    plain = LabelledField(
        [HalfSpace(), crown],
        classes=[ROAD, VEGETATION],
        box=BOX,
        capabilities=frozenset({DENSITY, CLASSES, OBSERVED}),
    )
    baked = bake_snow(
        CompletedField(plain, flat_terrain()),
        Snow(depth=0.1),
        np.array([[0.0, 0.0, 1.6]]),
        np.ones(3),
        grid=GRID,
    )
    assert baked is not None
    assert len(baked.deposits.cascades[0]) == 2 * baked.deposits.passes[0], "with crowns"


def test_bumps_of_the_ground_are_white_under_thin_snow_and_a_wall_is_not():
    bump = Box((-0.3, 0.9, -0.5), (0.3, 1.4, 0.05), (0.8, 0.1, 0.1))
    wall = Box((-1.5, 2.0, -0.5), (1.5, 2.3, 1.5), (0.8, 0.1, 0.1))
    field = LabelledField([HalfSpace(), bump, wall], classes=[ROAD, ROAD, BUILDING], box=BOX)
    flat = LabelledField([HalfSpace(), wall], classes=[ROAD, BUILDING], box=BOX)
    snow = bake_snow(flat, Snow(depth=0.03), np.array([[0.0, 0.0, 1.6]]), np.ones(3), grid=GRID)
    assert snow is not None
    eye = torch.tensor([0.0, -1.0, 1.6])
    aims = torch.tensor([[0.0, 1.1, 0.05], [0.1, 1.2, 0.05], [0.0, 2.0, 0.6], [0.4, 2.0, 1.0]])
    d = torch.nn.functional.normalize(aims - eye, dim=-1)
    o = eye.expand(4, 3).contiguous()
    seen = trace(World(field, matters=(snow,)), o, d, torch.full((4,), 1e-3))
    assert (seen.layers["mask_snow"][:2] > 0.99).all()
    assert (seen.layers["mask_snow"][2:] < 0.01).all()
    assert seen.rgb[:2].min() > 0.5 and seen.rgb[2:, 1].max() < 0.3
    assert (seen.layers["seen"] == 1).all()
    # A field without normals keeps its bump.
    bare = dataclasses.replace(field, capabilities=frozenset())
    blind = trace(World(bare, matters=(snow,)), o, d, torch.full((4,), 1e-3))
    assert (blind.layers["mask_snow"][:2] < 0.01).all()


@dataclasses.dataclass(frozen=True)
class Grass(LabelledField):
    """A field whose learned normals are those of clumps, tilted by 35 degrees to and fro."""

    def surface_heads(self, rays_o, rays_d, samples, selected):
        normal, logits = super().surface_heads(rays_o, rays_d, samples, selected)
        ray = samples.ray_index()[selected]
        x = rays_o[ray] + samples.t[selected, None] * rays_d[ray]
        turn = math.radians(35) * torch.sin(x[:, 0] * 12).sign()
        across, up = normal[:, 1], normal[:, 2]
        tilted = [normal[:, 0], across * turn.cos() - up * turn.sin(),
                  across * turn.sin() + up * turn.cos()]  # fmt: skip
        return torch.stack(tilted, -1), logits


@pytest.mark.parametrize("kind", [TERRAIN, VEGETATION])
def test_clumps_of_grass_on_a_bank_keep_what_the_bank_keeps(kind):
    slope = math.radians(55)
    bank = HalfSpace((0.0, -math.sin(slope), math.cos(slope)))
    y = np.linspace(-4, 4, 41, dtype=np.float32)
    terrain = dataclasses.replace(
        flat_terrain(), height=np.tile(math.tan(slope) * y[:, None], (1, 41))
    )
    box = ((-4.0, -4.0, -4.0), (4.0, 4.0, 4.0))
    grid = SnowGrid((0.013, 0.027), (-3.0, 3.0), 0.05, 32)
    field = CompletedField(Grass([bank], classes=[kind], box=box), terrain)
    baked = bake_snow(field, Snow(depth=0.1), np.array([[0.0, 0.0, 1.6]]), np.ones(3), grid=grid)
    assert baked is not None
    for catch in baked.deposits.cascades[0]:
        inside = (np.abs(catch.position[..., :2]) < 1).all(-1) & (catch.weight > 0)
        assert catch.of_fall[inside] == pytest.approx(0.8, abs=0.05)


def test_snow_on_a_steep_slope_hides_it_without_gaps():
    """Where the slope is nearly too steep, the snow is thin, and still closed."""
    slope = math.radians(54)
    bank = HalfSpace((0.0, -math.sin(slope), math.cos(slope)))
    box = ((-4.0, -4.0, -4.0), (4.0, 4.0, 4.0))
    grid = SnowGrid((0.013, 0.027), (-3.0, 3.0), 0.05, 32)
    field = LabelledField([bank], classes=[TERRAIN], box=box)
    baked = bake_snow(field, Snow(depth=0.1), np.array([[0.0, 0.0, 1.6]]), np.ones(3), grid=grid)
    assert baked is not None
    x = 1.6 * torch.rand(500, 2, generator=torch.Generator().manual_seed(0)) - 0.8
    feet = torch.cat([x, (x[:, 1] * math.tan(slope))[:, None]], -1)
    d = -torch.tensor([0.0, -math.sin(slope), math.cos(slope)]).expand(500, 3).contiguous()
    samples = baked.march(feet - 0.5 * d, d, torch.zeros(500), torch.full((500,), 0.5))
    depth = torch.zeros(500).index_add_(0, samples.ray_index(), samples.sigma * samples.dt)
    assert (torch.exp(-depth) < 0.5).float().mean() > 0.99
