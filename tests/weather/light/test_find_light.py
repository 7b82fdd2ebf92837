"""The light of photos: a sun from its shadows, a sky from its unclipped flank, the file."""

import math

import numpy as np
import pytest
import torch

from climatenerf.core.errors import UserError
from climatenerf.field.analytic import AnalyticField, Box, HalfSpace
from climatenerf.weather.light import find_light as finding
from climatenerf.weather.light import sky_fit
from climatenerf.weather.light.captured import (
    COLUMNS,
    ROWS,
    CapturedLight,
    UnknownLight,
    elevation_azimuth,
)
from climatenerf.weather.light.file import load_light, save_light
from climatenerf.weather.light.find_light import (
    MIN_SUN,
    Pairs,
    gather_light,
    glow_share,
    hard_sun,
    sun_strength,
)
from climatenerf.weather.light.sky_fit import fit_sky
from climatenerf.weather.light.spherical import sphere_directions

BLOCKS = [Box((-1.0, -1.0, 0.0), (1.0, 1.0, 3.0)), Box((4.0, 2.0, 0.0), (6.0, 3.0, 2.0))]
STRENGTH = np.array([4.0, 3.0, 2.0])


def direction(elevation, azimuth):
    h, a = np.radians([elevation, azimuth])
    return np.array([np.cos(h) * np.sin(a), np.cos(h) * np.cos(a), np.sin(h)])


def sunlit_yard(sun, count=1200):
    """Pairs of points on level ground around two blocks, as photos show them in the sun."""
    field = AnalyticField([HalfSpace(), *BLOCKS], box=((-40, -40, -1), (40, 40, 9)))
    rng = np.random.default_rng(0)
    x = np.zeros((count, 2, 3))
    x[:, 0, :2] = rng.uniform(-6, 9, (count, 2))
    x[:, 1, :2] = x[:, 0, :2] + rng.uniform(-1.5, 1.5, (count, 2))
    free = np.ones(count, bool)
    for block in BLOCKS:
        low, high = np.array(block.lower)[:2] - 0.1, np.array(block.upper)[:2] + 0.1
        free &= ~((x[..., :2] > low) & (x[..., :2] < high)).all(-1).any(1)
    x = x[free].reshape(-1, 3)
    normal = np.tile([0.0, 0.0, 1.0], (len(x), 1))
    sky = np.where(finding.gathering_directions()[:, 2:] > 0, 1.0, 0.0).repeat(3, axis=1)
    late = np.arange(len(x)) >= len(x) // 4 * 2
    dark = Pairs(x, normal, np.ones_like(x), late)
    ambient = gather_light(field, dark).ambient(sky)
    o = torch.tensor(x + 0.01 * normal, dtype=torch.float32)
    d = torch.tensor(sun, dtype=torch.float32).expand_as(o).contiguous()
    hit = torch.zeros(len(o), dtype=torch.bool)
    for block in BLOCKS:
        enter, leave = block.interval(o, d)
        hit |= (enter < leave) & (leave > 0)
    lit = ~hit.numpy()
    albedo = 0.15 * np.exp(0.12 * rng.standard_normal((len(x), 1)))
    radiance = albedo / np.pi * (ambient + lit[:, None] * STRENGTH * sun[2])
    return field, Pairs(x, normal, radiance, late), sky


@pytest.mark.parametrize(("elevation", "azimuth"), [(40, 218), (25, 80)])
def test_a_hard_sun_is_found_from_its_shadows(elevation, azimuth):
    sun = direction(elevation, azimuth)
    field, pairs, sky = sunlit_yard(sun)
    found = hard_sun(field, gather_light(field, pairs), sky)
    assert np.degrees(np.arccos(found.direction @ sun)) < 3.0
    assert found.gain > finding.MIN_GAIN and found.error < finding.MAX_ERROR
    strength = sun_strength(field, pairs, sun, sky)
    np.testing.assert_allclose(strength, STRENGTH, rtol=0.15)


def test_no_sun_is_found_under_an_even_sky():
    field, pairs, sky = sunlit_yard(direction(40, 218))
    even = gather_light(field, pairs).ambient(sky)
    texture = np.exp(0.25 * np.random.default_rng(1).standard_normal((len(even), 1)))
    plain = Pairs(pairs.x, pairs.normal, 0.15 / np.pi * even * texture, pairs.late)
    found = hard_sun(field, gather_light(field, plain), sky)
    assert found.gain < finding.MIN_GAIN


