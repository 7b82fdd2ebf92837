"""Flags of `page`, and what is chosen where they leave it open."""

from pathlib import Path

import numpy as np
import pytest
from support.command_line import error_message
from support.holed_ground import LabelledField, terrain_of
from support.study_yard import BOX, HORIZON, SOLIDS, ZENITH, yard_place

from climatenerf.cli.page import Page, settings_of
from climatenerf.core.classes import BUILDING, VEGETATION
from climatenerf.core.errors import UserError
from climatenerf.page.languages import LANGUAGES
from climatenerf.page.pictures import page_pictures
from climatenerf.page.settings import PageSettings
from climatenerf.page.views import Ground, find_ground, page_views, placed_objects, water_levels
from climatenerf.render.completed_ground import CompletedField
from climatenerf.render.placed_objects import StaffGauge
from climatenerf.render.session import RenderSession
from climatenerf.weather.flood.parameters import Flood
from climatenerf.weather.weather import Weather


def page_options(**changes):
    return Page(Path("run"), Path("page.html"), **changes)


def test_defaults_of_the_flags_are_those_of_the_settings():
    assert settings_of(page_options()) == PageSettings()


def test_an_unknown_photo_is_told_with_some_that_there_are(tmp_path):
    scene = yard_place(tmp_path).scene
    name = scene.views[0].name
    with pytest.raises(UserError, match=rf"no photo 'nope.jpg'; give --views .* {name}"):
        page_views(scene, ["nope.jpg"], 1, None)


def test_lengths_take_any_unit():
    found = settings_of(
        page_options(levels="20 in, 1.2 m", snow="", smog="0.1 km", views="a,b.jpg")
    )
    assert found.levels == pytest.approx((0.508, 1.2))
    assert found.snow_depths == () and found.visibilities == pytest.approx((100.0,))
    assert found.views == ("a", "b.jpg")


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"levels": "1"}, "each of --levels must be a length such as"),
        ({"snow": "20 m"}, "--snow must be at most 20 lengths from 0.001 m to 10 m"),
        ({"views": "25"}, "--views must be 1 to 24"),
        ({"views": "0"}, "--views must be 1 to 24"),
        ({"seasons": "spring"}, "there is no season 'spring'; use autumn"),
        ({"language": "tlh"}, "--language must be one of en, de, fr, es"),
        ({"title": "two\nlines"}, "--title must be one line of at most 200 characters"),
        ({"error": "-1 m"}, "--error must be from 0 m to 100 m"),
        ({"size": "10x10"}, "--size must be width x height"),
    ],
)
def test_wrong_flags_are_told_in_a_sentence(changes, sentence):
    with pytest.raises(UserError) as caught:
        settings_of(page_options(**changes))
    assert sentence in str(caught.value)


def test_files_that_are_no_page_are_refused(tmp_path, capsys):
    run = tmp_path / "run"
    assert "must name an HTML file" in error_message(capsys, "page", run, "-o", tmp_path)
    assert "must name an HTML file" in error_message(capsys, "page", run, "-o", tmp_path / "a.png")
    missing = tmp_path / "no" / "a.html"
    assert "make it first" in error_message(capsys, "page", run, "-o", missing)
    film = tmp_path / "w.toml"
    film.write_text('[smog]\nvisibility = { "0 s" = "10 m", "1 s" = "20 m" }\n')
    given = "page", run, "-o", tmp_path / "a.html", "--weather", film
    assert "without keyframes" in error_message(capsys, *given)
    assert "give a run folder" in error_message(capsys, "page", run, "-o", tmp_path / "a.html")


def test_all_languages_have_the_same_words():
    keys = {name: set(words) for name, words in LANGUAGES.items()}
    assert all(found == keys["en"] for found in keys.values())
    for words in LANGUAGES.values():
        assert {key for key, text in words.items() if "{}" in text} == {
            key for key, text in LANGUAGES["en"].items() if "{}" in text
        }


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    place = yard_place(tmp_path_factory.mktemp("yard"))
    views = page_views(place.scene, (), 2, (160, 100))
    session = RenderSession(place.field, place.scene, Weather())
    return place, views, [find_ground(session, view) for view in views]


def test_levels_begin_above_the_lowest_ground_and_stay_below_the_cameras(seen):
    _, views, grounds = seen
    levels = water_levels((), grounds, views, 0.0)
    assert len(levels) == 5 and levels == sorted(levels)
    assert 0.1 <= levels[0] <= 0.3 and 0.9 <= levels[-1] <= 1.3
    assert water_levels((0.5, 0.2), grounds, views, 0.0) == [0.2, 0.5]


def test_levels_outside_the_scene_are_refused(seen):
    _, views, grounds = seen
    with pytest.raises(UserError, match=r"a water level of 2 m lies above a camera at 1\.60 m"):
        water_levels((2.0,), grounds, views, 0.0)
    with pytest.raises(UserError, match="below all ground in these views"):
        water_levels((-30.0,), grounds, views, 0.0)
    nothing = [Ground(g.x, np.zeros_like(g.ground), g.t) for g in grounds]
    with pytest.raises(UserError, match="no level ground"):
        water_levels((), nothing, views, 0.0)


def test_gauge_and_figure_stand_once_on_free_ground(seen):
    _, views, grounds = seen
    found = placed_objects(views, grounds, 0.0, 1.0)
    assert len(found) == 2, "both views show the same pair"
    gauge, figure = found
    assert isinstance(gauge, StaffGauge) and gauge.top == pytest.approx(1.4)
    for each in found:
        assert abs(each.base[2]) < 0.02
        in_house = -4.1 < each.base[0] < -0.9 and 5.9 < each.base[1] < 8.1
        assert not in_house and 2.5 < each.base[1] < 14
    apart = np.hypot(*(np.array(gauge.base[:2]) - figure.base[:2]))
    assert apart == pytest.approx(0.9, abs=1e-6)


def test_water_may_stand_close_below_the_cameras(seen):
    """Levels are looked for around the ground's height, and none may drown a camera at 1.6 m."""
    place, _, _ = seen
    settings = PageSettings(
        size=(48, 30), view_count=1, levels=(1.45,), snow_depths=(), visibilities=(), seasons=()
    )
    murky = Weather(flood=Flood(clarity=0.05))
    found = page_pictures(place, settings, murky, lambda what, fraction: None)
    flooding, heights = found.views[0].flooding, found.views[0].heights
    near = np.isfinite(heights) & (np.abs(heights - 1.45) > 0.05)
    assert ((flooding < 1.45) == (heights < 1.45))[near].all()


def test_ground_is_that_of_the_terrain_whatever_its_label(seen):
    """Predicted labels take leaf litter for vegetation."""
    place, views, _ = seen
    classes = (VEGETATION, BUILDING, VEGETATION)
    field = CompletedField(
        LabelledField(SOLIDS, zenith=ZENITH, horizon=HORIZON, box=BOX, classes=classes),
        terrain_of(half=0.01, side=15.0),
    )
    session = RenderSession(field, place.scene, Weather())
    found = find_ground(session, views[0])
    shown = np.isfinite(found.t) & (np.abs(found.x[..., 0]) < 12) & (found.x[..., 1] < 12)
    true = np.abs(found.x[..., 2]) < 0.15
    assert shown.sum() > 1000 and (found.ground == true)[shown].mean() > 0.99
    assert len(placed_objects(views[:1], [found], 0.0, 1.0)) == 2
