"""`climatenerf verify`: the table, JSON, exit status, and a user's own run."""

import dataclasses
import json
import math

import numpy as np
import pytest
from support.command_line import error_message, run_cli

import climatenerf
from climatenerf.cli import verify
from climatenerf.field.checkpoint import FILE_NAME, load_field
from climatenerf.scene import load_scene
from climatenerf.verification import own_run, suite
from climatenerf.verification.check import Check
from climatenerf.verification.setting import Viewpoint
from climatenerf.weather.snow import layer as snow
from climatenerf.weather.snow.lattice import choose_grid

GOOD = Check("smog visibility", "contrast with 0.05", 0.25, 1.5, "%", "WMO-No. 8")
BAD = Check("mirror image", "water with a picture", 0.02, 0.01, "1", "law of reflection")
INFORMATION = Check("run snow depth", "snow with 15 cm", math.nan, None, "%", "definition")


@pytest.fixture
def finding(monkeypatch):
    """Sets what the checks of the program find."""

    def set_checks(*checks):
        topics = {"topic": lambda device: iter(checks)}
        monkeypatch.setattr(suite, "TOPICS", topics)

    return set_checks


def test_verdicts():
    assert GOOD.passed and GOOD.verdict == "pass"
    assert not BAD.passed and BAD.verdict == "FAIL"
    assert INFORMATION.passed and INFORMATION.verdict == "info"
    unknown = Check("a", "b", math.nan, 1.0, "1", "c")
    assert unknown.verdict == "FAIL", "what cannot be measured does not pass"
    assert unknown.entry()["figure"] is None


def test_the_table_and_the_status_of_a_pass(finding, capsys):
    finding(GOOD, INFORMATION)
    assert run_cli("verify") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["check", "figure", "at", "most", "what", "is", "compared"]
    assert lines[1].split("  ")[0] == "smog visibility"
    assert "0.25 %" in lines[1] and "1.5 %" in lines[1] and " pass " in lines[1]
    assert "nan %" in lines[2] and " info " in lines[2]
    assert "1 of 1 checks passed" in lines
    for word in (f"climatenerf {climatenerf.__version__}", "Python 3", "numpy", "torch", "numba"):
        assert word in lines[-1]
    assert "device cpu" in lines[-1]


def test_a_failed_check_is_status_1(finding, capsys):
    finding(GOOD, BAD)
    assert run_cli("verify") == 1
    out = capsys.readouterr().out
    assert "FAIL" in out and "1 of 2 checks passed" in out


def test_json_is_all_of_the_output(finding, capsys):
    finding(GOOD, BAD, INFORMATION)
    assert run_cli("verify", "--json") == 1
    shown = capsys.readouterr()
    data = json.loads(shown.out)
    assert shown.err == "" and not data["passed"] and data["run"] is None
    assert data["provenance"]["climatenerf"] == climatenerf.__version__
    assert {"torch", "numpy", "numba", "Python", "on", "device"} <= set(data["provenance"])
    assert [each["verdict"] for each in data["checks"]] == ["pass", "FAIL", "info"]
    assert data["checks"][1]["threshold"] == 0.01 and data["checks"][2]["figure"] is None
    assert all(each["source"] for each in data["checks"])


def test_wrong_input_is_one_sentence(finding, capsys, tmp_path, run_folder):
    finding(GOOD)
    assert "does not exist" in error_message(capsys, "verify", tmp_path / "none")
    assert "holds no field.safetensors" in error_message(capsys, "verify", tmp_path)
    for name in (FILE_NAME, "config.json", "scene.json"):
        (tmp_path / name).write_bytes((run_folder / name).read_bytes())
    (tmp_path / FILE_NAME).write_bytes(b"no field")
    assert FILE_NAME in error_message(capsys, "verify", tmp_path)
    assert run_cli("verify", "--device", "abacus") == 2


@pytest.mark.slow
def test_a_run_is_checked_as_well(finding, capsys, run_folder, monkeypatch):
    finding(GOOD)
    # A small square of snow: that of the whole street takes half a minute.
    monkeypatch.setattr(
        snow,
        "choose_grid",
        lambda *bounds: dataclasses.replace(choose_grid(*bounds), half_cells=64, cascades=1),
    )
    status = run_cli("verify", run_folder, "--json")
    data = json.loads(capsys.readouterr().out)
    assert status == 0, [each for each in data["checks"] if each["verdict"] == "FAIL"]
    assert data["run"] == str(run_folder)
    names = [each["name"] for each in data["checks"]]
    assert names[0] == GOOD.name and all(name.startswith("run ") for name in names[1:])
    assert len(names) == 13
    verdicts = {each["name"]: each["verdict"] for each in data["checks"]}
    assert verdicts["run snow depth"] == "info"


def test_a_run_with_numbers_that_are_not_finite_fails(run_folder):
    field, scene = load_field(run_folder), load_scene(run_folder)
    field.embeddings.data.view(-1)[0] = math.nan
    first = next(own_run.checks(field, scene, Viewpoint(scene.cameras[0], scene.views[0].c2w)))
    assert first.name == "run files" and first.figure == 1 and not first.passed


def test_the_table_is_aligned():
    lines = verify.table([GOOD, BAD]).splitlines()
    assert lines[0].index("figure") == lines[1].index("0.25 %") == lines[2].index("0.02")
    assert lines[0].index("what") == lines[1].index("contrast") == lines[2].index("water")


def test_only_pixels_with_a_single_surface_are_judged(run_folder):
    """Fog has no depth at which the formula of smog could be evaluated."""
    field, scene = load_field(run_folder), load_scene(run_folder)
    camera = scene.cameras[0].resized(24, 16)
    viewpoint = Viewpoint(camera, scene.views[0].c2w)
    none = own_run.single_surface(field, viewpoint, 0.0)
    some = own_run.single_surface(field, viewpoint, 100.0)
    assert none.shape == some.shape == (16, 24) and not none.any() and some.any()
    dried = [np.full((16, 24), 1.0), np.zeros((16, 24))]
    assert own_run.nested(dried, some).figure == some.sum()
    fog = own_run.nested(dried, none)
    assert fog.verdict == "info" and math.isnan(fog.figure)
