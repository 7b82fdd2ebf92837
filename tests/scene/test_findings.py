import ast
from pathlib import Path

import pytest

import climatenerf
from climatenerf.scene.findings import Finding, finding_from_json

SOURCES = sorted(Path(climatenerf.__file__).parent.rglob("*.py"))


def calls():
    """Yield the arguments of every call of `Finding` outside its own module, with their place."""
    names = ("code", "message", "remedy", "severity", "file")
    for path in SOURCES:
        if path.name == "findings.py":
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Finding":
                given = dict(zip(names, node.args, strict=False))
                given |= {word.arg: word.value for word in node.keywords if word.arg}
                yield f"{path.name}:{node.lineno}", given


def test_every_warning_has_a_remedy():
    lacking = []
    for place, given in calls():
        is_note = getattr(given.get("severity"), "value", "") == "note"
        remedy = given.get("remedy")
        if not is_note and (remedy is None or getattr(remedy, "value", "some") == ""):
            lacking.append(place)
    assert not lacking and len(list(calls())) > 30


def test_a_finding_survives_json():
    finding = Finding("photo-alpha", "Odd", "mend it", "warning", "a.png")
    assert finding_from_json(finding.as_json()) == finding
    with pytest.raises(ValueError):
        finding_from_json(finding.as_json() | {"remedy": 5})
