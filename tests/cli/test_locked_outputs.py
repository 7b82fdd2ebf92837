"""Two processes never write into one folder at once."""

import types
from pathlib import Path

import pytest
from support.command_line import error_message
from support.processes import holder

import climatenerf
import climatenerf.api
from climatenerf.cli import main
from climatenerf.evaluation import evaluated_run, scores
from climatenerf.output import score_report
from climatenerf.scene import load_scene
from climatenerf.training import folder as run_folder

STREET = Path(climatenerf.__file__).parent / "assets" / "street"
REFERENCE = Path(__file__).resolve().parents[2] / "reference" / "street"


def test_export_waits_for_no_other_writer(tmp_path, capsys):
    out = tmp_path / "out"
    with holder(out):
        said = error_message(capsys, "export", STREET, "-o", out)
        assert f"another process is writing into {out}" in said
        assert not (out / "transforms.json").exists()
    assert main(["export", str(STREET), "-o", str(out)]) == 0
    assert (out / "transforms.json").exists()


def test_an_ablation_waits_for_no_other_writer(tmp_path, capsys):
    out = tmp_path / "out"
    with holder(out):
        said = error_message(capsys, "evaluate", REFERENCE, "--ablation", "geometry", "-o", out)
        assert f"another process is writing into {out}" in said and not (out / "runs").exists()


@pytest.fixture
def quick_scores(monkeypatch):
    """Replace the run and its scores."""
    run = types.SimpleNamespace(field=None, style=None, scene=load_scene(REFERENCE))
    found = types.SimpleNamespace(table=[], pictures={})
    monkeypatch.setattr(climatenerf.api, "load_run", lambda path: run)
    monkeypatch.setattr(run_folder, "check_config", lambda path: {})
    monkeypatch.setattr(evaluated_run, "EvaluatedRun", lambda *parts: None)
    monkeypatch.setattr(evaluated_run, "check_views", lambda *parts: None)
    monkeypatch.setattr(scores, "evaluate", lambda run, told: found)
    monkeypatch.setattr(score_report, "write_report", lambda found, run, out, old: out.mkdir())


def test_an_evaluation_waits_for_no_other_writer(tmp_path, capsys, quick_scores):
    out = tmp_path / "out"
    with holder(out):
        said = error_message(capsys, "evaluate", tmp_path, "--reference", "-o", out)
        assert f"another process is writing into {out}" in said
