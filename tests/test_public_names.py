"""The public names of the library."""

import ast
import inspect
import subprocess
import sys
from pathlib import Path

import pytest

import climatenerf

FUNCTIONS = ["evaluate", "fit", "load_run", "open_scene", "render_movie"]
CLASSES = ["Flood", "RenderSession", "Smog", "Snow", "Sun", "Weather"]

CAPABILITIES = {"APPEARANCE", "CLASSES", "DENSITY", "FUSED", "NORMALS", "OBSERVED"}
UNITS = {"ANGLE", "DURATION", "LENGTH", "PER_LENGTH", "SPEED", "number", "quantity", "triple"}
WORLD = {"Matter", "Medium", "Preparation", "RaySamples", "Samples", "Surface", "SurfaceHits"}
NEED_TORCH = {*WORLD, "BakedSnow", "World", "bake_snow", "device_of", "observed"}
DESCRIPTION = {"EFFECTS", "Effect", "Layer", "Measure", "UserError", "check_effects"}
EXTEND = CAPABILITIES | UNITS | NEED_TORCH | DESCRIPTION


def public(names):
    return [name for name in names if not name.startswith("__")]


def test_dir_lists_the_public_names_and_does_not_import_torch():
    code = (
        "import sys, climatenerf; from climatenerf import cli, core; names = dir(climatenerf);"
        "print(*names); climatenerf.Weather(flood=climatenerf.Flood(level=0.5));"
        "print(*sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    names, modules = done.stdout.splitlines()
    assert public(names.split()) == sorted([*FUNCTIONS, *CLASSES, "extend"])
    assert "__version__" in names.split()
    assert not {"torch", "numba", "scipy"} & set(modules.split())


def test_names_for_effects_are_listed_and_do_not_import_torch():
    code = (
        "import sys; from climatenerf import extend; print(*dir(extend));"
        "print(*(name for name in dir(extend) if name in vars(extend))); print(*sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    names, eager, modules = (set(line.split()) for line in done.stdout.splitlines())
    assert names == EXTEND
    assert names - eager == {name for name in EXTEND if name in NEED_TORCH}
    assert not {"torch", "numba", "scipy"} & modules


@pytest.mark.parametrize("name", sorted(EXTEND))
def test_each_name_for_effects_exists(name):
    assert getattr(climatenerf.extend, name) is not None


@pytest.mark.parametrize("name", FUNCTIONS + CLASSES)
def test_each_public_name_is_documented(name):
    found = getattr(climatenerf, name)
    assert inspect.getdoc(found)
    if name in FUNCTIONS:
        text = inspect.getdoc(found)
        assert all(f"{each}:" in text for each in inspect.signature(found).parameters if each)


def test_the_type_stub_lists_the_public_names():
    stub = ast.parse(Path(climatenerf.__file__).with_suffix(".pyi").read_text())
    names = [n.names[0].asname for n in stub.body if isinstance(n, ast.ImportFrom)]
    assert sorted(names) == sorted([*FUNCTIONS, *CLASSES, "extend"])


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'flood'"):
        climatenerf.flood  # noqa: B018
