"""Light in a yard photographed in the sun: found, replaced, and changed by weather."""

import math
import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from support.sunlit_yard import (
    SUN,
    TO_SUN,
    in_sun,
    sunlit_yard,
    without_sun,
    yard_scene,
)

from climatenerf.core.classes import BUILDING, SOLID, SOLID_OF, VEGETATION
from climatenerf.core.colour import luma
from climatenerf.core.errors import UserError
from climatenerf.field.wrapped import WrappedField
from climatenerf.render.photo_rays import trace_photos
from climatenerf.render.session import RenderSession
from climatenerf.weather.description import weather_from_table
from climatenerf.weather.light import entity
from climatenerf.weather.light import find_light as finding
from climatenerf.weather.light import sun_map as sun_maps
from climatenerf.weather.light.captured import UnknownLight, elevation_azimuth
from climatenerf.weather.light.relit_field import (
    BRIGHTEST,
    MAX_ALBEDO,
    MAX_LEAF_ALBEDO,
    RelitField,
    bounded,
)
from climatenerf.weather.light.sun_map import sun_map
from climatenerf.weather.snow.parameters import Snow
from climatenerf.weather.world import Kept

ACROSS = torch.tensor([[x, y, 0.0] for x in np.linspace(-5, 3, 81) for y in (0.0, 0.4)]).float()
DOWN = torch.tensor([[0.0, 0.0, -1.0]])


def session(field, **table):
    return RenderSession(field, yard_scene(), weather_from_table(table))


@pytest.fixture(scope="module", autouse=True)
def small_maps():
    """Coarser maps of the sun: the yard is small, and marched in PyTorch."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sun_maps, "TEXELS", 320)
        yield


@pytest.fixture(scope="module")
def overcast():
    return session(sunlit_yard(), sky={"kind": "overcast"})


@pytest.fixture(scope="module")
def snowy():
    return session(sunlit_yard(), snow={"depth": "10 cm"}).world(0.0)


def ground(field):
    """Luma of open ground along a line that the block's shadow and the block cross."""
    x = ACROSS[(ACROSS[:, 0] < -2.3) | (ACROSS[:, 0] > 0.3)]
    return x, field.colour(x, DOWN.expand_as(x))[:, 0]


@pytest.mark.slow
def test_the_map_of_the_sun_equals_the_shadows_in_closed_form():
    found = sun_map(sunlit_yard(), TO_SUN, np.array([0.0, 0.0, 1.0]))
    rng = np.random.default_rng(0)
    x = torch.tensor(np.c_[rng.uniform(-9, 9, (2000, 2)), np.zeros(2000)]).float()
    up = torch.tensor([0.0, 0.0, 0.15])
    expected = in_sun(x + up)
    wrong = (found.visibility(x + up) - expected).abs()
    assert 0.1 < float(1 - expected.mean()) < 0.6
    assert float((wrong > 0.5).float().mean()) < 0.04, "the edges of the shadows alone"
    far = torch.tensor([[300.0, 0.0, 0.0]])
    assert float(found.visibility(far)) == 1.0


@pytest.mark.slow
def test_the_sun_of_the_yard_is_found(overcast):
    overcast.world(0.0)
    light = overcast._entities["sky"].captured
    assert light.hard
    assert np.degrees(np.arccos(light.sun @ TO_SUN)) < 4.0
    # The yard's shade is as bright beside the block as in the open, so the sun seems weaker.
    np.testing.assert_allclose(light.lobe, SUN, rtol=0.3)


def test_the_shadow_goes_with_the_sun(overcast):
    """In the photos the ground is up to 2.3 times as bright beside the shadow; relit it is even."""
    x, before = ground(sunlit_yard())
    world = overcast.world(0.0)
    assert isinstance(world.field, RelitField)
    after = world.field.colour(x, DOWN.expand_as(x))[:, 0]
    assert float(before.quantile(0.9) / before.quantile(0.1)) > 2.0
    assert float(after.quantile(0.9) / after.quantile(0.1)) < 1.45
    true = ground(without_sun())[1]
    ratio = (after / true).numpy()
    assert np.median(np.abs(ratio / np.median(ratio) - 1)) < 0.1


