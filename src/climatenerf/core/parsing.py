"""Typed reading of JSON and TOML files, bounded in size, nesting and digits.

Every file of this kind that the program reads comes through `read_json` or `read_toml`, and its
values through the functions below, so that whatever a file holds gives values of known type and
range or one `UserError`.
"""

import json
import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from climatenerf.core.errors import UserError, excerpt, explain, one_line
from climatenerf.core.regular_files import check_regular, is_stream, read_stream
from climatenerf.core.text import decode

MAX_NESTING = 100
MAX_DIGITS = 40
"""Digits of an integer; 64 bits hold 19."""
MAX_JSON_BYTES = 256 * 2**20
MAX_TOML_BYTES = 2**20
"""A weather file of 10 000 keyframes has 0.3 MB."""
MAX_VALUES = 8_000_000
"""Values of one file; 100 000 poses have 3.5 million. They take up to 70 bytes each."""
_BLOCK = 2**20
_STRING = re.compile(rb'"(?:[^"\\]++|\\.)*+"?', re.DOTALL)
# Tried at the first character of a part alone; at every one, the time would grow with its square.
_LONG_KEY = re.compile(rf"(?<![\w\"'-])(?:[\w\"'-]++[ \t]*+\.[ \t]*+){{{MAX_NESTING}}}")
_REQUIRED: Any = object()

# Change of the nesting at each byte, and which bytes separate or open values.
_DEPTH = np.zeros(256, np.int8)
_DEPTH[[ord("["), ord("{")]] = 1
_DEPTH[[ord("]"), ord("}")]] = -1
_BEGINS = np.zeros(256, bool)
_BEGINS[[ord("["), ord("{"), ord(",")]] = True


def read_bytes(path: Path | str, what: str = "file", max_bytes: int = MAX_JSON_BYTES) -> bytes:
    """Return the content of a file that has at most `max_bytes`.

    Args:
        path: the file.
        what: what it is to the user, which begins the message.
        max_bytes: greatest size, bytes; no more than that is read.

    Raises:
        UserError: absent, unreadable, too large, or a pipe or device that no shell gave.
    """
    try:
        if is_stream(path):
            data = read_stream(path, max_bytes + 1)
        else:
            check_regular(path, what)
            with open(path, "rb") as file:
                data = file.read(max_bytes + 1)
    except FileNotFoundError as error:
        raise UserError(f"{what}: {path} does not exist; check the path") from error
    except OSError as error:
        raise explain(error, Path(path)) from error
    except ValueError as error:  # a zero byte in the name
        raise UserError(f"{what}: {excerpt(str(path))} is no name of a file; check it") from error
    if len(data) > max_bytes:
        raise UserError(
            f"{what}: {path} has more than {max_bytes / 1e6:.0f} MB, which no such file needs;"
            " check that it is the right one"
        )
    return data


def read_json(path: Path | str, what: str = "file") -> dict[str, Any]:
    """Read a JSON object.

    Args:
        path: the file.
        what: what it is to the user ("run", "camera path"), for the error message.

    Raises:
        UserError: absent, unreadable, not JSON, not an object, or beyond the bounds above.
    """
    value = parse_json(read_bytes(path, what), f"{what}: {path}")
    if not isinstance(value, dict):
        raise UserError(f"{what}: {path} should hold a JSON object {{...}}; recreate it")
    return value


def parse_json(data: bytes | str, where: str) -> Any:
    """Return the value of a JSON text; numbers that are not finite are left for the getters.

    Args:
        data: the text, UTF-8.
        where: begins the messages, such as "scene: /data/scene.json".

    Raises:
        UserError: not JSON, or beyond the bounds above.
    """
    raw = data.encode("utf-8", "surrogatepass") if isinstance(data, str) else data
    _check_nesting(raw, where)
    try:
        return json.loads(decode(raw, where), parse_int=_bounded_integer)
    except RecursionError as error:
        raise _too_deep(where) from error
    except json.JSONDecodeError as error:
        raise UserError(
            f"{where} is not valid JSON (line {error.lineno}, column {error.colno}: {error.msg});"
            " it is damaged or cut off, restore or recreate it"
        ) from error
    except ValueError as error:  # from `_bounded_integer`
        raise UserError(f"{where} holds {error}; correct it or restore the file") from error


