"""Seasons: recolouring of radiance, the palettes of files, and fields in other colours."""

import math
import tomllib
from dataclasses import replace
from importlib import resources

import numpy as np
import pytest
import torch
from support.holed_ground import LabelledField
from support.sunlit_yard import sunlit_yard, yard_scene

from climatenerf.core.classes import BUILDING, TERRAIN, VEGETATION
from climatenerf.core.colour import luma
from climatenerf.core.errors import UserError
from climatenerf.field.analytic import Box, HalfSpace
from climatenerf.ops import recolouring as r
from climatenerf.render.integrator import trace
from climatenerf.render.session import RenderSession
from climatenerf.verification.closed_forms import fresnel
from climatenerf.weather.description import weather_from_table
from climatenerf.weather.flood.parameters import Flood
from climatenerf.weather.flood.surface import Water
from climatenerf.weather.flood.waves import at_time, make_waves
from climatenerf.weather.season.entity import SeasonEntity, class_colours
from climatenerf.weather.season.palettes import SEASONS, palettes_of, read_palettes, seasonal_style
from climatenerf.weather.season.parameters import Season
from climatenerf.weather.season.styled_field import StyledField
from climatenerf.weather.weather import Weather
from climatenerf.weather.world import World


def session(field, **table):
    return RenderSession(field, yard_scene(), weather_from_table(table))


LEAF = (0.10, 0.16, 0.03)
PLANTS = (VEGETATION, TERRAIN)


def colours(n=500, seed=0):
    return torch.rand(n, 3, generator=torch.Generator().manual_seed(seed)) ** 2


def style(kind="autumn"):
    return seasonal_style(kind, palettes_of(kind), dict.fromkeys(PLANTS, np.array(LEAF)), 4.0, 0)


def autumn(c, share=0.85):
    part = style().classes[0]
    palette = torch.tensor(part.palette[:1]).float().expand(len(c), 1, 3)
    gate = (share * r.green(c))[:, None]
    return r.recoloured(c, gate, palette, torch.tensor(part.matrix[None]).float())


# --- recolouring ----------------------------------------------------------------------------------


@pytest.mark.parametrize("exposure", [0.1, 0.5, 4.0])
def test_recolouring_follows_the_exposure_and_keeps_black(exposure):
    c = colours()
    torch.testing.assert_close(autumn(exposure * c), exposure * autumn(c), rtol=1e-4, atol=1e-6)
    assert (autumn(torch.zeros(1, 3)) == 0).all()


def test_green_is_told_by_hue_and_saturation():
    named = torch.tensor([LEAF, (0.05, 0.2, 0.05), (0.3, 0.3, 0.3), (0.4, 0.1, 0.05),
                          (0.1, 0.2, 0.5), (0.5, 0.25, 0.1)])  # fmt: skip
    found = r.green(named).tolist()
    assert min(found[:2]) > 0.9, "leaves, grass"
    assert max(found[2:]) < 0.05, "grey, brick, sky, rust"


def test_strength_nought_changes_nothing_and_one_takes_the_palette():
    c = torch.tensor([LEAF])
    assert torch.equal(autumn(c, 0.0), c)
    new = autumn(c, 1.0)
    assert float(luma(new)) == pytest.approx(1.1 * float(luma(c)), rel=0.02)
    assert new[0, 0] > 1.5 * new[0, 1] > 3 * new[0, 2], "orange"


def test_differences_between_leaves_stay():
    c = torch.tensor([LEAF]) * torch.tensor([[1.0, 1.0, 1.0], [1.3, 1.0, 0.8]])
    new = autumn(c, 1.0)
    assert float((new[1] / luma(new[1:]) - new[0] / luma(new[:1])).abs().max()) > 0.02


def test_the_mottle_is_even_periodic_smooth_and_seeded():
    table = r.mottle(3)
    assert torch.equal(table, r.mottle(3)) and not torch.equal(table, r.mottle(4))
    inner = table[:-1, :-1, :-1]
    histogram = torch.histc(inner, 10, 0, 1) / inner.numel()
    assert (histogram - 0.1).abs().max() < 0.01
    assert torch.equal(table[0], table[-1]) and torch.equal(table[:, :, 0], table[:, :, -1])
    x = torch.rand(400, 3, generator=torch.Generator().manual_seed(0)) * 300 - 150
    at = r.mottled(table, x, 4.0)
    period = 4.0 * r.PATCHES
    torch.testing.assert_close(r.mottled(table, x + period, 4.0), at, atol=2e-3, rtol=0)
    assert (r.mottled(table, x + 0.01, 4.0) - at).abs().max() < 0.05
    far = r.mottled(table, x + torch.tensor([6.0, 0.0, 0.0]), 4.0)
    assert abs(np.corrcoef(at, far)[0, 1]) < 0.3