def test_lit_ground_with_a_wrong_normal_does_not_turn_black(overcast):
    """Its brightness shows that it is lit, so its normal cannot point down."""
    field = overcast.world(0.0).field
    x = torch.tensor([[-6.0, -5.0, 0.0], [-5.0, -4.0, 0.0]])
    radiance, kind = sunlit_yard().colour(x, DOWN.expand_as(x)), torch.full((2,), 3)
    up = torch.tensor([[0.0, 0.0, 1.0]]).expand(2, 3)
    right, wrong = (field.change(radiance, x, normal, kind)[0] for normal in (up, -up))
    torch.testing.assert_close(wrong, right, rtol=0.35, atol=0.0)


class OfOneClass(WrappedField):
    """A field whose matter is all of one class, with level surfaces."""

    kind = VEGETATION

    def surface_heads(self, rays_o, rays_d, samples, selected):
        up = torch.tensor([[0.0, 0.0, 1.0]]).expand(len(selected), 3)
        logits = torch.zeros(len(selected), len(SOLID))
        logits[:, SOLID_OF[self.kind]] = 9.0
        return up, logits


class OfWalls(OfOneClass):
    kind = BUILDING


def test_no_surface_sends_more_than_it_can_reflect_under_a_new_sky(overcast):
    """Far trees in a sun that was not found, or a lamp, do not glow; darker surfaces stay."""
    relit = replace(overcast.world(0.0).field, albedo=None)
    assert relit.white == pytest.approx(float(luma(relit.new.open_irradiance())) / math.pi)
    d = torch.tensor([[1.0, 0.0, -0.5]]) / math.sqrt(1.25)
    x = torch.tensor([[-6.0, -5.0, 2.0]]).expand(5, 3) + 0.01 * torch.arange(5)[:, None]
    up = torch.tensor([[0.0, 0.0, 1.0]]).expand(5, 3)
    white = luma(relit.new.irradiance(x, up)) / math.pi
    assert float(white.min()) > relit.white / 3
    ray = torch.zeros(5, dtype=torch.long)  # the samples share the change of their light
    of_bound = torch.tensor([0.0, 0.8, BRIGHTEST, 1.0, 2.0])
    # 1 + (1/.8 - 1) log(x/.8) / log(6/.8) of .8: what is too bright keeps its texture.
    expected = torch.tensor([0.0, 0.8, 1.0, 0.8221, 0.8910])
    for kind, most in ((OfOneClass, MAX_LEAF_ALBEDO), (OfWalls, MAX_ALBEDO)):
        wanted = of_bound * most * white
        field = replace(relit, field=kind(relit.field))
        photographed = replace(field, new_sky=False)
        plain = luma(photographed.recoloured(torch.ones(5, 3), x, d, ray))
        colour = (wanted / plain)[:, None].expand(5, 3)
        for given in ((colour, x, d, ray), (colour, x, d.expand(5, 3), None)):
            found = luma(field.recoloured(*given))
            torch.testing.assert_close(found, expected * most * white, rtol=0.03, atol=1e-6)
            same = photographed.recoloured(*given)
            assert float(luma(same).max()) == pytest.approx(float(wanted[2]), rel=0.03)
    # Where probes know of no light, a third of that in the open counts.
    night = replace(relit.new, coefficients=0 * relit.new.coefficients, sun=None)
    dark = replace(relit, field=OfWalls(relit.field), new=night, brighter=16.0)
    found = luma(dark.recoloured(torch.full((5, 3), 99.0), x, d, ray))
    assert found.tolist() == pytest.approx(5 * [MAX_ALBEDO * relit.white / 3], rel=1e-3)


