"""Parsing of text files that hold numbers, such as poses and calibrations."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from climatenerf.core.errors import UserError, explain
from climatenerf.core.text import lines_of, read_text


def text_lines(path: Path) -> list[str]:
    """Return the non-empty lines of a text file, stripped.

    Raises:
        UserError: The file is missing or not text.
    """
    try:
        text = read_text(path)
    except FileNotFoundError:
        raise UserError(f"{path} is missing; restore it from the source of the capture.") from None
    except OSError as error:
        raise explain(error, path) from None
    return [line.strip() for line in lines_of(text) if line.strip()]


def parse_numbers(line: str, path: Path) -> list[float]:
    """Return the whitespace-separated numbers of a line.

    Args:
        line: The text.
        path: File, for the message.

    Raises:
        UserError: A word is not a number.
    """
    try:
        return [float(word) for word in line.split()]
    except ValueError:
        raise UserError(
            f"{path} has a line that contains more than numbers: {line[:60]!r}; correct it."
        ) from None


def keyed_lines(path: Path) -> dict[str, str]:
    """Return the text after each `KEY:` of a file with one key per line.

    Raises:
        UserError: The file is missing or not text.
    """
    pairs = [line.partition(":") for line in text_lines(path)]
    return {key.strip(): rest for key, _, rest in pairs}


def parse_array(
    texts: Mapping[str, str], key: str, shape: tuple[int, ...], path: Path
) -> Float[np.ndarray, "*shape"]:
    """Return the numbers of one key of `keyed_lines` in the given shape.

    Args:
        texts: Text by key.
        key: Which entry to parse.
        shape: Shape of the result.
        path: File, for the message.

    Raises:
        UserError: The key is absent, or its numbers do not fit the shape or are not finite.
    """
    if key not in texts:
        raise UserError(f"{path} has no {key}; download the file again.")
    values = np.array(parse_numbers(texts[key], path))
    if values.size != np.prod(shape) or not np.isfinite(values).all():
        raise UserError(
            f"{key} in {path} is not {np.prod(shape)} finite numbers; download the file again."
        )
    return values.reshape(shape)


def frame_rows(path: Path, count: int) -> dict[int, list[float]]:
    """Return `count` numbers by frame, from lines of a frame number followed by the numbers.

    Raises:
        UserError: The file is missing, or a line has the wrong number of numbers.
    """
    out: dict[int, list[float]] = {}
    for line in text_lines(path):
        values = parse_numbers(line, path)
        if len(values) != count + 1 or not np.isfinite(values[0]):
            raise UserError(
                f"{path} has a line of {len(values)} numbers instead of a frame and {count}:"
                f" {line[:40]!r}; download the file again."
            )
        out[int(values[0])] = values[1:]
    return out
