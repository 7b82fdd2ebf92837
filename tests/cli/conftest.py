"""A fitted run for all tests of the command line."""

import functools

import pytest
from support.command_line import FEW_ROWS, STREET

from climatenerf import cli


@pytest.fixture(scope="session")
def run_folder(tmp_path_factory):
    """A short fit with small grids and small steps: a blurred street with some haze."""
    from climatenerf.cli import fit as cli_fit
    from climatenerf.training import run as run_module
    from climatenerf.training.settings import FitSettings

    folder = tmp_path_factory.mktemp("street") / "run"
    settings = functools.partial(FitSettings, samples_per_step=2**14, size=FEW_ROWS)
    args = ["fit", str(STREET), "-o", str(folder), "--steps", "300", "--downscale", "6"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cli_fit, "settings_of", lambda preset, device: settings(preset=preset))
        patch.setattr(run_module, "PREVIEW_WIDTH", 64)
        assert cli.main(args) == 0
    return folder
