"""Sweeps: what they ask for, their responses, and their files."""

import json

import numpy as np
import pytest
from PIL import Image
from support.study_yard import patch_shot, yard_shot

from climatenerf.core.errors import UserError
from climatenerf.studies import sweep as s
from climatenerf.studies.study_folder import check_folder
from climatenerf.weather.flood.parameters import Flood
from climatenerf.weather.registry import EFFECTS
from climatenerf.weather.smog.parameters import Smog
from climatenerf.weather.weather import Weather


def read(text, weather=None):
    return s.read_sweep(text, weather, EFFECTS)


def shot_for(root, sweep):
    """Snow grows on a small patch, and all else is in the yard."""
    make = patch_shot if sweep.name.startswith("snow") else yard_shot
    return make(root, sweep.weathers[0])


def rendered(root, text, weather=None):
    sweep = read(text, weather)
    shot = shot_for(root, sweep)
    return s.render_sweep(sweep, shot, shot.session(), lambda value: None)


# --- what is asked for ----------------------------------------------------------------------------


def test_values_are_read_in_the_units_of_their_flag():
    sweep = read("flood.wind-speed=1 m/s, 36 km/h,10 knots")
    assert sweep.name == "flood.wind_speed" and sweep.flag == "flood.wind-speed"
    speeds = [weather.flood.wind_speed for weather in sweep.weathers]
    assert speeds == pytest.approx([1.0, 10.0, 5.14444], rel=1e-5)
    assert {weather.flood.level for weather in sweep.weathers} == {0.5}, "the usual flood"
    assert sweep.texts == ("1 m/s", "36 km/h", "10 knots")
    kinds = read("smog.kind=fog,dust").weathers
    assert [weather.smog.kind for weather in kinds] == ["fog", "dust"]
    colours = read("smog.colour=.9 .8 .7,none").weathers
    assert [weather.smog.colour for weather in colours] == [(0.9, 0.8, 0.7), None]
    assert [weather.season.strength for weather in read("--season.strength=0,1").weathers] == [0, 1]


def test_all_else_stays_as_the_weather_file_has_it():
    weather = Weather(flood=Flood(level=0.2, clarity=2.0), smog=Smog(visibility=50.0), seed=7)
    for swept in read("flood.ior=1.2,1.4", weather).weathers:
        assert swept.with_value("flood.ior", Flood().ior) == weather


def test_a_value_replaces_its_alternative():
    sigmas = read("smog.sigma=0.01 1/m,0.02 1/m").weathers
    assert [(w.smog.sigma, w.smog.visibility) for w in sigmas] == [(0.01, None), (0.02, None)]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("smog.visibility", "no NAME=VALUE"),
        ("smog.vizibility=1 m,2 m", "names no weather flag"),
        ("seed=1,2", "names no weather flag"),
        ("flood.level=1 m", "from 2 to 20 values"),
        ("flood.level=1 m,,2 m", "from 2 to 20 values"),
        ("flood.level=1,2", "has no unit"),
        ("flood.level=1 m,2 s", "flood.level: a value must be a length"),
        ("flood.ior=1.2,much", "flood.ior: a value must be a number"),
        ("flood.ior=1.2,7", "--flood.ior must lie between"),
        ("flood.colour=1 1,0 0 0", "flood.colour: a value must be"),
        ("smog.kind=fog,rain", "smog.kind: a value must be one of"),
    ],
)
def test_what_cannot_be_swept_is_refused(text, message):
    with pytest.raises(UserError, match=message):
        read(text)


def test_a_sweep_of_an_absent_effect_is_refused():
    with pytest.raises(UserError, match="changes nothing without --flood.level"):
        read("flood.fetch=1 m,2 m", Weather())


def test_the_rows_of_the_paper_are_there():
    sweeps = s.paper_sweeps(EFFECTS)
    assert [each.flag for each in sweeps] == [
        "smog.visibility", "smog.colour", "flood.level", "flood.clarity", "flood.colour",
        "flood.wave-scale", "flood.wind-speed", "flood.fetch", "flood.ior", "snow.depth",
    ]  # fmt: skip
    assert all(len(each.texts) == 5 for each in sweeps)
    assert [weather.snow.depth for weather in sweeps[-1].weathers] == [0.01, 0.03, 0.1, 0.25, 0.5]


# --- responses ------------------------------------------------------------------------------------


QUICK = ("smog.visibility", "flood.level", "snow.depth")
ROWS = [
    pytest.param(row, id=text[:16], marks=() if text.startswith(QUICK) else pytest.mark.slow)
    for row, (text, _) in enumerate(s.PAPER)
]


@pytest.mark.parametrize("row", ROWS)
def test_each_row_of_the_paper_responds_monotonically_and_visibly(tmp_path, row):
    sweep = s.paper_sweeps(EFFECTS)[row]
    shot = shot_for(tmp_path, sweep)
    found = s.render_sweep(sweep, shot, shot.session(), lambda value: None)
    assert found.monotone, found.values
    assert found.change > s.MIN_CHANGE


