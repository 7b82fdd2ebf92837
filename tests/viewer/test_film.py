"""Time in the viewer: moments, keyframes and play."""

import itertools
import time

import pytest

from climatenerf.viewer.film import TimeControls
from climatenerf.weather.description import KeyframedWeather
from climatenerf.weather.flood.parameters import Flood
from climatenerf.weather.registry import EFFECTS
from climatenerf.weather.smog.parameters import Smog
from climatenerf.weather.weather import Weather


class Control:
    """A control of viser's: a value, and what is called when it changes."""

    def __init__(self, value=None):
        self._value, self._calls, self.content = value, [], ""

    @property
    def value(self):
        return self._value

    @value.setter
    def value(self, value):
        self._value = value
        for call in self._calls:
            call(None)

    def on_update(self, call):
        self._calls.append(call)

    def on_click(self, call):
        self._calls.append(call)

    def __enter__(self):
        return self

    def __exit__(self, *error):
        return None


class Gui:
    """A GUI that keeps its controls by name."""

    def __init__(self):
        self.made = {}

    def _made(self, name, value=None):
        return self.made.setdefault(name, Control(value))

    def add_folder(self, name, **rest):
        return Control()

    def add_slider(self, name, low, high, step, value):
        return self._made(name, value)

    def add_checkbox(self, name, value):
        return self._made(name, value)

    def add_button(self, name):
        return self._made(name)

    def add_markdown(self, text):
        return self._made("text")


class Tab:
    """Weather controls and a list of what was told."""

    def __init__(self, film=None):
        self.gui, self.weather, self.told, self.changes = Gui(), Weather(), [], 0
        film = film or KeyframedWeather(Weather(), {})
        self.film = TimeControls(
            self.gui, EFFECTS, film, lambda: self.weather, self.put, self.change, self.told.append
        )

    def put(self, weather):
        self.weather = weather or self.weather

    def change(self):
        self.changes += 1

    def at(self, moment):
        self.gui.made["time, s"].value = moment


def flooded(level, wind=2.0):
    return Weather(flood=Flood(level=level, wind_speed=wind))


@pytest.fixture
def tab():
    made = Tab()
    yield made
    made.film.close()


def test_two_keyframes_make_a_film_that_the_slider_moves_through(tab):
    for moment, level in ((0.0, 0.1), (4.0, 0.9)):
        tab.at(moment)
        tab.weather = flooded(level)
        tab.film.keep()
    assert tab.film.film.keyframes == {"flood.level": ((0.0, 0.1), (4.0, 0.9))}
    tab.at(1.0)
    assert tab.weather.flood.level == pytest.approx(0.3)
    assert tab.film.weather() is tab.film.film and tab.film.now == 1.0
    tab.weather, tab.film.edited = flooded(0.7), True  # a control was moved
    assert tab.film.weather() == flooded(0.7)
    assert "0, 4 s" in tab.gui.made["text"].content and tab.changes == 2
    tab.at(3.6)
    assert tab.told[-1] == "what was changed without a keyframe is gone"
    assert tab.film.weather() is tab.film.film
    tab.film.drop()
    assert sorted(tab.film.moments) == [0.0] and not tab.film.film.keyframes
    tab.film.drop()
    assert tab.film.film is None
    tab.film.drop()
    assert tab.told[-1] == "there is no keyframe"


def test_keyframes_that_do_not_fit_are_told_and_left_out(tab):
    tab.weather = flooded(None)
    tab.film.keep()
    tab.at(2.0)
    tab.weather = flooded(0.5)
    tab.film.keep()
    assert "flood.level has no value at 0 s" in tab.told[-1]
    assert sorted(tab.film.moments) == [0.0]


def test_a_value_that_stays_for_a_movie_is_told(tab):
    tab.weather = flooded(0.2, wind=1.0)
    tab.film.keep()
    tab.at(2.0)
    tab.weather = flooded(0.2, wind=3.0)
    tab.film.keep()
    assert "flood.wind-speed: one value for the whole movie" in tab.gui.made["text"].content


def test_a_film_that_is_given_plays_from_its_beginning_again():
    keyframes = {"smog.visibility": ((0.0, 100.0), (0.3, 20.0), (0.6, 50.0))}
    given = KeyframedWeather(Weather(smog=Smog(visibility=100.0)), keyframes)
    tab = Tab(given)
    assert tab.film.film == given
    shown = []
    tab.film._put = lambda weather: shown.append((tab.film.now, weather.smog.visibility))
    tab.gui.made["play"].value = True

    def begun_again():
        return any(later[0] < earlier[0] for earlier, later in itertools.pairwise(shown))

    end = time.monotonic() + 60
    while not begun_again():
        assert time.monotonic() < end, shown
        time.sleep(0.02)
    assert all(0 <= moment <= 0.6 for moment, _ in shown)
    assert all(value == given.at(moment).smog.visibility for moment, value in shown)
    tab.film.close()
    count = len(shown)
    time.sleep(0.3)
    assert len(shown) == count, "it has stopped"
