"""The four panels: what each must show, and how they are made."""

import numpy as np
import pytest
import torch
from support.study_yard import LABELLED, yard_shot

from climatenerf.core.errors import UserError
from climatenerf.render.session import Frame
from climatenerf.studies import season_panels as p
from climatenerf.studies.shot import Place
from climatenerf.verification.setting import protocol_of
from climatenerf.weather.season.parameters import Season
from climatenerf.weather.snow.parameters import Snow
from climatenerf.weather.weather import Weather


def frame(grey, snow=0.0, depth=5.0):
    """An even picture with an even layer of snow."""
    layers = {"mask_snow": np.full((4, 6), snow), "depth": np.full((4, 6), depth)}
    return Frame(torch.full((4, 6, 3), grey), layers)


def panels(**changed):
    frames = {
        "original": frame(0.1),
        "+ snow": frame(0.8, snow=0.6),
        "styled": frame(0.2),
        "styled + snow": frame(0.7, snow=0.6),
    }
    return frames | {name.replace("_", " "): each for name, each in changed.items()}


def test_panels_show_snow_and_season_and_nothing_else():
    assert p.verdict("original", panels()) == ("", None)
    texts = [p.verdict(name, panels()) for name in p.ROWS[1:]]
    assert [shown for _, shown in texts] == [True, True, True]
    assert "snow on 60 % of the picture" in texts[0][0]


@pytest.mark.parametrize(
    ("name", "changed"),
    [
        ("+ snow", frame(0.8, snow=0.0)),
        ("+ snow", frame(0.1, snow=0.6)),
        ("styled", frame(0.2, depth=4.9)),
        ("styled", frame(0.1)),
        ("styled + snow", frame(0.7, snow=0.5)),
        ("styled + snow", frame(0.8, snow=0.6)),
    ],
)
def test_a_panel_that_moves_matter_or_changes_nothing_is_told(name, changed):
    assert not p.verdict(name, panels(**{name: changed}))[1]


def test_numbers_of_a_panel():
    linear = torch.tensor([0.2, 0.4, 0.1]).expand(4, 6, 3)
    own = Frame(linear, {"mask_snow": np.full((4, 6), 0.25)})
    found = p.measured(own, own)
    assert found["mean_luma"] == pytest.approx(0.2126 * 0.2 + 0.7152 * 0.4 + 0.0722 * 0.1, abs=1e-4)
    # sRGB of .4 and .1: 170 and 89.
    assert found["colourfulness_255"] == 81 and found["snow_share"] == 0.25
    assert found["difference_from_original_255"] == 0


def test_panels_need_snow_and_a_season(tmp_path):
    for weather in (Weather(snow=Snow(depth=0.1)), Weather(season=Season(kind="winter"))):
        with pytest.raises(UserError, match="need snow and a season"):
            p.season_panels(yard_shot(tmp_path, weather), lambda name: None)


@pytest.mark.slow
def test_the_panels_of_a_yard(tmp_path):
    """Autumn recolours the hedge, and snow lies where it lay."""
    weather = Weather(snow=Snow(depth=0.1), season=Season(kind="autumn"))
    plain = yard_shot(tmp_path, weather)
    place = Place(protocol_of(LABELLED), plain.place.scene)
    shot = type(plain)(place, plain.view, plain.camera, plain.c2w, weather)
    rows = p.season_panels(shot, lambda name: None)
    assert tuple(row.name for row in rows) == p.ROWS
    assert [row.shown for row in rows] == [None, True, True, True], [row.fault for row in rows]