def read_toml(path: Path | str, what: str = "file") -> dict[str, Any]:
    """Read a TOML table.

    Args:
        path: the file.
        what: what it is to the user ("weather file", "marks"), for the error message.

    Raises:
        UserError: absent, unreadable, not TOML, or beyond the bounds above.
    """
    where = f"{what}: {path}"
    text = decode(read_bytes(path, what, MAX_TOML_BYTES), where)
    if _LONG_KEY.search(text):  # the library's time grows with the square of the parts of a key
        raise _too_deep(where)
    try:
        table = tomllib.loads(text)
    except RecursionError as error:
        raise _too_deep(where) from error
    except tomllib.TOMLDecodeError as error:
        reason = one_line(str(error), 200)
        raise UserError(f"{where} is not valid TOML ({reason}); correct it") from error
    except ValueError as error:  # Python's own limit
        raise UserError(f"{where} holds a number of over 4300 digits; correct it") from error
    _check_values(table, where)
    return table


def number(
    table: Mapping[str, Any],
    key: str,
    where: str,
    low: float = -math.inf,
    high: float = math.inf,
    default: Any = _REQUIRED,
) -> float:
    """Return a finite number of a table.

    Args:
        table: from `read_json` or `read_toml`.
        key: its entry.
        where: file or place, for the message.
        low: least valid value.
        high: greatest valid value.
        default: returned if the entry is absent; without it the entry is required.

    Raises:
        UserError: absent, no number, not finite, or out of range.
    """
    value = _entry(table, key, where, default)
    if value is default and default is not _REQUIRED:
        return value
    return checked_number(value, f"{key} in {where}", low, high)


def checked_number(value: Any, where: str, low: float = -math.inf, high: float = math.inf) -> float:
    """Return a value from a file as a finite float from `low` to `high`.

    Raises:
        UserError: it is none; `where` begins the message.
    """
    if not is_number(value) or not math.isfinite(value) or not low <= value <= high:
        bounds = "" if math.isinf(low) and math.isinf(high) else f" from {low:g} to {high:g}"
        raise UserError(
            f"{where} should be a finite number{bounds}, not {excerpt(value)}; correct it or"
            " restore the file"
        )
    return float(value)


def integer(
    table: Mapping[str, Any],
    key: str,
    where: str,
    low: int,
    high: int,
    default: Any = _REQUIRED,
) -> int:
    """Return a whole number of a table; arguments and errors as `number`."""
    value = _entry(table, key, where, default)
    if value is default and default is not _REQUIRED:
        return value
    whole = isinstance(value, int) or (isinstance(value, float) and value.is_integer())
    if isinstance(value, bool) or not whole or not low <= value <= high:
        raise _wrong(key, where, f"a whole number from {low} to {high}", value)
    return int(value)


def text(table: Mapping[str, Any], key: str, where: str, default: Any = _REQUIRED) -> str:
    """Return a string of a table; arguments and errors as `number`."""
    return _typed(table, key, where, default, str, "a text")


def flag(table: Mapping[str, Any], key: str, where: str, default: Any = _REQUIRED) -> bool:
    """Return true or false of a table; arguments and errors as `number`."""
    return _typed(table, key, where, default, bool, "true or false")


def entries(
    table: Mapping[str, Any], key: str, where: str, default: Any = _REQUIRED
) -> dict[str, Any]:
    """Return a table inside a table; arguments and errors as `number`."""
    return _typed(table, key, where, default, dict, "a table of named values")


def items(table: Mapping[str, Any], key: str, where: str, default: Any = _REQUIRED) -> list[Any]:
    """Return a list of a table; arguments and errors as `number`."""
    return _typed(table, key, where, default, list, "a list")


