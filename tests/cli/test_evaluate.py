"""`climatenerf evaluate`: a whole report of a short fit, and refused input."""

import dataclasses
import functools
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from climatenerf import cli
from climatenerf.core.errors import UserError
from climatenerf.core.storage import write_json
from climatenerf.output.score_report import check_folder

REFERENCE = Path(__file__).resolve().parents[2] / "reference" / "street"


def error_of(capsys, *args):
    capsys.readouterr()
    assert cli.main([str(arg) for arg in args]) == 2
    err = capsys.readouterr().err
    assert "Traceback" not in err
    return err


def test_evaluation_requires_a_reference(capsys, tmp_path):
    assert "--reference" in error_of(capsys, "evaluate", tmp_path, "-o", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_an_ablation_requires_a_reference_set(capsys, tmp_path, monkeypatch):
    args = ["evaluate", REFERENCE, "--ablation", "geometry", "-o", tmp_path / "out"]
    assert "above 0" in error_of(capsys, *args, "--minutes", "0")
    assert "excludes --reference; leave out one" in error_of(capsys, *args, "--reference")
    assert "no row 'sun'; choose from: plain NGP" in error_of(capsys, *args, "--rows", "sun")
    assert "--rows" in error_of(capsys, "evaluate", REFERENCE, "--rows", "full", "-o", tmp_path)
    street = REFERENCE.parents[1] / "src/climatenerf/assets/street"
    err = error_of(capsys, "evaluate", street, "--ablation", "geometry", "-o", tmp_path / "out")
    assert "reference" in err and not (tmp_path / "out").exists()
    err = error_of(capsys, *args[:-1], REFERENCE / "truth")
    assert "lies in the reference set" in err


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--ablation", "flood", "--minutes", "2"], "--minutes belongs to --ablation geometry"),
        (["--ablation", "snow", "--views", "t01"], "--views belongs to --reference"),
        (
            ["--sweep", "flood.level=1 m,2 m", "--ablation", "snow"],
            "--ablation snow excludes --sweep",
        ),
        (["--reference", "--view", "t01"], "--view belongs to --ablation flood and"),
        (["--ablation", "fire"], "--ablation"),
        (["--sweep", "flood.level=1 m"], "from 2 to 20 values"),
        (["--sweep", "flood.depht=1 m,2 m"], "names no weather flag"),
        (["--sweep", "flood.level=1 m,2 m", "--size", "4x4"], "--size must be"),
        (["--ablation", "flood", "--weather", "absent.toml"], "absent.toml"),
    ],
)
def test_flags_of_another_evaluation_and_wrong_values_are_refused(capsys, tmp_path, flags, message):
    err = error_of(capsys, "evaluate", tmp_path, *flags, "-o", tmp_path / "out")
    assert message in err and not (tmp_path / "out").exists()


def test_a_study_never_writes_over_other_files_nor_among_photos(capsys, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "full.png").write_bytes(b"mine")
    err = error_of(capsys, "evaluate", tmp_path, "--ablation", "flood", "-o", out)
    assert "full.png would be overwritten" in err and (out / "full.png").read_bytes() == b"mine"
    (out / "flood.level.jpg").write_bytes(b"mine")
    sweep = ["--sweep", "flood.level=1 m,2 m"]
    assert "flood.level.jpg would be" in error_of(capsys, "evaluate", tmp_path, *sweep, "-o", out)


def test_the_weather_of_an_ablation_must_have_its_effect(tmp_path):
    from support.study_yard import yard_place

    from climatenerf.studies.weather_ablation import STUDIES, shot_of
    from climatenerf.weather.snow.parameters import Snow
    from climatenerf.weather.weather import Weather

    snow, place = Weather(snow=Snow(depth=0.1)), yard_place(tmp_path)
    with pytest.raises(UserError, match="has no flood.level; add it"):
        shot_of(STUDIES["flood"], place, None, None, snow)
    shot = shot_of(STUDIES["snow"], place, "1.jpg", (48, 30), snow)
    assert shot.view == "1.jpg" and (shot.camera.width, shot.camera.height) == (48, 30)
    assert shot.weather == snow and shot.truth is None
    assert shot_of(STUDIES["flood"], place, None, None, None).weather.flood.level == 0.5


