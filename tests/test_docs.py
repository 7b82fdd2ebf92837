"""The documentation is consistent with itself, with the command line and with the code."""

import os
import re
import shlex
import subprocess
import sys
import tomllib
from dataclasses import fields
from functools import cache
from pathlib import Path
from textwrap import dedent

import pytest

import climatenerf
from climatenerf.cli.batch import read_batch
from climatenerf.training.settings import Losses
from climatenerf.weather.description import read_weather

ROOT = Path(__file__).resolve().parents[1]
SOURCE = Path(climatenerf.__file__).parent
TOP = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")]
PAGES = [*(p for p in TOP if p.exists()), *sorted((ROOT / "docs").rglob("*.md"))]
USER_PAGES = [ROOT / "README.md", *sorted((ROOT / "docs" / "guide").glob("*.md"))]
VERBS = (
    "capture",
    "check",
    "fit",
    "stylize",
    "render",
    "evaluate",
    "compare",
    "verify",
    "study",
    "batch",
    "view",
    "page",
    "report",
    "export",
    "demo",
)
PARTS = {"study": ("make", "score")}
"""The verbs inside a verb."""
OTHER_PROGRAMS = {"--index-url", "--extra-index-url"}
OTHER_PROGRAMS |= {"--host", "--hostfile", "--port", "--nthreads", "--nworkers"}  # dask
LINK = re.compile(r"\]\(([^)\s]+)\)")
FENCE = re.compile(r"^[ \t]*```(\w*)\n(.*?)^[ \t]*```$", re.MULTILINE | re.DOTALL)


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


def anchors_of(page: Path) -> set[str]:
    """Anchors of the headings, as GitHub builds them."""
    headings = re.findall(r"^#+ (.+)$", FENCE.sub("", page.read_text()), re.MULTILINE)
    plain = (re.sub(r"[^\w\- ]", "", heading.lower()) for heading in headings)
    return {heading.replace(" ", "-") for heading in plain}


@cache
def options_of(verb: str) -> frozenset[str]:
    environment = {**os.environ, "COLUMNS": "200"}
    found = set()
    for words in ([verb, part] for part in PARTS.get(verb, ("--help",))):
        command = [sys.executable, "-m", "climatenerf", *words, "--help"]
        done = subprocess.run(command, capture_output=True, text=True, env=environment, check=True)
        found.update(re.findall(r"--[a-z][\w.-]*", done.stdout))
    return frozenset(found)


def test_readme_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) < 200


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_resolve(page):
    broken = []
    for link in LINK.findall(FENCE.sub("", page.read_text())):
        target, _, anchor = link.partition("#")
        if ":" in target:
            continue
        path = (page.parent / target).resolve() if target else page
        if not path.exists() or (anchor and anchor not in anchors_of(path)):
            broken.append(link)
    assert not broken, f"{name_of(page)} links to {broken}"


def test_every_page_is_reachable_from_the_table_of_contents():
    reached, waiting = set(), [ROOT / "docs" / "README.md"]
    while waiting:
        page = waiting.pop()
        reached.add(page)
        links = (link.partition("#")[0] for link in LINK.findall(page.read_text()))
        found = {(page.parent / link).resolve() for link in links if link.endswith(".md")}
        waiting += [each for each in found if each not in reached and each.exists()]
    assert set((ROOT / "docs").rglob("*.md")) <= reached


@pytest.mark.parametrize("page", USER_PAGES, ids=name_of)
def test_options_exist(page):
    known = OTHER_PROGRAMS.union(*(options_of(verb) for verb in VERBS))
    used = set(re.findall(r"(?<![\w-])--[a-z][\w.-]*", page.read_text()))
    assert used <= known, used - known


@pytest.mark.parametrize("page", USER_PAGES, ids=name_of)
def test_commands_have_a_verb_and_its_options(page):
    blocks = [block for language, block in FENCE.findall(page.read_text()) if not language]
    lines = [line for block in blocks for line in block.splitlines()]
    for line in lines:
        if not line.startswith("climatenerf "):
            continue
        _, verb, *args = shlex.split(line, comments=True)
        assert verb in VERBS, line
        used = {word for word in args if word.startswith("--")}
        assert used <= options_of(verb), f"{line}: {used - options_of(verb)}"


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_weather_and_batch_files_in_pages_are_valid(page, tmp_path):
    for language, block in FENCE.findall(page.read_text()):
        if language != "toml" or "[project" in block:
            continue
        file = tmp_path / "weather.toml"
        if "[[scene]]" in block:
            file.write_text(block)
            assert read_batch(file, tmp_path)
            continue
        # A line on its own shows one key of a section that the text names.
        file.write_text(block if "[" in block.splitlines()[0] else f"[flood]\n{block}")
        read_weather(file)  # raises where a key or a value is wrong


def test_citation_names_this_version():
    text = (ROOT / "CITATION.cff").read_text()
    assert f"\nversion: {climatenerf.__version__}\n" in text
    assert tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["license"] in text


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_code_in_pages_exists(page):
    """Paths such as `ops/reference.py:march` are relative to the package or to the checkout."""
    wrong = []
    for path, name in re.findall(r"`([\w.]+(?:/[\w.]+)+\.py)(?::([\w.]+))?`", page.read_text()):
        files = [folder / path for folder in (SOURCE, ROOT) if (folder / path).is_file()]
        known = files[0].read_text() if files else ""
        if not files or not all(re.search(rf"\b{word}\b", known) for word in name.split(".")):
            wrong.append(f"{path}:{name}")
    assert not wrong, f"{name_of(page)} names {wrong}"


def test_losses_in_pages_exist():
    names = {each.name for each in fields(Losses)}
    for page in PAGES:
        used = set(re.findall(r"--loss (\w+)=\d", page.read_text()))
        assert used <= names, f"{name_of(page)}: {used - names}"
    described = re.findall(r"\(`(\w+)`\)", (ROOT / "docs" / "physics.md").read_text())
    assert names <= set(described), names - set(described)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_python_in_pages_uses_public_names(page):
    for language, block in FENCE.findall(page.read_text()):
        if language == "python":
            compile(dedent(block), name_of(page), "exec")
            used = set(re.findall(r"\bclimatenerf\.(\w+)", block))
            assert used <= set(dir(climatenerf)), used - set(dir(climatenerf))
