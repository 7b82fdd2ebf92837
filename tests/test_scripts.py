"""Benchmarks, examples and the street's generator, as far as it shows without running them."""

import builtins
import dis
import types
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
GLOBALS = ("LOAD_GLOBAL", "LOAD_NAME")


def codes(code):
    """A code object and all within it."""
    yield code
    for inner in code.co_consts:
        if isinstance(inner, types.CodeType):
            yield from codes(inner)


def stored(code):
    """Names that a module or a class body gives to something."""
    return {i.argval for i in dis.get_instructions(code) if i.opname == "STORE_NAME"}


@pytest.mark.parametrize("folder", ["benchmarks", "examples", "tools", "tools/reference_street"])
def test_scripts_use_no_name_that_is_nowhere(folder):
    """Ruff cannot tell: shapes in annotations are such names by design."""
    for path in sorted((ROOT / folder).glob("*.py")):
        module = compile(path.read_text(), str(path), "exec")
        known = {*dir(builtins), "__file__", "__annotations__", *stored(module)}
        for code in codes(module):
            used = {i.argval for i in dis.get_instructions(code) if i.opname in GLOBALS}
            assert used <= known | stored(code), f"{path.name}: {used - known - stored(code)}"
