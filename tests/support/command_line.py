"""Run the command line in this process, and the embedded street as input."""

import dataclasses
from importlib.resources import files
from pathlib import Path

from climatenerf import cli
from climatenerf.field.presets import PRESETS

STREET = Path(str(files("climatenerf") / "assets" / "street"))
FEW_ROWS = dataclasses.replace(
    PRESETS["cpu"], geometry_log2_rows=13, appearance_log2_rows=13, cascades=4
)


def run_cli(*args: object) -> int:
    """Run `climatenerf` with arguments and return the exit status."""
    try:
        return cli.main([str(arg) for arg in args])
    except SystemExit as exit_:
        return int(exit_.code or 0)


def error_message(capsys, *args: object) -> str:
    """Return the message on standard error of a command that fails with status 2."""
    capsys.readouterr()
    assert run_cli(*args) == 2
    err = capsys.readouterr().err
    assert "Traceback" not in err
    lines = [line for line in err.splitlines() if line.startswith("climatenerf: ")]
    assert len(lines) == 1 and err.rstrip().endswith(lines[0]), err
    return lines[0]