def test_palettes_blend_between_their_colours():
    palette = torch.tensor([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]])
    found = r.palette_at(torch.tensor([0.0, 0.25, 0.5, 1.0]), palette)
    expected = [[1.0, 0, 0], [0.5, 0.5, 0], [0, 1.0, 0], [0, 0, 1.0]]
    torch.testing.assert_close(found, torch.tensor(expected))
    one = r.palette_at(torch.tensor([0.0, 1.0]), palette[:1])
    assert torch.equal(one, palette[:1].expand(2, 3))


# --- season files ---------------------------------------------------------------------------------


@pytest.mark.parametrize("season", SEASONS)
def test_each_season_has_a_small_file_of_colours_of_luminance_one(season):
    file = resources.files("climatenerf") / "assets" / "seasons" / f"{season}.toml"
    assert len(file.read_text("utf-8")) < 2000
    palettes = palettes_of(season)
    assert palettes.vegetation is not None and palettes.terrain is not None and palettes.note
    every = [*palettes.vegetation.palette, *palettes.terrain.palette]
    every += [palettes.sky.colour] if palettes.sky else []
    assert luma(torch.tensor(every)).tolist() == pytest.approx([1.0] * len(every))


GOOD = """
[sky]
colour = [1.0, 1.0, 1.0]
gradient = 0.0
share = 0.5
"""


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("[leaves]\npalette = []", "'leaves'"),
        (GOOD.replace("share = 0.5", ""), "share is missing"),
        (GOOD.replace("share = 0.5", "share = 0.5\nfoo = 1"), "'foo' is unknown"),
        ("", "changes nothing"),
        ('note = "bare"', "changes nothing"),
        (GOOD.replace("0.5", "1.5"), "share .* from 0 to 1"),
        (GOOD.replace("[1.0, 1.0, 1.0]", "[1.0, 1.0]"), "three numbers"),
        (GOOD.replace("[1.0, 1.0, 1.0]", "[0, 0, 0]"), "not be black"),
        (GOOD.replace("[1.0, 1.0, 1.0]", "[nan, 1.0, 1.0]"), "three numbers"),
        ("note = 3", "text"),
    ],
)
def test_wrong_season_files_are_one_sentence(text, named):
    assert read_palettes(tomllib.loads(GOOD), "a.toml").sky is not None
    with pytest.raises(UserError, match=named) as error:
        read_palettes(tomllib.loads(text), "a.toml")
    assert "a.toml" in str(error.value) and "\n" not in str(error.value)


# --- a field in other colours ---------------------------------------------------------------------


def garden():
    """A lawn, a hedge and a green wall: the wall is no plant."""
    hedge = Box((-3.0, 1.0, 0.0), (0.0, 2.0, 2.0), LEAF)
    wall = Box((0.0, 1.0, 0.0), (3.0, 2.0, 2.0), LEAF)
    solids = [HalfSpace(colour=LEAF), hedge, wall]
    return LabelledField(solids, classes=[TERRAIN, VEGETATION, BUILDING])


def styled(inner, kind="autumn", white=(1.0, 1.0, 1.0)):
    classes = class_colours(style(kind), torch.device("cpu"))
    return StyledField(inner, classes, 4.0, r.mottle(0), torch.tensor(white))


def look(field, places):
    """Colours of surfaces at places, by rays along +y that begin a metre before."""
    x = torch.tensor(places)
    d = torch.tensor([[0.0, 1.0, 0.0]]).expand(len(x), 3).contiguous()
    return field.colour(x, d, torch.arange(len(x)))


def test_hedges_turn_and_walls_of_the_same_colour_do_not():
    field = garden()
    places = [(-1.0, 1.0, 1.0), (1.0, 1.0, 1.0)]
    before, after = look(field, places), look(styled(field), places)
    assert (after[0] - before[0]).abs().max() > 0.03
    assert (after[1] - before[1]).abs().max() < 0.5 / 255
    grey = look(styled(field, "winter"), places)[0]
    assert float(grey.max() / grey.min()) < 1.6 < float(before[0].max() / before[0].min())


