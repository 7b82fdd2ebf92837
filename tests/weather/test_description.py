"""Weather files: reading, errors, keyframes, flags and round trips."""

import json
import math
import tomllib

import pytest
import tomli_w

from climatenerf.core.errors import UserError
from climatenerf.weather.description import (
    KeyframedWeather,
    combine,
    from_moments,
    given_flags,
    read_weather,
    weather_from_table,
    weather_to_table,
    weather_to_toml,
)
from climatenerf.weather.flood.parameters import Flood
from climatenerf.weather.registry import EFFECTS
from climatenerf.weather.smog.parameters import Smog
from climatenerf.weather.snow.parameters import Snow
from climatenerf.weather.weather import Weather

FILE = """
seed = 7
[flood]
level = { "4 s" = "0.8 m", "0 s" = "0 m" }
wind-speed = "6 m/s"
colour = [0.5, 0.4, 0.3]
[smog]
visibility = "200 m"
contrast = 0.02
[snow]
slope = "40 deg"
"""


@pytest.fixture
def film(tmp_path) -> KeyframedWeather:
    path = tmp_path / "weather.toml"
    path.write_text(FILE)
    return read_weather(path)


def test_values_and_keyframes_are_read(film):
    assert film.base.seed == 7
    assert film.base.flood.wind_speed == 6
    assert film.base.flood.colour == (0.5, 0.4, 0.3)
    assert film.base.smog == Smog(visibility=200, contrast=0.02)
    assert film.base.snow == Snow(slope=math.radians(40))
    levels = [film.at(t).flood.level for t in (-1, 0, 1, 2, 4, 9)]
    assert levels == pytest.approx([0, 0, 0.2, 0.4, 0.8, 0.8])
    assert film.at(3).smog == film.base.smog


def test_colours_are_interpolated():
    film = weather_from_table(
        {"smog": {"sigma": "1 1/m", "colour": {"1 s": [0, 0, 0], "3 s": [1, 0.5, 0]}}}
    )
    assert film.at(1.5).smog.colour == pytest.approx((0.25, 0.125, 0))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[fload]", 'unknown section "fload"; did you mean "flood"?'),
        ('[flood]\nlevle = "1 m"', 'unknown key in [flood] "levle"; did you mean "level"?'),
        ('[flood]\nwind = "1 m/s"', "did you mean"),
        ('[flood]\nlevel = "3 kg"', 'flood.level must be a length such as "0.5 m"; got "3 kg"'),
        ("[flood]\nlevel = 3", 'flood.level must be a length such as "0.5 m"; got 3'),
        ("[flood]\nwave-scale = true", "flood.wave-scale must be a number; got True"),
        ("[flood]\ncolour = [1, 2]", "flood.colour must be three numbers"),
        ("[flood]\nlevel = {}", "empty table of keyframes"),
        (
            '[flood]\nlevel = {"1 m" = "1 m"}',
            'a time of flood.level must be a duration such as "4 s"',
        ),
        ('[flood]\nlevel = {"1 s" = "1 m", "1000 ms" = "2 m"}', "names the same time twice"),
        ('[flood]\nlevel = {"0 s" = "none", "1 s" = "2 m"}', 'has "none" in a keyframe'),
        ('[flood]\nlevel = {"0 s" = "1 m", "1 s" = "2000 m"}', "must lie between"),
        ('[smog]\nvisibility = "9 m"\nsigma = "1 1/m"', "give only one"),
        ("flood = 3", "[flood] must be a table of values; got 3"),
        ("seed = 1.5", "seed must be a whole number; got 1.5"),
        ("[flood", "is not valid TOML"),
    ],
)
def test_invalid_files_are_refused(tmp_path, text, message):
    path = tmp_path / "weather.toml"
    path.write_text(text)
    with pytest.raises(UserError) as error:
        read_weather(path)
    assert message in str(error.value)
    assert str(path) in str(error.value)


