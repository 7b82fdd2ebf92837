"""The style of a run: its file, and that weather renders with it."""

import json
from dataclasses import replace

import numpy as np
import pytest
from support.sunlit_yard import sunlit_yard, yard_scene

from climatenerf.core.classes import TERRAIN, VEGETATION
from climatenerf.core.errors import UserError
from climatenerf.render.session import RenderSession
from climatenerf.weather.description import weather_from_table
from climatenerf.weather.season.palettes import palettes_of, seasonal_style
from climatenerf.weather.style import FILE_NAME, Source, style_in, weakened, write_style

MEANS = {VEGETATION: np.array([0.1, 0.16, 0.03]), TERRAIN: np.array([0.2, 0.18, 0.1])}


def a_style():
    style = seasonal_style("winter", palettes_of("winter"), MEANS, 3.0, 7)
    return replace(style, sources=(Source("a.jpg", "00ff", "CC BY 4.0"),))


def test_a_style_is_read_as_it_was_written(tmp_path):
    assert style_in(tmp_path) is None
    write_style(tmp_path, a_style())
    read, written = style_in(tmp_path), a_style()
    for mine, theirs in zip(read.classes, written.classes, strict=True):
        np.testing.assert_array_equal(mine.palette, theirs.palette)
        np.testing.assert_array_equal(mine.matrix, theirs.matrix)
        assert (mine.kind, mine.strength, mine.gate) == (theirs.kind, theirs.strength, theirs.gate)
    assert replace(read, classes=()) == replace(written, classes=())


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("classes", "vegetation", "palette"), []),
        (("classes", "vegetation", "palette"), [[1, 2]]),
        (("classes", "vegetation", "palette"), 17 * [[1, 1, 1]]),
        (("classes", "vegetation", "matrix"), [[1, 0, 0], [0, 1, 0]]),
        (("classes", "vegetation", "matrix"), [[1, 0, 0], [0, 1, 0], [0, 0, "x"]]),
        (("classes", "vegetation", "strength"), 2),
        (("classes", "vegetation", "gate"), None),
        (("classes", "leaves"), {}),
        (("classes", "sky"), {}),
        (("classes",), []),
        (("sky", "colour"), [1, 1]),
        (("sky", "share"), -1),
        (("sky",), 3),
        (("patch_m",), 0),
        (("seed",), 0.5),
        (("sources",), ["a.jpg"]),
        (("name",), None),
        (("schema_version",), 99),
    ],
)
def test_damaged_style_files_are_one_sentence(tmp_path, place, value):
    write_style(tmp_path, a_style())
    data = json.loads((tmp_path / FILE_NAME).read_text())
    table = data
    for key in place[:-1]:
        table = table[key]
    table[place[-1]] = value
    (tmp_path / FILE_NAME).write_text(json.dumps(data))
    with pytest.raises(UserError) as error:
        style_in(tmp_path)
    assert "\n" not in str(error.value)


def test_a_weakened_style_changes_less():
    style, half = a_style(), weakened(a_style(), 0.5)
    assert half.classes[0].strength == 0.5 * style.classes[0].strength
    assert half.sky.share == 0.5 * style.sky.share


@pytest.mark.slow
def test_a_styled_run_shows_what_its_season_shows_and_a_season_replaces_it():
    field, scene = sunlit_yard(), yard_scene()
    camera, pose = scene.cameras[0].resized(24, 15), scene.c2w_world(scene.views[0])

    plain = RenderSession(field, scene, weather_from_table({}))

    def seen(session, **table):
        session.change(weather_from_table(table))
        return session.frame(camera, pose).linear

    winter = seen(plain, season={"kind": "winter"})
    means = plain._entities["season"]._means
    style = seasonal_style("winter", palettes_of("winter"), means, 4.0, 0)
    styled = RenderSession(field, scene, weather_from_table({}), style=style)
    np.testing.assert_array_equal(seen(styled), winter)
    clean = seen(plain)
    assert float((winter - clean).abs().max()) > 0.01
    np.testing.assert_array_equal(seen(styled, season={"strength": 0}), clean)
    autumn = seen(plain, season={"kind": "autumn"})
    np.testing.assert_array_equal(seen(styled, season={"kind": "autumn"}), autumn)