def test_a_red_maple_keeps_its_colour_in_autumn_and_in_winter_turns_less_than_a_hedge():
    red = (0.2, 0.04, 0.03)
    maple = Box((-3.0, 1.0, 0.0), (0.0, 2.0, 2.0), red)
    inner = LabelledField([HalfSpace(colour=LEAF), maple], classes=[TERRAIN, VEGETATION])
    place = [(-1.0, 1.0, 1.0)]
    torch.testing.assert_close(look(styled(inner), place), torch.tensor([red]), atol=1e-4, rtol=0)
    kept = palettes_of("winter").vegetation
    share = kept.strength * kept.gate
    winter = look(styled(inner, "winter"), place)
    assert float(winter[0, 0] / winter[0, 2]) > 1.5
    assert (winter - torch.tensor([red])).abs().max() > 0.1 * share * max(red)


def test_shapes_normals_and_classes_are_those_of_the_field():
    field = garden()
    other = styled(field)
    o, d = torch.tensor([[-1.0, -2.0, 1.0]]), torch.tensor([[0.0, 1.0, 0.0]])
    a, b = (f.march(o, d, torch.zeros(1), torch.full((1,), 9.0)) for f in (field, other))
    assert torch.equal(a.t, b.t) and torch.equal(a.sigma, b.sigma)
    chosen = torch.arange(len(a.t))
    for one, two in zip(field.surface_heads(o, d, a, chosen), other.surface_heads(o, d, b, chosen),
                        strict=True):  # fmt: skip
        assert torch.equal(one, two)
    x = torch.rand(50, 3) * 2
    assert torch.equal(field.density(x), other.density(x))
    assert torch.equal(field.sky(d), other.sky(d))


def test_a_place_has_one_colour_from_wherever_it_is_seen():
    field = styled(garden())
    x = torch.tensor([[-1.0, 1.0, 1.0]]).expand(2, 3)
    d = torch.nn.functional.normalize(torch.tensor([[0.0, 1.0, 0.0], [0.6, 0.8, -0.3]]), dim=-1)
    a, b = field.colour(x, d, torch.arange(2))
    torch.testing.assert_close(a, b)


def test_hues_are_judged_without_the_light_that_falls_on_them():
    """Leaves under an orange dusk are leaves still."""
    dusk = (1.6, 0.9, 0.5)
    lit = torch.tensor(LEAF) * torch.tensor(dusk)
    hedge = Box((-3.0, 1.0, 0.0), (0.0, 2.0, 2.0), tuple(lit.tolist()))
    inner = LabelledField([HalfSpace(colour=LEAF), hedge], classes=[TERRAIN, VEGETATION])
    place = [(-1.0, 1.0, 1.0)]
    expected = look(styled(garden()), place) * torch.tensor(dusk)
    torch.testing.assert_close(look(styled(inner, white=dusk), place), expected)


# --- a scene --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def yard():
    return sunlit_yard(), yard_scene()


def test_seasons_without_classes_are_refused():
    given = type("Given", (), {"field": replace(garden(), capabilities=frozenset())})()
    entity = SeasonEntity(given)
    entity.check((Weather(),))
    with pytest.raises(UserError, match="plants from walls"):
        entity.check((Weather(season=Season(kind="winter")),))


def test_a_season_of_no_strength_is_the_clean_picture(yard):
    field, scene = yard
    camera, pose = scene.cameras[0].resized(40, 25), scene.c2w_world(scene.views[0])
    clean = session(field).frame(camera, pose)
    for season in ({"kind": "winter", "strength": 0}, {"kind": "captured"}):
        seen = session(field, season=season).frame(camera, pose)
        np.testing.assert_array_equal(seen.linear, clean.linear)


