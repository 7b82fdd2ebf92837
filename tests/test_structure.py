"""Dependencies point one way. What stands in a row may import what its row names, nothing else."""

import ast
from pathlib import Path

import climatenerf

ROOT = Path(climatenerf.__file__).parent
BASE = {"errors", "storage", "climatenerf"}
# `samples` is render/samples.py: the record in which fields and snow hand their samples over.
MAY_IMPORT = {
    "errors": set(),
    "storage": {"errors"},
    "samples": set(),
    "ops": set(),
    "scene": BASE,
    "sfm": BASE | {"scene"},
    "perception": BASE | {"scene"},
    "evaluation": BASE | {"scene", "field", "weather", "render", "ops", "samples"},
    "field": BASE | {"scene", "ops", "samples"},
    "weather": BASE | {"ops", "samples"},
    "render": BASE | {"scene", "field", "weather", "ops", "samples"},
    "training": BASE | {"evaluation", "render", "scene", "field", "ops", "samples"},
    "cli": BASE
    | {"training", "evaluation", "render", "weather", "field", "scene", "sfm", "perception"},
    "__main__": {"cli"},
    "climatenerf": set(),
}


def part_of(module: str) -> str:
    words = module.split(".")
    return "samples" if module == "climatenerf.render.samples" else words[min(1, len(words) - 1)]


def imports(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found.add(node.module or "")
    return {name for name in found if name.split(".")[0] == "climatenerf"}


def test_dependencies_point_one_way():
    wrong = []
    for path in sorted(ROOT.rglob("*.py")):
        name = ".".join(["climatenerf", *path.relative_to(ROOT).with_suffix("").parts])
        own = part_of(name.removesuffix(".__init__"))
        for imported in imports(path):
            if part_of(imported) not in MAY_IMPORT[own] | {own}:
                wrong.append(f"{name} imports {imported}")
    assert not wrong, wrong
