"""Controls of the weather: ranges, texts in any unit, and the command line that they amount to."""

import shlex
from pathlib import Path

import numpy as np
import pytest

from climatenerf.cli.flags import parse_flags
from climatenerf.cli.render import options_class
from climatenerf.core.errors import UserError
from climatenerf.paths.nerfstudio import DrawnPath, read_drawn_path, write_drawn_path
from climatenerf.scene import Scene
from climatenerf.viewer.controls import WeatherControls, render_command, slider_range
from climatenerf.weather.registry import EFFECTS
from climatenerf.weather.units import Folder
from climatenerf.weather.weather import Weather

viser = pytest.importorskip("viser", reason="needs viser (make setup installs it)")
LEVELS = (-0.5, 1.5)


class Shown:
    def __init__(self, gui):
        self.changes, self.told = [], []
        self.controls = WeatherControls(
            gui, EFFECTS, Weather(), LEVELS, self.changes.append, self.told.append
        )


@pytest.fixture
def shown():
    from climatenerf.viewer.guarded_server import start

    server = start(0)
    yield Shown(server.gui)
    server.stop()


def test_every_parameter_of_every_effect_has_a_control(shown):
    names = {
        f"{effect.name}.{item}"
        for effect in EFFECTS
        for item, parameter in effect.fields().items()
        if not isinstance(parameter, Folder)  # a page may name none of this machine's
    }
    assert set(shown.controls._texts) == names


def test_texts_take_any_unit_and_move_the_slider(shown):
    controls = shown.controls
    controls._texts["flood.level"].value = "20 in"
    assert shown.changes[-1].flood.level == pytest.approx(0.508)
    assert controls._sliders["flood.level"].value == pytest.approx(0.508)
    assert controls._switches["flood"].value is True
    controls._texts["flood.colour"].value = "0.5, 0.4 0.3"
    assert shown.changes[-1].flood.colour == (0.5, 0.4, 0.3)
    controls._texts["flood.level"].value = "none"
    assert shown.changes[-1].flood.level is None and controls._switches["flood"].value is False


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("0.5", "flood.level must be a length such as"),
        ("5 s", "flood.level must be a length such as"),
        ("9999 m", "--flood.level must lie between"),
    ],
)
def test_what_does_not_fit_is_told_and_not_taken(shown, text, sentence):
    shown.controls._texts["flood.level"].value = text
    assert shown.changes == [] and sentence in shown.told[-1]


def test_switches_and_sliders(shown):
    controls = shown.controls
    controls._switches["smog"].value = True
    assert shown.changes[-1].smog.visibility == pytest.approx(255.0)
    controls._sliders["smog.visibility"]._slider.value = 60.0
    assert shown.changes[-1].smog.visibility == pytest.approx(60.0)
    assert controls._texts["smog.visibility"].value == "60 m"
    controls._texts["smog.sigma"].value = "0.02 1/m"
    assert shown.changes[-1].smog.visibility is None, "one replaces the other"
    controls._texts["sky.kind"].value = "overcast"
    assert shown.changes[-1].sky.kind == "overcast"


def test_sliders_have_useful_ranges():
    for effect in EFFECTS:
        for item, parameter in effect.fields().items():
            found = slider_range(f"{effect.name}.{item}", parameter, LEVELS)
            if found is not None:
                assert found[0] < found[1] and found[1] - found[0] <= 1000.0
                assert found[0] >= parameter.low and found[1] <= parameter.high


def test_the_command_gives_the_weather_that_is_shown():
    weather = Weather(seed=7)
    for name, value in {
        "flood.level": -0.35, "flood.wind_speed": 6.0, "flood.colour": (0.5, 0.4, 0.3),
        "smog.visibility": 80.0, "snow.depth": 0.1, "sky.kind": "overcast",
        "sun.elevation": 0.5, "season.kind": "winter",
    }.items():  # fmt: skip
        weather = weather.with_value(name, value)
    line = render_command(Path("runs/a place"), weather, EFFECTS, "still", (640, 360))
    words = shlex.split(line)
    assert words[:2] == ["climatenerf", "render"]
    options = parse_flags(options_class(EFFECTS), "climatenerf render", words[2:])
    assert options.run == Path("runs/a place") and options.size == "640x360"
    for effect in EFFECTS:
        assert getattr(options, effect.name) == weather.sections[effect.name]
    assert options.seed == 7


def test_texts_of_parameters_are_parsed():
    fields = {f"{e.name}.{item}": p for e in EFFECTS for item, p in e.fields().items()}
    assert fields["flood.colour"].parse(" none ", "x") is None
    assert fields["flood.ior"].parse("1.4", "x") == 1.4
    for name, text in (("flood.colour", "0.5 0.4"), ("flood.ior", "wet"), ("sky.kind", "green")):
        with pytest.raises(UserError, match=r"^a place "):
            fields[name].parse(text, "a place")


def test_a_written_path_is_read_back(tmp_path):
    rng = np.random.default_rng(0)
    turned = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    world = np.eye(4)
    world[:3, :3] = 2.5 * turned * np.sign(np.linalg.det(turned))
    world[:3, 3] = (1.0, -2.0, 0.5)
    scene = Scene(tmp_path, "toy", (), (), world_from_input=world)
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, :3, 3] = rng.normal(size=(3, 3))
    drawn = DrawnPath(poses, np.array([40.0, 50.0, 60.0]), (640, 360), 24.0, "")
    found = read_drawn_path(write_drawn_path(tmp_path / "camera_path.json", scene, drawn), scene)
    np.testing.assert_allclose(found.c2w, poses, atol=1e-9)
    np.testing.assert_allclose(found.vertical_fov, drawn.vertical_fov)
    assert found.size == drawn.size and found.fps == 24.0