def test_a_reference_run_is_compared_with_its_truth():
    """The test view, weather and moment are the reference set's, unless others are asked for."""
    from support.study_yard import FIELD

    from climatenerf.scene import read_scene
    from climatenerf.studies.shot import Place
    from climatenerf.studies.weather_ablation import STUDIES, about_shot, shot_of
    from climatenerf.weather.weather import Weather

    place = Place(FIELD, read_scene(REFERENCE))
    shot = shot_of(STUDIES["flood"], place, None, None, None)
    assert shot.truth is not None and shot.view == "t01.jpg" and shot.time == 1.0
    assert shot.weather.flood.level == 0.6 and shot.weather.seed == 7
    picture = shot.truth.picture()
    assert picture.shape == (216, 384, 3) and 0 <= picture.min() < picture.max() <= 1
    water = shot.truth.water()
    # Water lies below the horizon, and reflects less than the sky above it shows.
    assert 0.3 < water.mean() < 0.8 and not water[:40].any()
    assert about_shot(shot, None)["truth"] == "flood-waves"
    snow = shot_of(STUDIES["snow"], place, "t04", None, None)
    assert snow.truth is not None and snow.view == "t04.jpg" and 0.2 < snow.truth.snow().mean() < 1
    own = Weather(flood=shot.weather.flood)
    for view, size, weather in (("0001", None, None), ("t01", (96, 54), None), ("t01", None, own)):
        assert shot_of(STUDIES["flood"], place, view, size, weather).truth is None


def test_a_folder_without_a_run_is_refused(capsys, tmp_path):
    err = error_of(capsys, "evaluate", tmp_path, "--reference", "-o", tmp_path / "out")
    assert str(tmp_path) in err and not (tmp_path / "out").exists()


def test_a_report_replaces_an_earlier_report_and_no_other_file(tmp_path):
    check_folder(tmp_path / "new" / "report", ["clean"])
    assert not (tmp_path / "new" / "report").exists(), "the check leaves no folder"
    other = tmp_path / "other"
    other.mkdir()
    (other / "clean.jpg").write_bytes(b"mine")
    with pytest.raises(UserError, match="overwritten"):
        check_folder(other, ["clean"])
    write_json(other / "report.json", {"mine": 1})
    with pytest.raises(UserError, match="no report"):
        check_folder(other, ["clean"])
    write_json(other / "report.json", {"scores": {}, "pictures": ["haze.jpg"]})
    (other / "haze.jpg").write_bytes(b"old")
    with pytest.raises(UserError, match="overwritten"):
        check_folder(other, ["clean"])
    assert (other / "clean.jpg").read_bytes() == b"mine" and (other / "haze.jpg").exists()
    (other / "clean.jpg").unlink()
    assert "haze.jpg" in check_folder(other, ["clean"]), "`write_report` deletes it"
    assert (other / "haze.jpg").exists()


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    """Fit the reference street for 400 small steps with small grids."""
    from climatenerf.cli import fit as cli_fit
    from climatenerf.field.presets import PRESETS
    from climatenerf.training import run as run_module
    from climatenerf.training.settings import FitSettings

    folder = tmp_path_factory.mktemp("reference") / "run"
    small = dataclasses.replace(
        PRESETS["cpu"], geometry_log2_rows=14, appearance_log2_rows=14, cascades=4
    )
    settings = functools.partial(FitSettings, samples_per_step=2**14, size=small)
    args = ["fit", str(REFERENCE), "-o", str(folder), "--steps", "400", "--downscale", "4"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cli_fit, "settings_of", lambda preset, device: settings(preset=preset))
        patch.setattr(run_module, "PREVIEW_WIDTH", 64)
        assert cli.main(args) == 0
    return folder


