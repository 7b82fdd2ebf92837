import json
import os
from pathlib import Path

import numpy as np
import pytest

from climatenerf.core import parsing
from climatenerf.core.errors import MAX_LINE, UserError, excerpt, one_line

SOURCE = "scene.json"


def written(tmp_path, text, name="a.json"):
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[" * 20_000, "nested too deeply"),
        ('{"a":' * 20_000, "nested too deeply"),
        ('{"a": ' + "[" * 101 + "]" * 101 + "}", "nested too deeply"),
        ('{"a": ' + "9" * 400 + "}", "a number of 400 digits"),
        ('{"a": -' + "9" * 5000 + "}", "a number of 5001 digits"),
        ("{", "not valid JSON"),
        ("", "not valid JSON"),
        ("[1]", "JSON object"),
        (b'{"a": "\xff"}', "encoding"),
        ('{"a": 1}'.encode("utf-16"), "encoding"),
    ],
)
def test_invalid_json_is_refused(tmp_path, text, message):
    with pytest.raises(UserError, match=message) as caught:
        parsing.read_json(written(tmp_path, text), "scene")
    assert len(str(caught.value)) < 500 and "\n" not in str(caught.value)


def test_json_within_the_bounds_is_read(tmp_path):
    deep = '{"a": ' + "[" * 98 + "]" * 98 + "}"
    assert len(json.dumps(parsing.read_json(written(tmp_path, deep)))) > 190
    brackets = json.dumps({"names": ["[" * 500, "}" * 500, '\\"[{'] * 20})
    assert parsing.read_json(written(tmp_path, brackets)) == json.loads(brackets)
    mark = b"\xef\xbb\xbf" + b'{"a": 1}'
    assert parsing.read_json(written(tmp_path, mark)) == {"a": 1}


def test_too_many_values_are_refused_before_they_are_parsed(tmp_path, monkeypatch):
    monkeypatch.setattr(parsing, "MAX_VALUES", 1000)
    monkeypatch.setattr(parsing.json, "loads", None)
    with pytest.raises(UserError, match="values, more than"):
        parsing.read_json(written(tmp_path, json.dumps({"a": [0] * 2000})))


def test_reading_stops_at_the_size_limit(tmp_path):
    path = written(tmp_path, "x" * 101)
    with pytest.raises(UserError, match="has more than"):
        parsing.read_bytes(path, "file", 100)
    with pytest.raises(UserError, match="is a device in place of a file"):
        parsing.read_bytes("/dev/zero", "file", 1000)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a = " + "[" * 20_000, "nested too deeply"),
        ("a = " + "{a=" * 20_000, "nested too deeply"),
        (".".join("a" * 1000) + " = 1", "nested too deeply"),
        ("[" + ".".join("a" * 200) + "]", "nested too deeply"),
        ("a = " + "9" * 400, "a number of 400 digits"),
        ("a = " + "9" * 5000, "over 4300 digits"),
        ("a = 0x" + "f" * 4000, "digits"),
        ("a = ", "not valid TOML"),
        (b"a = '\xff'", "encoding"),
        ("# " + "x" * parsing.MAX_TOML_BYTES, "has more than"),
    ],
)
def test_invalid_toml_is_refused(tmp_path, text, message):
    with pytest.raises(UserError, match=message) as caught:
        parsing.read_toml(written(tmp_path, text, "a.toml"), "the weather file")
    assert len(str(caught.value)) < 500 and "\n" not in str(caught.value)


def test_unreadable_files_give_a_user_error(tmp_path, monkeypatch):
    with pytest.raises(UserError, match="does not exist"):
        parsing.read_json(tmp_path / "absent")
    with pytest.raises(UserError, match="longer than the disk allows"):
        parsing.read_json(tmp_path / ("n" * 300))
    with pytest.raises(UserError, match="a folder where a file"):
        parsing.read_json(tmp_path)
    with pytest.raises(UserError, match="no name of a file"):
        parsing.read_json("a\0b")

    def forbidden(*_):
        raise PermissionError(13, os.strerror(13))

    monkeypatch.setattr("builtins.open", forbidden)
    with pytest.raises(UserError, match="no permission"):
        parsing.read_json(tmp_path / "a.json")


@pytest.mark.parametrize("value", [None, True, "1", [], {}, float("nan"), float("inf"), 11, -1])
def test_numbers_of_other_types_and_out_of_range_are_refused(value):
    with pytest.raises(UserError, match="width in scene.json should be a finite number from 0"):
        parsing.number({"width": value}, "width", SOURCE, 0, 10)


def test_typed_values():
    table = {"n": 3, "t": "x", "b": True, "d": {"k": 1}, "l": [1], "m": [[1, 0.5], [2, 3]]}
    assert parsing.number(table, "n", SOURCE) == 3.0
    assert parsing.number(table, "absent", SOURCE, default=None) is None
    assert parsing.integer(table, "n", SOURCE, 0, 5) == 3
    assert parsing.text(table, "t", SOURCE) == "x" and parsing.flag(table, "b", SOURCE) is True
    assert parsing.entries(table, "d", SOURCE) == {"k": 1}
    assert parsing.items(table, "l", SOURCE) == [1]
    assert np.array_equal(parsing.matrix(table["m"], [(2, 2)], SOURCE), [[1, 0.5], [2, 3]])
    for read in (parsing.text, parsing.flag, parsing.entries, parsing.items):
        with pytest.raises(UserError, match=r"n in scene\.json should be"):
            read(table, "n", SOURCE)
        with pytest.raises(UserError, match="has no absent"):
            read(table, "absent", SOURCE)
    for value in (2.5, True, "3", 6, 10**30):
        with pytest.raises(UserError, match="a whole number from 0 to 5"):
            parsing.integer({"n": value}, "n", SOURCE, 0, 5)
    with pytest.raises(UserError, match="should be a table"):
        parsing.number([1], "n", SOURCE)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "value", [None, 5, [], [[1, 2]], [[1], [2, 3]], [[1, "2"], [3, 4]], [[1, 2], [3, 1e300]],
              [[1, 2], [3, float("nan")]], [[True, 1], [1, 1]], {"a": 1}, [[10**39, 1], [1, 1]]],
)  # fmt: skip
def test_matrices_of_other_shapes_and_values_are_refused(value):
    with pytest.raises(UserError, match="2x2 finite numbers up to 1000"):
        parsing.matrix(value, [(2, 2)], SOURCE, 1000.0)


def test_messages_are_one_line_of_bounded_length():
    assert one_line("two\n  lines\t and \x1b[2J a bell\a") == r"two lines\t and \x1b[2J a bell\x07"
    assert one_line("two  blanks") == "two  blanks"
    assert len(one_line("x" * 10**6)) < MAX_LINE + 10
    assert excerpt(10**6000).endswith("digits") and excerpt([0] * 100) == "a list of 100 entries"
    deep: list = []
    for _ in range(10_000):
        deep = [deep]
    assert excerpt(deep) == "a list" and len(excerpt("x" * 10**6)) < 80


def test_json_and_toml_are_parsed_in_this_module_only():
    """This module bounds the size of input.

    `sfm/worker.py` and the script that runs in the process of ClimateGAN read what this program
    itself passes to them.
    """
    root = Path(parsing.__file__).parents[1]
    allowed = {"core/parsing.py", "sfm/worker.py", "assets/compare/climategan_paint.py"}
    found = {
        path.relative_to(root).as_posix()
        for path in root.rglob("*.py")
        if any(word in path.read_text() for word in ("json.load", "tomllib", "np.load("))
    }
    assert found <= {*allowed, "core/arrays.py"}, found