def test_missing_and_binary_files_are_refused(tmp_path):
    with pytest.raises(UserError, match="the weather file: .*does not exist"):
        read_weather(tmp_path / "none.toml")
    with pytest.raises(UserError, match="is a folder where a file was expected"):
        read_weather(tmp_path)
    (tmp_path / "a.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UserError, match="encoding UTF-16"):
        read_weather(tmp_path / "a.toml")


def test_weather_round_trips(film):
    for weather in (film, KeyframedWeather(Weather(), {})):
        table = weather_to_table(weather)
        assert weather_from_table(json.loads(json.dumps(table))) == weather
        assert weather_from_table(tomllib.loads(tomli_w.dumps(table))) == weather
    assert weather_to_table(film.at(2))["flood"]["level"] == "0.4 m"


def test_flags_override_the_file(film):
    arguments = ["render", "--flood.wind-speed=2 m/s", "--smog.sigma", "0.1 1/m", "--frames", "3"]
    given = given_flags(arguments)
    assert given == {"flood.wind_speed", "smog.sigma"}
    # A flag overrides the file even if it repeats the default.
    flags = Weather(flood=Flood(wind_speed=Flood().wind_speed), smog=Smog(sigma=0.1))
    mixed = combine(film, flags, given)
    assert mixed.base.flood.wind_speed == Flood().wind_speed
    assert (mixed.base.smog.visibility, mixed.base.smog.sigma) == (None, 0.1)
    assert mixed.base.smog.contrast == 0.02
    assert mixed.base.seed == 7
    assert mixed.at(2).flood.level == pytest.approx(0.4)


def test_a_flag_replaces_keyframes(film):
    given = given_flags(["--flood.level", "2 m"])
    assert combine(film, Weather(flood=Flood(level=2.0)), given).at(3).flood.level == 2


def test_flags_without_a_file():
    assert combine(None, Weather(seed=3), frozenset()).at(1) == Weather(seed=3)


def test_a_flag_for_clarity_replaces_the_files_attenuation():
    film = weather_from_table({"flood": {"level": "0 m", "attenuation": [0.1, 0.2, 0.3]}})
    flags, given = Weather(flood=Flood(clarity=2.0)), frozenset({"flood.clarity"})
    mixed = combine(film, flags, given).at(0)
    assert mixed.flood.attenuation is None and mixed.flood.clarity == 2.0
    assert combine(film, flags, frozenset()).at(0).flood.attenuation == (0.1, 0.2, 0.3)


def test_a_word_in_keyframes_holds_until_the_next():
    film = weather_from_table({"sky": {"kind": {"0 s": "captured", "2 s": "overcast"}}})
    kinds = [film.at(time).sky.kind for time in (0.0, 1.9, 2.0, 5.0)]
    assert kinds == ["captured", "captured", "overcast", "overcast"]
    with pytest.raises(UserError, match="must be one of captured, overcast"):
        weather_from_table({"sky": {"kind": {"0 s": "sunny"}}})


def test_keyframes_of_what_a_movie_reads_once_are_named():
    keys = {"0 s": "2 m/s", "3 s": "6 m/s"}
    levels = {"0 s": "0 m", "3 s": "1 m"}
    film = weather_from_table({"flood": {"level": levels, "wind-speed": keys}})
    assert film.frozen(EFFECTS) == ["flood.wind_speed"]


def test_a_written_weather_file_has_what_was_changed_alone(film, tmp_path):
    text = weather_to_toml(film)
    (tmp_path / "weather.toml").write_text(text)
    assert read_weather(tmp_path / "weather.toml") == film
    assert "[season]" not in text
    assert weather_to_toml(Weather()) == ""


def test_moments_become_keyframes_of_what_changes():
    first = Weather(flood=Flood(level=0.1, wind_speed=3.0))
    second = first.with_value("flood.level", 0.5).with_value("smog.visibility", 30.0)
    with pytest.raises(UserError, match=r"smog.visibility has no value at 0 s, but one at another"):
        from_moments({2.0: second, 0.0: first})
    second = second.with_value("smog.visibility", None)
    found = from_moments({2.0: second, 0.0: first})
    assert found == KeyframedWeather(first, {"flood.level": ((0.0, 0.1), (2.0, 0.5))})
    assert found.duration == 2.0 and found.at(2.0) == second
    assert from_moments({1.0: first}).duration == 0.0