@pytest.mark.slow
def test_a_report_has_all_scores_and_pictures(run_folder, tmp_path, capsys):
    out = tmp_path / "report"
    names = ["smog-mid", "flood-low", "snow-deep"]
    args = ["evaluate", str(run_folder), "--reference", "-o", str(out), "--views", "t04"]
    assert cli.main([*args, "--weathers", *names]) == 0
    table = capsys.readouterr().out
    assert "screen-reflection" in table and "report.md" in table
    report = json.loads((out / "report.json").read_text())
    assert report["scores"]["clean"] == report["clean"]
    # The fit is blurred, but better than a grey picture.
    assert 12 < report["clean"]["psnr"] < 40 and 0 < report["clean"]["ssim"] < 1
    geometry = report["geometry"]
    assert 0 < geometry["depth_abs_rel"] < 0.6 and 0 < geometry["depth_rmse_m"] < 30
    assert 0 < geometry["normal_ground_roof_median_deg"] < 80
    assert 0 <= geometry["floater_mass"] < 0.9 and 0 <= geometry["sky_empty_fraction"] <= 1
    assert 0.2 < report["labels"]["miou"] < 1
    assert set(report["weather"]) == set(names)
    for name in names:
        # So short a fit is hazy and holds little snow: 7 dB.
        assert 5 < report["weather"][name]["psnr"] < 40
        with Image.open(out / f"{name}.jpg") as picture:
            assert picture.width > 3 * 300
    assert 0 < report["weather"]["smog-mid"]["transmittance_error"] < 0.3
    assert report["weather"]["flood-low"]["water_iou"] > 0.7
    assert report["weather"]["flood-low"]["waterline_error_px"] < 40
    assert report["frame"] == {"scale": pytest.approx(1), "up_deg": 0.0, "datum_cm": 0.0}
    assert report["weather"]["snow-deep"]["true_thickness_cm"] == pytest.approx(15, abs=2)
    baselines = report["baselines"]
    assert set(baselines["frame-noise"]) == set(names)
    assert set(baselines["screen-reflection"]) == set(baselines["flat-plane"]) == {"flood-low"}
    assert set(baselines["depth-fog"]) == {"smog-mid"}
    assert set(baselines["white-paint"]) == {"snow-deep"}
    warped = report["consistency"]
    assert warped["clean"]["next"] < warped["clean"]["far"]
    assert warped["baselines"]["frame-noise"]["smog"]["next"] > 1.5 * warped["smog"]["next"]
    assert np.isfinite(report["completeness"]["mirror_psnr"])
    # The message names the unknown weather.
    assert "flood-low" in error_of(capsys, *args, "--weathers", "flod-low")


@pytest.mark.slow
def test_the_flood_is_ablated_beside_the_truth(run_folder, tmp_path, capsys):
    out = tmp_path / "out"
    args = ["evaluate", run_folder, "--ablation", "flood", "-o", out]
    assert cli.main([str(arg) for arg in args]) == 0
    assert "tilted plane: tilt" in capsys.readouterr().out
    data = json.loads((out / "ablation.json").read_text())
    assert data["truth"] == "flood-waves" and data["view"] == "t01.jpg"
    assert data["weather"]["flood"]["level"] == "0.6 m" and data["size"] == [384, 216]
    rows = {row["name"]: row for row in data["rows"]}
    assert all(5 < row["metrics"]["psnr_water_db"] < 40 for row in rows.values())
    # The plane and the waves do not depend on how good a fit is.
    assert rows["tilted plane"]["shown"] and rows["no waves"]["shown"]
    assert rows["tilted plane"]["metrics"]["tilt_deg"] == pytest.approx(1.457, abs=0.02)


@pytest.mark.slow
def test_a_run_without_a_reference_set_is_refused(run_folder, tmp_path, capsys):
    other = tmp_path / "run"
    other.mkdir()
    for path in run_folder.iterdir():
        if path.is_file():
            (other / path.name).write_bytes(path.read_bytes())
    data = json.loads((other / "scene.json").read_text())
    capture = tmp_path / "capture"
    (capture / "images").mkdir(parents=True)
    for view in data["views"]:
        (capture / view["path"]).write_bytes(b"")
    data["root_absolute"], data["root"] = str(capture), str(capture)
    (other / "scene.json").write_text(json.dumps(data))
    err = error_of(capsys, "evaluate", other, "--reference", "-o", tmp_path / "out")
    assert "no reference set" in err and not (tmp_path / "out").exists()
