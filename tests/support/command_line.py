"""Run the command line in this process, and the embedded street as input."""

from importlib.resources import files
from pathlib import Path

from climatenerf import cli

STREET = Path(str(files("climatenerf") / "assets" / "street"))


def run_cli(*words: object) -> int:
    """Run `climatenerf` with these words and return the exit status."""
    try:
        return cli.main([str(word) for word in words])
    except SystemExit as exit_:
        return int(exit_.code or 0)
