"""The wheel contains the whole package and starts in an otherwise empty environment."""

import shutil
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest

import climatenerf

ROOT = Path(__file__).parents[1]

pytestmark = pytest.mark.slow


def pip(*args):
    done = subprocess.run(
        [sys.executable, "-m", "pip", "--disable-pip-version-check", *map(str, args)],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_version_is_printed_from_the_wheel_in_an_empty_environment(tmp_path):
    source = tmp_path / "source"
    shutil.copytree(
        ROOT / "src", source / "src", ignore=shutil.ignore_patterns("*.egg-info", "__pycache__")
    )
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    pip("wheel", "--no-deps", "--no-index", "--no-build-isolation", "-w", tmp_path, source)
    (wheel,) = tmp_path.glob("*.whl")

    packed = set(zipfile.ZipFile(wheel).namelist())
    package = source / "src" / "climatenerf"
    files = {p.relative_to(source / "src").as_posix() for p in package.rglob("*") if p.is_file()}
    assert files <= packed, "a file of the package is not in the wheel"

    empty = tmp_path / "empty"
    venv.create(empty)
    scripts = empty / ("Scripts" if sys.platform == "win32" else "bin")
    pip("--python", scripts / "python", "install", "--no-deps", "--no-index", wheel)
    environment = {"PATH": str(scripts), "PYTHONNOUSERSITE": "1"}
    for args in (["climatenerf"], ["python", "-m", "climatenerf"]):
        command = [str(scripts / args[0]), *args[1:], "--version"]
        done = subprocess.run(command, capture_output=True, text=True, env=environment)
        assert done.stdout == f"climatenerf {climatenerf.__version__}\n", done.stderr
