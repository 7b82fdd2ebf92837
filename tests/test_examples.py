"""The examples of the library run unchanged and write the files that they name."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import climatenerf

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.mark.parametrize("name", ["01_fit_and_flood", "02_weather_file", "03_new_effect"])
def test_examples_use_public_names_only(name):
    tree = ast.parse((EXAMPLES / f"{name}.py").read_text())
    modules = {n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)}
    modules |= {a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names}
    assert {m for m in modules if m.startswith("climatenerf")} == {"climatenerf"}
    used = {
        n.attr
        for n in ast.walk(tree)
        if isinstance(n, ast.Attribute) and isinstance(n.value, ast.Name)
        if n.value.id == "climatenerf"
    }
    assert used <= set(dir(climatenerf))


@pytest.mark.slow
def test_examples_run_and_write_their_files(tmp_path):
    run = tmp_path / "run"
    printed = {}
    for name, arguments in (
        ("01_fit_and_flood", ["400", str(run)]),
        ("02_weather_file", [str(run)]),
        ("03_new_effect", [str(run)]),
    ):
        command = [sys.executable, str(EXAMPLES / f"{name}.py"), *arguments]
        done = subprocess.run(command, capture_output=True, text=True, timeout=1200)
        assert done.returncode == 0, done.stderr
        printed[name] = done.stdout
    assert (run / "flood" / "frames" / "0000.png").stat().st_size > 1000
    assert (run / "weather.jpg").stat().st_size > 1000
    assert (run / "ash" / "frames" / "0000.png").stat().st_size > 1000
    assert "water on 0%" not in printed["01_fit_and_flood"]
    assert printed["02_weather_file"].count("visibility") == 3
    assert "ash on 0%" not in printed["03_new_effect"]
