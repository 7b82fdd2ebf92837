"""Static checks of benchmarks, examples and tools, which the tests do not run."""

import builtins
import dis
import types
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
GLOBALS = ("LOAD_GLOBAL", "LOAD_NAME")


def code_objects(code):
    """Yield a code object and all that it contains."""
    yield code
    for inner in code.co_consts:
        if isinstance(inner, types.CodeType):
            yield from code_objects(inner)


def bound_names(code):
    """Return the names that a module or class body binds."""
    return {i.argval for i in dis.get_instructions(code) if i.opname == "STORE_NAME"}


@pytest.mark.parametrize("folder", ["benchmarks", "examples", "tools", "tools/reference_street"])
def test_scripts_use_defined_names_only(folder):
    """Ruff's check of undefined names is off: shapes in annotations look like such names."""
    for path in sorted((ROOT / folder).glob("*.py")):
        module = compile(path.read_text(), str(path), "exec")
        defined = {*dir(builtins), "__file__", "__annotations__", *bound_names(module)}
        for code in code_objects(module):
            used = {i.argval for i in dis.get_instructions(code) if i.opname in GLOBALS}
            assert used <= defined | bound_names(code), f"{path.name}: {used - defined}"
