"""Fixtures and settings shared by all tests."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

# Processes of the tests share the cores: with threads for all cores each, they take twice as long.
# Set before torch and Numba are imported; programs that tests start inherit it.
PROCESSES = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
LIMITS = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS")
if PROCESSES > 1:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    for limit in LIMITS:
        os.environ.setdefault(limit, str(max(1, (cores or 1) // PROCESSES)))

from jaxtyping import install_import_hook  # noqa: E402
from support.shape_checks import MODULES  # noqa: E402

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


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run a test that is marked `all_cores` in a process of its own, if this one has fewer."""
    if PROCESSES == 1 or pyfuncitem.get_closest_marker("all_cores") is None:
        return None
    kept = {
        name: value
        for name, value in os.environ.items()
        if name not in LIMITS and not name.startswith("PYTEST_")
    }
    words = [sys.executable, "-m", "pytest", "-q", "-m", "", "-p", "no:cacheprovider"]
    done = subprocess.run(
        [*words, pyfuncitem.nodeid], cwd=pyfuncitem.config.rootpath, env=kept, capture_output=True
    )
    assert done.returncode == 0, done.stdout.decode()
    return True
