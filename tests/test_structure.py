"""Dependencies point one way, and every tensor is created on a device that the code names."""

import ast
from pathlib import Path

import climatenerf

ROOT = Path(climatenerf.__file__).parent
REPOSITORY = Path(__file__).parents[1]
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
    "verification": BELOW_RENDER | {"render"},
    "training": BELOW_TRAINING,
    "styling": BELOW_STUDIES,
    "studies": BELOW_STUDIES | {"styling"},
    "cluster": BELOW_STUDIES,
    "page": BELOW_STUDIES | {"studies"},
    "viewer": BELOW_STUDIES | {"studies", "page", "api"},
    "extend": BELOW_RENDER,
    "api": BELOW_STUDIES | {"studies", "styling", "sfm", "perception", "cluster"},
    "cli": BELOW_STUDIES
    | {
        "studies",
        "styling",
        "sfm",
        "perception",
        "cluster",
        "page",
        "viewer",
        "verification",
        "api",
    },
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


CREATORS = {
    "Generator",
    "arange",
    "as_tensor",
    "empty",
    "eye",
    "full",
    "linspace",
    "logspace",
    "normal",
    "ones",
    "rand",
    "randint",
    "randn",
    "randperm",
    "scalar_tensor",
    "tensor",
    "zeros",
}
"""Functions of torch that create on the default device unless they are given one."""


def torch_name(node: ast.expr) -> str:
    """The NAME of an expression `torch.NAME`; empty for others."""
    if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "torch":
        return node.attr
    return ""


def unnamed_devices(tree: ast.AST) -> set[int]:
    """The lines of calls that create a tensor without naming its device."""
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    creating = [call for call in calls if torch_name(call.func) in CREATORS]
    return {c.lineno for c in creating if all(word.arg != "device" for word in c.keywords)}


def default_devices(tree: ast.AST) -> set[int]:
    """The lines that set or ask for torch's default device."""
    lines = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and node.attr.endswith("et_default_device"):
            lines.add(node.lineno)
        if isinstance(node, ast.With):
            for context in (item.context_expr for item in node.items):
                if isinstance(context, ast.Call) and torch_name(context.func) == "device":
                    lines.add(node.lineno)
                if ast.unparse(context).split(".")[-1] == "device":
                    lines.add(node.lineno)
    return lines


def test_every_tensor_is_created_on_a_device_that_the_code_names():
    wrong = []
    for path in sorted(ROOT.rglob("*.py")):
        lines = unnamed_devices(ast.parse(path.read_text()))
        wrong += [f"{path.relative_to(ROOT)}:{line}" for line in sorted(lines)]
    assert not wrong, wrong
    given = "torch.zeros(3)\ntorch.zeros(3, device=x.device)\ntorch.zeros_like(x)"
    assert unnamed_devices(ast.parse(given)) == {1}


def test_nothing_depends_on_the_default_device():
    wrong = []
    for folder in (ROOT, *(REPOSITORY / name for name in ("tests", "benchmarks", "tools"))):
        for path in sorted(folder.rglob("*.py")):
            lines = default_devices(ast.parse(path.read_text()))
            wrong += [f"{path}:{line}" for line in sorted(lines)]
    assert not wrong, wrong
    given = "with torch.device('cuda'): pass\nwith x.device: pass\ntorch.get_default_device()"
    assert default_devices(ast.parse(given)) == {1, 2, 3}


def test_rendering_knows_no_single_effect():
    """Effects come from the registry; only `weather` imports the package of one."""
    packages = {path.parent.name for path in ROOT.glob("weather/*/parameters.py")}
    wrong = []
    for part in ("render", "field", "ops", "output"):
        for path in sorted((ROOT / part).rglob("*.py")):
            for imported in imports(path):
                if imported.startswith("climatenerf.weather.") and (
                    imported.split(".")[2] in packages
                ):
                    wrong.append(f"{path.relative_to(ROOT)} imports {imported}")
    assert packages >= {"flood", "smog", "snow"} and not wrong, wrong