def test_the_response_of_smog_is_its_transmittance(tmp_path):
    """Beer and Lambert: T = exp(-sigma d), and 0 towards the sky."""
    found = rendered(tmp_path, "smog.sigma=0.01 1/m,0.02 1/m", Weather(smog=Smog(light="paper")))
    shot = yard_shot(tmp_path, Weather())
    depth = shot.session().frame(shot.camera, shot.c2w).layers["depth"].astype(float)
    expected = [np.exp(-sigma * depth).mean() for sigma in (0.01, 0.02)]
    assert found.response == "mean_transmittance"
    assert found.values == pytest.approx(expected, rel=1e-4)


def test_a_repeated_value_gives_identical_pictures(tmp_path):
    for text in ("snow.depth=5 cm,20 cm,5 cm", "flood.level=10 cm,40 cm,10 cm"):
        found = rendered(tmp_path, text)
        assert np.array_equal(found.pictures[0], found.pictures[2])
        assert not np.array_equal(found.pictures[0], found.pictures[1])
        assert found.values[0] == found.values[2] and not found.monotone and found.change == 0


def swept(values):
    sweep = s.Sweep("flood.level", tuple(map(str, values)), ())
    greys = np.nan_to_num(10 * np.array(values)).astype(np.uint8)
    pictures = tuple(np.full((2, 2, 3), grey) for grey in greys)
    return s.Swept(sweep, "water_share", tuple(values), pictures)


def test_only_strict_steps_in_one_direction_are_monotone():
    assert swept([1.0, 2.0, 4.0]).monotone and swept([4.0, 2.0, 1.0]).monotone
    assert not swept([1.0, 2.0, 2.0]).monotone and not swept([1.0, 3.0, 2.0]).monotone
    assert not swept([1.0, float("nan"), 2.0]).monotone
    assert swept([1.0, 2.0, 4.0]).change == pytest.approx(30.0)
    assert "NOT MONOTONE" in s.line(swept([1.0, 1.0])) and "INVISIBLE" in s.line(swept([1.0, 1.0]))
    assert "NOT" not in s.line(swept([1.0, 2.0])) and "INVISIBLE" not in s.line(swept([1.0, 2.0]))


# --- files ----------------------------------------------------------------------------------------


def write(out, texts, root):
    return list(start(out, texts, root))


def start(out, texts, root):
    sweeps = tuple(read(text) for text in texts)
    kind, files = s.kind_of(sweeps), s.sweep_files(sweeps)
    earlier = check_folder(out, s.INDEX, kind, files)
    shot = yard_shot(root, sweeps[0].weathers[0])
    return s.write_sweeps(sweeps, shot, out, {"run": "toy"}, lambda value: None, earlier)


def test_a_sweep_writes_a_strip_pictures_and_an_index(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    found = write(out, ["flood.level=10 cm,50 cm,10 cm", "smog.visibility=20 m,50 m"], tmp_path)
    data = json.loads((out / "sweep.json").read_text())
    level, smog = data["sweeps"]
    assert data["schema_version"] == 2 and data["run"] == "toy"
    assert {path.name for path in out.iterdir()} == set(data["files"])
    assert level["name"] == "flood.level" and level["response"] == "water_share"
    assert level["monotone"] is False and smog["monotone"] is True
    assert [each["response"] for each in level["values"]] == list(found[0].values)
    files = [out / each["picture"] for each in level["values"]]
    assert files[0].read_bytes() != files[1].read_bytes()
    with Image.open(files[0]) as one, Image.open(files[2]) as again:
        assert np.array_equal(one, again) and one.info["simulated"].startswith("flood.level 10 cm")
    assert files[0].read_bytes() == files[2].read_bytes(), "a repeated value, byte for byte"
    with Image.open(out / "flood.level.jpg") as strip, Image.open(out / "sweep.jpg") as sheet:
        assert strip.width > 3 * 64 and sheet.height > 2 * 40


def test_a_shorter_sweep_removes_what_it_leaves_over_and_no_other_file(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    write(out, ["flood.level=10 cm,30 cm,50 cm"], tmp_path)
    (out / "mine.png").write_bytes(b"mine")
    write(out, ["flood.level=10 cm,30 cm"], tmp_path)
    assert (out / "flood.level-02.png").exists() and not (out / "flood.level-03.png").exists()
    assert (out / "mine.png").read_bytes() == b"mine"
    next(start(out, ["flood.level=20 cm,40 cm"], tmp_path))
    # Interrupted: nothing of the earlier study is left among the new pictures.
    assert not (out / "sweep.jpg").exists() and (out / "flood.level.jpg").exists()
    with pytest.raises(UserError, match="of another study"):
        write(out, ["smog.visibility=20 m,50 m"], tmp_path)


def test_a_value_that_does_not_fit_the_scene_leaves_the_folder_as_it_was(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    with pytest.raises(UserError, match="above the whole scene"):
        write(out, ["flood.level=10 cm,90 m"], tmp_path)
    assert not list(out.iterdir())
