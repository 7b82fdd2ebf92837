"""What a user waits for before anything happens: help and errors in the input load no torch."""

import subprocess
import sys

import pytest

HEAVY = {"torch", "numba", "mitsuba", "scipy"}


@pytest.mark.parametrize(
    "modules",
    [
        "climatenerf",
        "climatenerf.scene",
        "climatenerf.weather.parameters climatenerf.weather.units climatenerf.weather.description",
        "climatenerf.cli.fit climatenerf.cli.render climatenerf.cli.demo",
        "climatenerf.core.storage climatenerf.field.presets climatenerf.evaluation.metrics",
    ],
)
def test_these_load_nothing_heavy(modules):
    code = f"import sys, {', '.join(modules.split())}\nprint(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not HEAVY & set(done.stdout.split())