def test_no_channel_of_a_saturated_surface_exceeds_the_bound():
    brick = torch.tensor([[2.0, 0.4, 0.1], [0.3, 0.06, 0.015], [0.0, 0.0, 0.0]])
    found = bounded(brick, torch.full((3, 3), 0.5))
    assert float(found[0].max()) == pytest.approx(0.4799, abs=1e-3)
    torch.testing.assert_close(found[0] / found[0, 0], brick[0] / brick[0, 0])
    torch.testing.assert_close(found[1:], brick[1:])
    torch.testing.assert_close(bounded(brick, torch.full((3, 3), math.inf)), brick)
    blue = torch.tensor([[0.75, 1.0, 1.8]])  # light, in which grey surfaces keep their albedo
    torch.testing.assert_close(bounded(0.7 * blue, 0.9 * blue), 0.7 * blue)


def test_a_blue_sky_lights_the_place_less_blue_than_it_is_shown():
    """The sun of the photos, and the sky of a season that has hardly begun, follow."""
    blue = (0.3, 0.5, 0.8)
    field = replace(sunlit_yard(), zenith=blue, horizon=blue)
    light = session(field, snow={"depth": "10 cm"}).world(0.0).light
    open_light = light.open_irradiance()
    assert float(open_light[0] / open_light[2]) > 0.6
    up = torch.tensor([[0.0, 0.0, 1.0]])
    torch.testing.assert_close(light.radiance(up), torch.tensor([blue]), rtol=1e-3, atol=1e-4)
    season = {"kind": "wildfire", "strength": 1e-3}
    begun = session(field, season=season).world(0.0).field
    torch.testing.assert_close(begun.sky(up), field.sky(up), rtol=0.01, atol=1e-3)


def test_clouds_over_snow_send_its_light_back(overcast):
    """The horizon is a third as bright as the zenith over grass, and more than half over snow."""
    d = torch.nn.functional.normalize(torch.tensor([[1.0, 0.0, 0.05], [0.0, 0.0, 1.0]]), dim=-1)
    snowy = session(sunlit_yard(), sky={"kind": "overcast"}, snow={"depth": "10 cm"})
    dry, wet = (
        float(luma(run.world(0.0).light.radiance(d))[0] / luma(run.world(0.0).light.radiance(d))[1])
        for run in (overcast, snowy)
    )
    assert dry == pytest.approx(1.1 / 3, abs=0.01)
    assert 0.5 < wet < 0.65


