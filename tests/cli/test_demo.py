"""A small demo: its files, its output, and resuming after an interrupt."""

import functools
import json

import numpy as np
import pytest
from PIL import Image
from support.command_line import FEW_ROWS

from climatenerf import cli
from climatenerf.cli import demo


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Small grids and reduced photos give a blurred street in seconds."""
    from climatenerf.cli import fit as cli_fit
    from climatenerf.training import run as run_module
    from climatenerf.training.settings import FitSettings

    settings = functools.partial(FitSettings, samples_per_step=2**14, size=FEW_ROWS)
    monkeypatch.setattr(cli_fit, "settings_of", lambda preset, device: settings(preset=preset))
    monkeypatch.setattr(run_module, "PREVIEW_WIDTH", 64)
    monkeypatch.setattr(demo, "Fit", functools.partial(demo.Fit, downscale=6, steps=250))


@pytest.mark.slow
def test_the_demo_writes_four_movies_and_a_contact_sheet(tmp_path, capsys):
    out = tmp_path / "demo"
    # The number of steps ends the fit, independent of the speed of the machine.
    args = ["demo", "-o", str(out), "--frames", "2", "--size", "64x36", "--minutes", "60"]
    assert cli.main(args) == 0
    printed = capsys.readouterr().out
    assert "held-out PSNR" in printed and str(out / "contact-sheet.jpg") in printed
    shows = {"flood": "water_share", "snow": "snow_share", "smog": "mean_transmittance"}
    for name in ("clean", *shows):
        assert str(out / name / "movie.mp4") in printed
        assert (out / name / "movie.mp4").stat().st_size > 500
        frames = json.loads((out / name / "movie.json").read_text())["frames"]
        assert len(frames) == 2
        moved = np.array(frames[1]["c2w_world"]) - np.array(frames[0]["c2w_world"])
        assert np.abs(moved[:3, 3]).max() > 0.1, "the camera moves"
        for frame in frames:
            got = frame["measured"]
            assert (got["water_share"] > 0.02) == (name == "flood"), name
            assert (got["snow_share"] > 0.02) == (name == "snow"), name
            assert (got["mean_transmittance"] < 0.95) == (name == "smog"), name
    assert Image.open(out / "contact-sheet.jpg").size[0] >= 2 * 64
    written = (out / "flood" / "movie.mp4").stat().st_mtime_ns
    assert cli.main(args) == 0, "the same command resumes"
    assert "Continuing the run" in capsys.readouterr().err
    assert (out / "flood" / "movie.mp4").stat().st_mtime_ns == written, "nothing is rendered again"
    (out / "run" / "optimiser.safetensors").unlink()  # documented values
    assert cli.main(args) == 0


def test_ctrl_c_during_the_fit_prints_how_to_resume(tmp_path, capsys, monkeypatch):
    from climatenerf.training.trainer import Trainer

    step = Trainer.step

    def stopped(self, batch):
        if self.steps == 3:
            raise KeyboardInterrupt
        return step(self, batch)

    monkeypatch.setattr(Trainer, "step", stopped)
    assert cli.main(["demo", "-o", str(tmp_path / "demo"), "--size", "64x36"]) == 2
    assert "re-run the same command to resume" in capsys.readouterr().err
    assert (tmp_path / "demo" / "run" / "field.safetensors").exists()
    assert not (tmp_path / "demo" / "clean").exists()
