"""A fitted run for all tests of the command line."""

import functools
import os

import pytest
from filelock import FileLock
from support.command_line import FEW_ROWS, STREET

from climatenerf import cli


@pytest.fixture(scope="session")
def run_folder(tmp_path_factory):
    """A short fit with small grids and small steps: a blurred street with some haze.

    The first process of the tests that needs it makes it for all.
    """
    shared = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        shared = shared.parent
    folder = shared / "street-run" / "run"
    with FileLock(shared / "street-run.lock"):
        if not (folder.parent / "done").exists():
            make_run(folder)
            (folder.parent / "done").touch()
    return folder


def make_run(folder):
    from climatenerf.cli import fit as cli_fit
    from climatenerf.training import run as run_module
    from climatenerf.training.settings import FitSettings

    settings = functools.partial(FitSettings, samples_per_step=2**14, size=FEW_ROWS)
    args = ["fit", str(STREET), "-o", str(folder), "--steps", "300", "--downscale", "6"]
    args += ["--loss", "classes=0"]  # some refuse a run without classes
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cli_fit, "settings_of", lambda preset, device: settings(preset=preset))
        patch.setattr(run_module, "PREVIEW_WIDTH", 64)
        assert cli.main(args) == 0