def test_haze_of_the_old_sky_around_leaves_shows_the_new_sky(overcast):
    """Leaves of their own colour, walls as white as the sky, and what is seen from above stay."""
    relit = overcast.world(0.0).field
    d = torch.nn.functional.normalize(torch.tensor([[1.0, 0.0, 0.3], [1.0, 0.0, -0.5]]), dim=-1)
    sky = relit.old.radiance(d[:1]).clamp(max=1.0)
    green = torch.tensor([[0.04, 0.09, 0.02]])
    x = torch.tensor([[-6.0, -5.0, 2.0]]).expand(3, 3) + torch.arange(3)[:, None]
    colour, ray = torch.cat([sky, green, sky]), torch.tensor([0, 0, 1])

    def shown(kind, new_sky=True):
        field = replace(relit, field=kind(relit.field), new_sky=new_sky)
        return field.recoloured(colour, x, d, ray)

    leaves, same_light = shown(OfOneClass), shown(OfOneClass, new_sky=False)
    torch.testing.assert_close(leaves[0], relit.new.radiance(d[:1])[0], rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(leaves[1], same_light[1], rtol=1e-3, atol=1e-4)
    up = torch.tensor([[0.0, 0.0, 1.0]])
    most = MAX_LEAF_ALBEDO * relit.new.irradiance(x[2:], up) / math.pi
    torch.testing.assert_close(leaves[2:], bounded(same_light[2:], most), rtol=1e-3, atol=1e-4)
    assert bool((leaves[2] <= most[0]).all())
    assert (leaves[0] - same_light[0]).abs().max() > 0.02
    assert torch.equal(shown(OfWalls), shown(OfWalls, new_sky=False))


@pytest.mark.slow
def test_a_new_sun_casts_the_shadow_elsewhere():
    opposite = {"elevation": "45 deg", "azimuth": "315 deg"}
    world = session(sunlit_yard(), sky={"kind": "clear"}, sun=opposite).world(0.0)
    to_sun = np.array([-0.5, 0.5, np.sqrt(0.5)])
    x, _ = ground(sunlit_yard())
    lit = in_sun(x + torch.tensor([0.0, 0.0, 0.1]), to_sun).bool()
    colour = world.field.colour(x, DOWN.expand_as(x))[:, 0]
    assert lit.any() and (~lit).any()
    assert float(colour[lit].median()) > 1.8 * float(colour[~lit].median())


def test_what_photos_show_is_as_bright_under_another_sky():
    """By the log-average of their pixels; a mean would follow a few places in the sun."""
    ends = [(each.x, each.d, each.t) for each in trace_photos(sunlit_yard(), yard_scene())]
    seen = [np.isfinite(t) for _, _, t in ends]
    x, d = (
        torch.tensor(np.concatenate([each[k][i] for each, i in zip(ends, seen, strict=True)]))
        for k in (0, 1)
    )
    low = {"elevation": "12 deg", "azimuth": "315 deg"}
    world = session(sunlit_yard(), sky={"kind": "clear"}, sun=low).world(0.0)
    before, after = (f.colour(x.float(), d.float()) for f in (sunlit_yard(), world.field))
    change = (luma(after).clamp_min(1e-3) / luma(before).clamp_min(1e-3)).log().mean()
    assert float(change) == pytest.approx(0.0, abs=0.05)


@pytest.mark.slow
def test_exposure_is_kept_on_average_and_ev_doubles_it(overcast):
    x = torch.cat([ACROSS, torch.tensor([[x, 5.99, 2.0] for x in np.linspace(-6, 6, 40)]).float()])
    d = torch.where(x[:, 1:2] > 5, torch.tensor([[0.0, 1.0, 0.0]]), DOWN)
    before = sunlit_yard().colour(x, d).mean()
    kept = overcast.world(0.0).field.colour(x, d).mean()
    assert 0.6 < float(kept / before) < 1.4
    twice = session(sunlit_yard(), sky={"kind": "overcast", "ev": 1.0}).world(0.0)
    assert float(twice.field.colour(x, d).mean() / kept) == pytest.approx(2.0, rel=0.01)
    up = torch.tensor([[0.0, 0.0, 1.0]])
    assert float(twice.field.sky(up)[0, 0] / overcast.world(0.0).field.sky(up)[0, 0]) == (
        pytest.approx(2.0, rel=0.01)
    )


@pytest.mark.slow
def test_snow_is_neither_grey_nor_overexposed_under_a_new_sky(overcast, monkeypatch):
    monkeypatch.setattr(entity, "COUNTRY", 0.0)  # no light from clouds over snow: exposure alone
    up = torch.tensor([[0.0, 0.0, 1.0]])

    def exposures(**sky):
        """Of the sky without snow and with it."""
        dry = session(sunlit_yard(), sky={"kind": "overcast", **sky}).world(0.0).light
        snow = {"depth": "10 cm"}
        wet = session(sunlit_yard(), sky={"kind": "overcast", **sky}, snow=snow).world(0.0).light
        return float(wet.radiance(up)[0, 0] / dry.radiance(up)[0, 0])

    light = overcast.world(0.0).light
    open_ground = ACROSS[ACROSS[:, 0] < -3]
    white = float(luma(light.irradiance(open_ground, up.expand_as(open_ground))).median()) / np.pi
    assert white > 0.9
    assert exposures() * white < 0.95
    assert exposures(exposure="fixed") == pytest.approx(1.0, rel=1e-5)
    monkeypatch.setattr(entity, "SUNLIT_RADIANCE", 0.3)
    assert exposures() * white == pytest.approx(0.3, rel=0.15)
    monkeypatch.setattr(entity, "SUNLIT_RADIANCE", 9.0)
    monkeypatch.setattr(entity, "SNOW_RADIANCE", (0.1, 0.4))
    assert exposures() * white == pytest.approx(0.4, rel=0.15)  # this ground is the brightest
    monkeypatch.setattr(entity, "SNOW_RADIANCE", (1.5, 4.0))
    assert exposures() * white == pytest.approx(1.5, rel=0.15)
    monkeypatch.setattr(entity, "SNOW_RADIANCE", (0.1, 4.0))
    assert exposures() == pytest.approx(1.0, rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    "table",
    [
        {"smog": {"visibility": "200 m", "light": "scene"}},
        {"snow": {"depth": "10 cm"}, "season": {"kind": "winter"}},
        {"sky": {"kind": "clear"}, "smog": {"visibility": "200 m", "light": "scene"}},
    ],
)
def test_light_can_be_sent_to_another_process(table):
    here = session(sunlit_yard(), **table)
    there = pickle.loads(pickle.dumps((here.world(0.0).light, here)))
    light, again = here.world(0.0).light, there[1].world(0.0).light
    x, up = ACROSS[:5], torch.tensor([[0.0, 0.0, 1.0]]).expand(5, 3)
    for other in (there[0], again):
        assert torch.equal(other.irradiance(x, up), light.irradiance(x, up))
        assert torch.equal(other.radiance(up), light.radiance(up))


@pytest.mark.slow
def test_light_that_stays_is_bit_identical():
    """Nothing is found or gathered for a clean frame, and the field is the given one."""
    field, scene = sunlit_yard(), yard_scene()
    clean = session(field)
    world = clean.world(0.0)
    assert world.field is field and world.light is None
    assert "_found" not in clean._entities["sky"].__dict__
    flooded = session(field, flood={"level": "0.2 m", "wet-band": "0 m"})
    world = flooded.world(0.0)
    assert world.field is field and world.light is not None
    camera, pose = scene.cameras[0].resized(40, 25), scene.c2w_world(scene.views[0])
    none = session(field, smog={"sigma": "0 1/m"}, snow={"depth": "0 m"}).frame(camera, pose)
    np.testing.assert_array_equal(none.linear, clean.frame(camera, pose).linear)


def test_the_photos_own_sun_keeps_its_shadows_under_snow(snowy):
    """Snow brightens the wall, and the shadow's edge stays where the photo has it."""
    field = sunlit_yard()
    x, before = ground(field)
    after = snowy.field.colour(x, DOWN.expand_as(x))[:, 0]
    ratio = after / before
    assert float(ratio.max() / ratio.min()) < 1.35, "no second edge beside the photo's"
    wall = torch.tensor([[-4.0, 5.99, 1.0]])
    ahead = torch.tensor([[0.0, 1.0, 0.0]])
    brighter = snowy.field.colour(wall, ahead) / field.colour(wall, ahead)
    assert 1.05 < float(brighter[0, 0]) < 2.0


@pytest.mark.slow
def test_half_a_cover_of_snow_lights_a_wall_half_as_much():
    field = sunlit_yard()
    half = session(field, snow={"depth": "5.3 mm"}).world(0.0)
    whole = session(field, snow={"depth": "50 cm"}).world(0.0)
    wall = torch.tensor([[-4.0, 5.99, 1.0]])
    ahead = torch.tensor([[0.0, 1.0, 0.0]])
    dry, some, most = (each.colour(wall, ahead)[0, 0] for each in (field, half.field, whole.field))
    assert 0.4 < float((some - dry) / (most - dry)) < 0.6


@pytest.mark.parametrize(("ground", "at_45"), [(False, 0.4), (True, 0.8)])
def test_snow_covers_surfaces_by_their_slope(ground, at_45):
    """A roof of 45 degrees keeps half of it, and a grassy bank all."""
    cosine = torch.tensor([1.0, math.cos(math.radians(45)), 0.2, -1.0])
    covered = entity.snow_cover(Snow(), 0.8, cosine, torch.full((4,), ground))
    assert covered == pytest.approx([0.8, at_45, 0, 0], abs=1e-6)


@pytest.mark.slow
def test_growing_snow_brightens_a_wall_evenly():
    """From frame to frame of a movie, across the steps in which light is computed."""
    film = session(sunlit_yard(), snow={"depth": {"0 s": "2 cm", "1 s": "4 cm"}})
    wall = torch.tensor([[-4.0, 5.99, 1.0]])
    ahead = torch.tensor([[0.0, 1.0, 0.0]])
    seen = [film.world(t).field.colour(wall, ahead)[0, 0] for t in np.linspace(0, 1, 21)]
    steps = np.diff([float(each) for each in seen])
    assert steps.min() > 0
    assert steps.max() < 2.5 * steps.mean()


@pytest.mark.slow
def test_the_papers_snow_follows_another_sky():
    table = {"snow": {"depth": "10 cm", "light": "paper"}, "sky": {"kind": "overcast"}}
    place = torch.tensor([[-6.0, -5.0, 0.1]])
    dim = session(sunlit_yard(), **table)
    (snow,) = dim.world(0.0).matters
    table["sky"]["ev"] = 1.0
    (bright,) = session(sunlit_yard(), **table).world(0.0).matters
    assert bright.colour(place) == pytest.approx(2 * snow.colour(place).numpy(), rel=1e-3)


@pytest.mark.slow
def test_a_sun_that_comes_back_keeps_its_shadows():
    """Snow, then two other suns without it, then the first again: the photos' shadow stays."""
    field = sunlit_yard()
    changing = session(field, snow={"depth": "10 cm"})
    x, _ = ground(field)
    first = changing.world(0.0).field.colour(x, DOWN.expand_as(x))
    for azimuth in ("20 deg", "60 deg"):
        other = {"snow": {"depth": "0 m"}, "flood": {"level": "0.1 m"}, "sun": {"azimuth": azimuth}}
        changing.change(weather_from_table(other))
        changing.world(0.0)
    changing.change(weather_from_table({"snow": {"depth": "10 cm"}}))
    again = changing.world(0.0).field.colour(x, DOWN.expand_as(x))
    torch.testing.assert_close(again, first)


@pytest.mark.slow
def test_snow_and_mud_receive_the_light_of_their_place(snowy):
    field = sunlit_yard()
    (snow,) = snowy.matters
    assert snow.place_light is snowy.light
    up = torch.tensor([[0.0, 0.0, 1.0]]).expand(2, 3)
    places = torch.tensor([[-6.0, -5.0, 0.1], [5.0, 0.0, 0.1]])  # in the open, below the roof
    light = snowy.light.irradiance(places, up)
    assert float(light[1, 0] / light[0, 0]) < 0.75
    muddy = session(field, flood={"level": "0.1 m", "clarity": "5 cm", "wind-speed": "0 m/s"})
    world = muddy.world(0.0)
    (water,) = world.surfaces
    received = water.irradiance_at(world, places)
    assert float(received[1, 0] / received[0, 0]) < 0.75


@pytest.mark.slow
def test_faint_smog_in_the_sun_changes_nothing():
    field, scene = sunlit_yard(), yard_scene()
    camera, pose = scene.cameras[0].resized(40, 25), scene.c2w_world(scene.views[0])
    clean = session(field).frame(camera, pose)
    hazy = session(field, smog={"visibility": "10000 km"}).frame(camera, pose)
    assert np.abs(hazy.picture.astype(int) - clean.picture.astype(int)).max() <= 1


@pytest.mark.parametrize(
    ("sky", "elevation", "message"),
    [
        ("clear", "-3 deg", "needs the sun above the horizon"),
        ("captured", "-3 deg", "taken by day"),
        ("dusk", "30 deg", "from -12 deg to 0 deg"),
        ("dusk", "-40 deg", "from -12 deg to 0 deg"),
    ],
)
def test_a_sun_that_does_not_belong_to_its_sky_is_refused(sky, elevation, message):
    with pytest.raises(UserError, match=message):
        session(sunlit_yard(), sky={"kind": sky}, sun={"elevation": elevation})


def test_photos_that_show_too_little_are_refused_in_one_sentence():
    from climatenerf.field.analytic import AnalyticField

    plain = AnalyticField(sunlit_yard().solids)
    with pytest.raises(UserError, match="needs the light of the photos"):
        session(plain, sky={"kind": "overcast"}).world(0.0)


@pytest.mark.slow
def test_parameters_move_the_sun_of_the_photos():
    """What they leave out stays as found."""
    table = {"flood": {"level": "0.1 m"}, "sun": {"azimuth": "200 deg"}}
    moved = session(sunlit_yard(), **table)
    direction = moved.world(0.0).light.sun.direction
    elevation, azimuth = np.degrees(elevation_azimuth(direction))
    found = elevation_azimuth(moved._entities["sky"].captured.sun)
    assert azimuth == pytest.approx(200) and elevation == pytest.approx(np.degrees(found[0]))


def test_a_sun_by_the_calendar_needs_shadows_or_strength(monkeypatch):
    """Where shadows tell no direction it is taken if it is strong, and left if it is not."""
    photos = trace_photos(sunlit_yard(), yard_scene())
    none = finding.HardSun(TO_SUN, 9.0, 0.0)
    monkeypatch.setattr(finding, "hard_sun", lambda *given: none)
    light = finding.find_light(sunlit_yard(), photos, TO_SUN)
    np.testing.assert_array_equal(light.sun, TO_SUN)
    assert light.hard and light.almanac_difference == pytest.approx(0.0, abs=1e-6)
    for field in (without_sun(), sunlit_yard(0.15)):
        assert not finding.find_light(field, photos, TO_SUN).hard


def test_photos_without_sky_or_ground_say_so():
    field = sunlit_yard()
    photos = trace_photos(field, yard_scene())
    dark = [replace(photo, transmittance=0 * photo.transmittance) for photo in photos]
    assert finding.find_light(field, dark) == UnknownLight("the photos show too little sky")
    empty = [
        replace(photo, t=photo.t + np.inf, transmittance=0 * photo.transmittance + 1)
        for photo in photos
    ]
    found = finding.find_light(field, empty)
    assert isinstance(found, UnknownLight) and "too little ground" in found.reason


def test_two_suns_are_refused_in_one_sentence(monkeypatch):
    """That they are noticed is tested in test_find_light."""
    east, west = np.array([0.6, 0.0, 0.8]), np.array([-0.6, 0.0, 0.8])
    two = finding.HardSun(east, 0.1, 0.5, (east, west))
    monkeypatch.setattr(finding, "hard_sun", lambda *given: two)
    with pytest.raises(UserError) as refused:
        session(sunlit_yard(), sky={"kind": "overcast"}).world(0.0)
    text = str(refused.value)
    assert "contradict one sun: in the first half of them it stands 53 deg high" in text
    assert "from 5.png on, 53 deg high at azimuth 270 deg; fit photos of one time" in text
    session(sunlit_yard(), flood={"level": "0.1 m"}).world(0.0)


def test_the_light_is_kept_with_the_run(tmp_path):
    table = {"flood": {"level": "0.1 m"}}
    first = RenderSession(
        sunlit_yard(), yard_scene(), weather_from_table(table), kept=Kept(tmp_path, "a")
    )
    first.world(0.0)
    written = (tmp_path / "light.json").read_bytes()
    again = RenderSession(
        sunlit_yard(), yard_scene(), weather_from_table(table), kept=Kept(tmp_path, "a")
    )
    again.world(0.0)
    assert (tmp_path / "light.json").read_bytes() == written
    for old, new in (
        (b'"checkpoint": "a"', b'"checkpoint": "b"'),
        (b'_version": 6', b'_version": 1'),
    ):
        assert old in written
        (tmp_path / "light.json").write_bytes(written.replace(old, new))
        third = RenderSession(
            sunlit_yard(), yard_scene(), weather_from_table(table), kept=Kept(tmp_path, "a")
        )
        third.world(0.0)
        assert (tmp_path / "light.json").read_bytes() == written, "found anew"
    np.testing.assert_allclose(
        again._entities["sky"].captured.sun, first._entities["sky"].captured.sun
    )