@pytest.mark.slow
def test_two_halves_of_the_photos_under_two_suns_contradict_each_other():
    field, morning, sky = sunlit_yard(direction(35, 110))
    _, evening, _ = sunlit_yard(direction(35, 250))
    mixed = np.where(morning.late[:, None], evening.radiance, morning.radiance)
    pairs = Pairs(morning.x, morning.normal, mixed, morning.late)
    halves = hard_sun(field, gather_light(field, pairs), sky).halves
    assert halves is not None
    azimuths = [np.degrees(elevation_azimuth(sun)[1]) for sun in halves]
    np.testing.assert_allclose(azimuths, [110, 250], atol=12)
    assert hard_sun(field, gather_light(field, morning), sky).halves is None
    shuffled = np.random.default_rng(2).permutation(len(mixed) // 2).repeat(2) % 2 == 0
    mixed = np.where(shuffled[:, None], evening.radiance, morning.radiance)
    pairs = Pairs(morning.x, morning.normal, mixed, morning.late)
    assert hard_sun(field, gather_light(field, pairs), sky).halves is None, "not by halves"


def test_suns_that_explain_both_halves_do_not_contradict():
    """Each half has another best candidate, but the other's lowers its deviations too."""
    candidates = np.stack([direction(35, 110), direction(35, 250)])
    late, none = np.arange(200) >= 100, np.ones(200)
    own, other = 0.9 * none, {"agree": 0.95, "contradict": 1.05}
    for name, cross in other.items():
        found = np.stack([np.where(late, cross, own), np.where(late, own, cross)], axis=-1)
        halves = finding._contradiction(candidates, found, none, late)
        assert (halves is None) == (name == "agree")


def test_noise_does_not_contradict_one_sun():
    """The best of many candidates seems to explain each half, but no pairs it was not chosen by."""
    random = np.random.default_rng(5)
    candidates = random.standard_normal((180, 3))
    candidates /= np.linalg.norm(candidates, axis=1, keepdims=True)
    late, seemed = np.arange(320) >= 160, 0
    for _ in range(40):
        none = np.abs(random.normal(1.0, 0.3, 320))
        found = none[:, None] + random.normal(0.0, 0.4, (320, 180))
        gains = [1 - found[half].mean(0) / none[half].mean() for half in (~late, late)]
        a, b = (int(gain.argmax()) for gain in gains)
        seemed += min(gains[0][a], gains[1][b]) > finding.CLEAR_GAIN
        assert finding._contradiction(candidates, found, none, late) is None
    assert seemed == 40


def lobe_sky(d, elevation=35.0, azimuth=100.0, width=20.0, peak=4.0):
    base = 0.6 * (1 + 0.2 * d[:, 2])
    angle = np.degrees(np.arccos(np.clip(d @ direction(elevation, azimuth), -1, 1)))
    return (base + peak * np.exp(-((angle / width) ** 2)))[:, None].repeat(3, axis=1)


def test_a_clipped_lobe_is_extrapolated_from_its_flank():
    """Photos show the sky up to 25 degrees; the lobe stands at 35 and is white in them."""
    d = sphere_directions(6000).double().numpy()
    low = d[(d[:, 2] > 0.03) & (d[:, 2] < math.sin(math.radians(25)))]
    up = d[d[:, 2] > 0]
    level = float((lobe_sky(up)[:, 0] * up[:, 2]).sum() * 4 / 6000)  # E/pi
    model = fit_sky(low, np.minimum(lobe_sky(low), 1.0), 0.15 * level, lobe=True)
    found = CapturedLight(
        model.horizon,
        model.zenith,
        model.sun,
        model.width,
        model.lobe,
        np.zeros((ROWS, COLUMNS)),
        0,
    )
    elevation, azimuth = np.degrees(elevation_azimuth(found.sun))
    assert abs(azimuth - 100) < 3 and abs(elevation - 35) < 15
    up = torch.tensor(up, dtype=torch.float32)
    sky = found.sky(up, torch.ones_like(up)).numpy()
    again = float((sky[:, 0] * up[:, 2].numpy()).sum() * 4 / 6000)
    assert again == pytest.approx(level, rel=0.15)


def test_clouds_over_the_horizon_brighten_the_zenith_less_beside_a_sun(monkeypatch):
    """The sky brightens by 12 % up to 20 degrees, and its zenith is as bright as its horizon."""

    def cloudy(d):
        rise = 0.12 * np.clip((d[:, 2:] - 0.05) / 0.3, 0, 1) * (d[:, 2:] < 0.5)
        return lobe_sky(d) - 0.6 * (1 + 0.2 * d[:, 2:]) + 0.65 * (1 + rise)

    d = sphere_directions(6000).double().numpy()
    low = d[(d[:, 2] > 0.03) & (d[:, 2] < math.sin(math.radians(25)))]
    up = d[d[:, 2] > 0]
    level = float((cloudy(up)[:, 0] * up[:, 2]).sum() * 4 / 6000)
    given = low, np.minimum(cloudy(low), 1.0), 0.18 * level
    held = fit_sky(*given, lobe=True)
    monkeypatch.setattr(sky_fit, "GLOWING_SKY", (0.0, 100.0))
    carried_on = fit_sky(*given, lobe=True)
    excess, before = (float(model.zenith[0]) - 0.65 for model in (held, carried_on))
    assert 0 < excess < 0.8 * before
    assert float(held.horizon[0]) == pytest.approx(0.65, rel=0.05)


def test_a_few_bright_points_change_the_level_of_the_ground_little():
    random = np.random.default_rng(1)
    radiance = np.where(random.random((1000, 1)) < 0.05, 0.85, 0.1) * np.ones(3)
    up = np.tile([0.0, 0.0, 1.0], (1000, 1))
    pairs = Pairs(0 * up, up, radiance, np.zeros(1000, bool))
    expected = 0.1 * (0.85 / 0.1) ** (radiance[:, 0] > 0.5).mean()
    assert finding._level_ground(pairs) == pytest.approx(expected)
    assert expected < 0.85 * radiance.mean()
    aside = Pairs(0 * up, up[:, ::-1], radiance, np.zeros(1000, bool))
    assert finding._level_ground(aside) == 0, "walls are no ground"


def test_photographed_sky_is_kept_where_it_is_shown_and_not_clipped():
    shown = np.ones((ROWS, COLUMNS))
    light = CapturedLight(
        np.full(3, 0.4), np.full(3, 0.4), direction(30, 0), 0.3, np.full(3, 9.0), shown, 0.1
    )
    d = torch.tensor(np.stack([direction(30, 0), direction(30, 180), direction(30, 5)])).float()
    photo = torch.tensor([[1.0] * 3, [0.3] * 3, [0.5] * 3])
    sky = light.sky(d, photo)
    assert float(sky[0, 0]) == pytest.approx(9.4, rel=1e-3), "clipped: the lobe shows"
    torch.testing.assert_close(sky[1:], photo[1:])
    hidden = CapturedLight(*list(vars(light).values())[:5], 0 * shown, 0.1)
    assert float(hidden.sky(d, photo)[1, 0]) == pytest.approx(0.4, rel=1e-3), "not shown: the model"


@pytest.mark.parametrize("width", [0.0, 0.4])
def test_the_file_gives_back_the_same_light(tmp_path, width):
    shown = np.round(np.random.default_rng(0).random((ROWS, COLUMNS)), 3)
    light = CapturedLight(
        np.array([0.3, 0.4, 0.5]), np.ones(3), direction(40, 218), width, STRENGTH, shown, 0.02,
        direction(41, 216),
    )  # fmt: skip
    save_light(tmp_path / "light.json", light, "abc")
    again, checkpoint = load_light(tmp_path / "light.json")
    assert checkpoint == "abc" and again is not None and again.hard == (width == 0.0)
    for name in ("horizon", "zenith", "sun", "width", "lobe", "shown", "sun_error", "almanac"):
        np.testing.assert_allclose(getattr(again, name), getattr(light, name), atol=1e-9)
    unknown = UnknownLight("the photos show too little sky")
    save_light(tmp_path / "light.json", unknown, "abc")
    assert load_light(tmp_path / "light.json") == (unknown, "abc")
    for damaged in ('{"light": {"horizon": [1]}, "checkpoint": ""}', '{"light": 3}'):
        (tmp_path / "light.json").write_text(damaged)
        with pytest.raises(UserError, match=r"light\.json is damaged"):
            load_light(tmp_path / "light.json")


@pytest.mark.parametrize(("elevation", "peak", "strong"), [(40.0, 4.0, True), (5.0, 0.2, False)])
def test_a_faint_lobe_is_no_sun(elevation, peak, strong):
    light = CapturedLight(
        np.full(3, 0.8), np.full(3, 0.7), direction(elevation, 20.0), np.radians(22.0),
        np.full(3, peak), np.ones((18, 36)), 0.1,
    )  # fmt: skip
    assert (glow_share(light) >= MIN_SUN) is strong