@pytest.mark.slow
def test_a_grey_sky_takes_the_hard_sun_and_keeps_the_light_in_the_open(yard):
    field, _ = yard
    one = session(field, flood={"level": "-9 m"})

    def world(**table):
        one.change(weather_from_table(table))
        return one.world(0.0)

    old = one.world(0.0).light
    winter = world(season={"kind": "winter"})
    new = winter.light
    share = palettes_of("winter").sky.share
    before, after = old.open_irradiance(), new.open_irradiance()
    assert float(luma(after) / luma(before)) == pytest.approx(1, abs=0.02)
    torch.testing.assert_close(new.sun_irradiance, (1 - share) * old.sun_irradiance)
    d = torch.nn.functional.normalize(torch.tensor([[0.3, 0.1, 0.4], [-0.5, 0.3, 0.9]]), dim=-1)
    grey = winter.field.sky(d)
    torch.testing.assert_close(grey, new.radiance(d))
    # The photos' sky has its share still; another kind of sky wins over the season's.
    level = float(luma(before)) / (math.pi * (1 + 0.2 * 2 / 3))
    colour = torch.tensor(palettes_of("winter").sky.colour) * level * (1 + 0.2 * d[:, 2:])
    torch.testing.assert_close(grey, (1 - share) * old.radiance(d) + share * colour)
    overcast = world(season={"kind": "winter"}, sky={"kind": "overcast"})
    plain = world(sky={"kind": "overcast"})
    torch.testing.assert_close(overcast.light.radiance(d), plain.light.radiance(d))


def test_still_water_mirrors_the_styled_hedge():
    """Black muddy water shows what the mirrored camera sees, times Fresnel's reflectance."""
    flood = Flood(level=0.3, wind_speed=0.0, clarity=0.01, colour=(0.0, 0.0, 0.0))
    waves = at_time(make_waves(flood, 0), 0.0)
    water = Water(flood, 0.3, waves, torch.full((3,), math.pi))
    down = torch.nn.functional.normalize(torch.tensor([[0.0, 1.5, -1.0]]), dim=-1)
    foot = torch.tensor([[-1.5, -0.5, 0.3]])  # behind it the hedge's face at z = 1.3
    up = down * torch.tensor([1.0, 1.0, -1.0])
    shown = {}
    for name, field in (("clean", garden()), ("autumn", styled(garden()))):
        seen = trace(World(field, surfaces=(water,)), foot - 2 * down, down, torch.full((1,), 1e-3))
        hedge = trace(World(field), foot, up, torch.full((1,), 1e-3)).rgb
        reflectance = float(fresnel(np.arccos(-float(down[0, 2])), flood.ior))
        torch.testing.assert_close(seen.rgb, reflectance * hedge, atol=1e-5, rtol=0.02)
        shown[name] = seen.rgb[0]
    assert shown["autumn"][0] / shown["autumn"][1] > 1.5 * shown["clean"][0] / shown["clean"][1]


@pytest.mark.slow
def test_water_and_snow_take_the_light_of_the_sky_and_not_of_the_lawn(yard):
    """Deep muddy water and deep snow scale with the irradiance on open ground."""
    field, _ = yard
    one = session(field, flood={"level": "-9 m"})
    before = one.world(0.0).light.open_irradiance()

    def irradiance(**table):
        one.change(weather_from_table({"flood": {"level": "0.2 m"}} | table))
        world = one.world(0.0)
        (water,) = world.surfaces
        place = torch.tensor([[30.0, -30.0, 0.2]])
        return world.light.open_irradiance() / before, water.irradiance_at(world, place)[0]

    _, plain = irradiance()
    for kind in ("autumn", "winter"):
        ratio, lit = irradiance(season={"kind": kind})
        torch.testing.assert_close(lit / plain, ratio, rtol=0.02, atol=0)
        assert bool(((ratio - 1).abs() < 1e-3).all()) == (kind == "autumn")


def test_neighbouring_patches_of_autumn_differ_in_hue_and_views_do_not():
    """Cells of 4 m: hues spread by 8 degrees and more; a place has one colour from everywhere."""
    hedge = Box((-60.0, 1.0, 0.0), (60.0, 2.0, 2.0), LEAF)
    field = styled(LabelledField([HalfSpace(colour=LEAF), hedge], classes=[TERRAIN, VEGETATION]))
    places = [(x + 0.5, 1.0, 1.0) for x in range(-56, 57, 4)]
    hue = hue_of(look(field, places))
    assert float(hue.std()) > 8
    x = torch.tensor(places)
    d = torch.nn.functional.normalize(torch.tensor([[0.6, 1.0, -0.2]]), dim=-1)
    other = field.colour(x, d.expand(len(x), 3).contiguous(), torch.arange(len(x)))
    torch.testing.assert_close(hue_of(other), hue, atol=1.0, rtol=0)


def hue_of(colour):
    """Hue in Oklab, degrees."""
    lab = (colour @ torch.tensor(r.CONES).T) ** (1 / 3) @ torch.tensor(r.OKLAB).T
    return torch.rad2deg(torch.atan2(lab[:, 2], lab[:, 1]))
