"""Fixtures shared by all tests."""

import os
from pathlib import Path

import pytest

from climatenerf.cli import THREADING

# Before any test imports torch: without it two OpenMP run times spin against each other.
for variable, value in THREADING.items():
    os.environ.setdefault(variable, value)

CAPTURES = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def captures() -> Path:
    """Folder of real photo captures; they are not part of the project."""
    if not CAPTURES.is_dir():
        pytest.skip("needs the real captures (folder ../shared/data beside the checkout)")
    return CAPTURES