def matrix(
    value: Any, shapes: Sequence[tuple[int, int]], where: str, limit: float = math.inf
) -> Float[np.ndarray, "rows columns"]:
    """Return a list of rows of numbers as a matrix.

    Args:
        value: as a file holds it.
        shapes: the (rows, columns) that are valid.
        where: what it is and where, which begins the message.
        limit: greatest absolute value of an entry.

    Raises:
        UserError: another shape, or an entry that is no finite number up to the limit.
    """
    rows = value if isinstance(value, list | tuple) else []
    rows = [row if isinstance(row, list | tuple) else () for row in rows]
    width = len(rows[0]) if rows else 0
    if (len(rows), width) in shapes and all(len(row) == width for row in rows):
        numbers = [x for row in rows for x in row]
        if all(is_number(x) and -limit <= x <= limit and math.isfinite(x) for x in numbers):
            return np.array(numbers, np.float64).reshape(-1, width)
    sizes = " or ".join(f"{a}x{b}" for a, b in shapes)
    bound = "" if math.isinf(limit) else f" up to {limit:g}"
    raise UserError(
        f"{where} should be {sizes} finite numbers{bound}; correct it or restore the file"
    )


def is_number(value: Any) -> bool:
    """Return whether a value from a file is a number; true and false are none."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def _entry(table: Mapping[str, Any], key: str, where: str, default: Any) -> Any:
    if not isinstance(table, Mapping):
        raise UserError(
            f"{where} should be a table of named values, not {excerpt(table)}; restore the file"
        )
    value = table.get(key, default)
    if value is _REQUIRED:
        raise UserError(f"{where} has no {key}; it is damaged, restore or recreate the file")
    return value


def _typed(
    table: Mapping[str, Any], key: str, where: str, default: Any, kind: type, meaning: str
) -> Any:
    value = _entry(table, key, where, default)
    if not isinstance(value, kind) and (default is _REQUIRED or value is not default):
        raise _wrong(key, where, meaning, value)
    return value


def _wrong(key: str, where: str, meaning: str, value: Any) -> UserError:
    return UserError(
        f"{key} in {where} should be {meaning}, not {excerpt(value)}; correct it or restore the"
        " file"
    )


def _too_deep(where: str) -> UserError:
    return UserError(f"{where} is nested too deeply to be sound; restore or recreate the file")


def _bounded_integer(digits: str) -> int:
    if len(digits) > MAX_DIGITS:
        raise ValueError(f"a number of {len(digits)} digits")
    return int(digits)


def _check_nesting(data: bytes, where: str) -> None:
    """Refuse a JSON text that is nested too deeply or holds too many values, before parsing."""
    deepest, values = _extent(data)
    if deepest > MAX_NESTING or values > MAX_VALUES:  # brackets in strings do not count
        deepest, values = _extent(_STRING.sub(b"", data))
    if deepest > MAX_NESTING:
        raise _too_deep(where)
    if values > MAX_VALUES:
        raise UserError(
            f"{where} holds {values / 1e6:.0f} million values, more than the {MAX_VALUES / 1e6:.0f}"
            " million that can be read; check that it is the right file"
        )


def _extent(data: bytes) -> tuple[int, int]:
    """Return the depth of the deepest bracket and the number of values, without parsing."""
    depth = deepest = values = 0
    for start in range(0, len(data), _BLOCK):
        block = np.frombuffer(data, np.uint8, min(_BLOCK, len(data) - start), start)
        levels = np.cumsum(_DEPTH[block], dtype=np.int64)
        deepest = max(deepest, depth + int(levels.max()))
        depth += int(levels[-1])
        values += int(_BEGINS[block].sum())
    return deepest, values


def _check_values(table: dict[str, Any], where: str) -> None:
    """Refuse parsed tables that are nested too deeply or hold integers of too many digits."""
    level: list[Any] = [table]
    for _ in range(MAX_NESTING):
        inner: list[Any] = []
        for value in level:
            inner += value.values() if isinstance(value, dict) else value
        for value in inner:
            if isinstance(value, int) and value.bit_length() > 3.33 * MAX_DIGITS:
                raise UserError(f"{where} holds {excerpt(value)}; correct it")
        level = [value for value in inner if isinstance(value, dict | list)]
        if not level:
            return
    raise _too_deep(where)
