"""Dependencies point one way: a part imports only the parts of its row, without exemption."""

import ast
from pathlib import Path

import climatenerf

ROOT = Path(climatenerf.__file__).parent
BELOW_RENDER = {"climatenerf", "core", "ops", "field", "weather", "scene"}
BELOW_TRAINING = BELOW_RENDER | {"render", "paths", "evaluation"}
BELOW_STUDIES = BELOW_TRAINING | {"training", "output"}
MAY_IMPORT = {
    "climatenerf": set(),
    "core": {"climatenerf"},
    "scene": {"climatenerf", "core"},
    "sfm": {"climatenerf", "core", "scene"},
    "perception": {"climatenerf", "core", "scene"},
    "paths": {"climatenerf", "core", "scene"},
    "ops": {"core"},
    "field": {"climatenerf", "core", "ops"},
    "weather": {"climatenerf", "core", "ops", "field", "scene"},
    "render": BELOW_RENDER,
    "evaluation": BELOW_RENDER | {"render", "paths"},
    "output": BELOW_RENDER | {"render", "paths", "evaluation"},
    "training": BELOW_TRAINING,
    "studies": BELOW_STUDIES,
    "extend": BELOW_RENDER,
    "api": BELOW_STUDIES | {"studies", "sfm", "perception"},
    "cli": BELOW_STUDIES | {"studies", "sfm", "perception", "api"},
    "__main__": {"cli"},
}


def part_of(module: str) -> str:
    names = module.split(".")
    return names[min(1, len(names) - 1)]


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


def test_dependencies_have_no_cycle():
    """The table above has no cycle."""
    done: set[str] = set()
    while len(done) < len(MAY_IMPORT):
        free = [part for part, below in MAY_IMPORT.items() if part not in done and below <= done]
        assert free, set(MAY_IMPORT) - done
        done.update(free)
