"""Flags that change nothing, and what they would need."""

import pytest

from climatenerf.weather.description import (
    read_weather,
    weather_from_table,
    without_effect,
)


def test_keyframed_values_count(tmp_path):
    path = tmp_path / "film.toml"
    path.write_text('[snow]\ndepth = "10 cm"\ndrift = { "0 s" = 0, "4 s" = 0.5 }\n')
    film = read_weather(path)
    assert without_effect(film, frozenset({"snow.wind_direction"})) == {}


def unused(table, *given):
    return without_effect(weather_from_table(table), frozenset(given))


SNOWY = {"depth": "10 cm"}


@pytest.mark.parametrize(
    ("snow", "name", "needed"),
    [
        ({"light": "paper"}, "sparkle", "--snow.light scene"),
        ({}, "wrap", "--snow.light paper"),
        ({"albedo": 0.8}, "soot", "--snow.albedo none"),
        ({}, "slope_sharpness", "--snow.slope"),
        ({}, "wind_direction", "--snow.fall-tilt or --snow.drift"),
    ],
)
def test_flags_of_snow_that_change_nothing_name_what_they_need(snow, name, needed):
    found = unused({"snow": {**SNOWY, **snow}}, f"snow.{name}")
    assert found == {f"snow.{name}".replace("_", "-"): needed}


@pytest.mark.parametrize(
    ("snow", "name"),
    [
        ({"slope": "40 deg"}, "slope_sharpness"),
        ({"drift": 0.5}, "wind_direction"),
        ({"fall-tilt": "20 deg"}, "wind_direction"),
        ({}, "soot"),
        ({}, "grain"),
        ({"light": "paper"}, "wrap"),
        ({"light": "paper"}, "grain"),  # it is the light of the place that depends on it
    ],
)
def test_flags_that_change_something_are_not_named(snow, name):
    assert unused({"snow": {**SNOWY, **snow}}, f"snow.{name}") == {}
