"""Fixtures and settings shared by all tests."""

import os
from pathlib import Path

import numba
import pytest
from jaxtyping import install_import_hook
from support.shape_checks import MODULES

# Before any of these modules is imported.
install_import_hook(MODULES, "support.shape_checks.checked")

from climatenerf.cli import THREADING  # noqa: E402

# Before any test imports torch: without it two OpenMP run times spin against each other.
for variable, value in THREADING.items():
    os.environ.setdefault(variable, value)

# Processes of the tests share the cores: with threads for all cores each, they take twice as long.
# The limit of Numba stays, since some tests compare one thread with all.
processes = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
if processes > 1:
    threads = max(1, numba.config.NUMBA_NUM_THREADS // processes)
    os.environ.setdefault("OMP_NUM_THREADS", str(threads))
    numba.set_num_threads(threads)

CAPTURES = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def captures() -> Path:
    """Folder of real photo captures, which are not part of the project."""
    if not CAPTURES.is_dir():
        pytest.skip("needs the real captures (folder ../shared/data beside the checkout)")
    return CAPTURES
