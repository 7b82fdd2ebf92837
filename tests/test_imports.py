"""Help and input errors do not import slow packages."""

import subprocess
import sys

import pytest

SLOW = {"torch", "numba", "mitsuba", "scipy", "distributed", "dask"}


@pytest.mark.parametrize(
    "modules",
    [
        "climatenerf",
        "climatenerf.scene",
        "climatenerf.weather.registry climatenerf.weather.units climatenerf.weather.description",
        "climatenerf.cli.fit climatenerf.cli.render climatenerf.cli.verify climatenerf.cli.demo"
        " climatenerf.cli.study climatenerf.cli.compare climatenerf.cli.stylize"
        " climatenerf.cli.batch",
        "climatenerf.core.storage climatenerf.field.presets climatenerf.evaluation.metrics",
    ],
)
def test_these_modules_import_no_slow_package(modules):
    code = f"import sys, {', '.join(modules.split())}\nprint(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not SLOW & set(done.stdout.split())
