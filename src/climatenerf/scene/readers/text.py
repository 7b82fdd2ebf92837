"""Text files of numbers, as data sets keep poses and calibrations in."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from climatenerf.core.errors import UserError


def text_lines(path: Path) -> list[str]:
    """The lines of a text file that are not empty.

    Raises:
        UserError: The file is missing or no text.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise UserError(f"{path} is missing; get it from where the capture came from.") from None
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path} cannot be read as text ({error}); replace it.") from None
    return [line.strip() for line in text.splitlines() if line.strip()]


def numbers(line: str, path: Path) -> list[float]:
    """The numbers of a line with spaces between; `path` is named in the message.

    Raises:
        UserError: A word is not a number.
    """
    try:
        return [float(word) for word in line.split()]
    except ValueError:
        raise UserError(
            f"{path} has a line that is not numbers only: {line[:60]!r}; correct it."
        ) from None


def keyed_lines(path: Path) -> dict[str, str]:
    """What follows each `KEY:` of a file of such lines.

    Raises:
        UserError: The file is missing or no text.
    """
    pairs = [line.partition(":") for line in text_lines(path)]
    return {key.strip(): rest for key, _, rest in pairs}


def matrix_of(
    texts: Mapping[str, str], key: str, shape: tuple[int, ...], path: Path
) -> Float[np.ndarray, "*shape"]:
    """The numbers of one key in the given shape; `path` is named in the message.

    Raises:
        UserError: The key is absent, or its numbers are too few, too many or not finite.
    """
    if key not in texts:
        raise UserError(f"{path} has no {key}; get the file again.")
    values = np.array(numbers(texts[key], path))
    if values.size != np.prod(shape) or not np.isfinite(values).all():
        raise UserError(f"{key} in {path} is not {np.prod(shape)} finite numbers; get it again.")
    return values.reshape(shape)


def frame_rows(path: Path, count: int) -> dict[int, list[float]]:
    """`count` numbers by frame, of lines that begin with the frame.

    Raises:
        UserError: The file is missing, or a line has another number of numbers.
    """
    out: dict[int, list[float]] = {}
    for line in text_lines(path):
        values = numbers(line, path)
        if len(values) != count + 1 or not np.isfinite(values[0]):
            raise UserError(
                f"{path} has a line of {len(values)} numbers instead of a frame and {count}:"
                f" {line[:40]!r}; get the file again."
            )
        out[int(values[0])] = values[1:]
    return out
