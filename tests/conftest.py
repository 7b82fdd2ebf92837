"""Fixtures and settings shared by all tests."""

import os
from pathlib import Path

import pytest
from jaxtyping import install_import_hook
from support.shape_checks import MODULES

# Before any of these modules is imported.
install_import_hook(MODULES, "support.shape_checks.checked")

from climatenerf.cli import THREADING  # noqa: E402

# Before any test imports torch: without it two OpenMP run times spin against each other.
for variable, value in THREADING.items():
    os.environ.setdefault(variable, value)

CAPTURES = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def captures() -> Path:
    """Folder of real photo captures, which are not part of the project."""
    if not CAPTURES.is_dir():
        pytest.skip("needs the real captures (folder ../shared/data beside the checkout)")
    return CAPTURES
