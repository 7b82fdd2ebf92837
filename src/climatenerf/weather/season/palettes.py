"""The colours of seasons, read from small text files. Does not import torch."""

import functools
import math
from dataclasses import dataclass, fields
from importlib import resources
from typing import Any

import numpy as np
from jaxtyping import Float

from climatenerf.core.classes import TERRAIN, VEGETATION
from climatenerf.core.errors import UserError
from climatenerf.core.parsing import read_toml
from climatenerf.core.srgb import LUMA
from climatenerf.weather.style import MAX_COLOURS, ClassStyle, Colour, SkyPalette, Style

SEASONS = ("autumn", "winter", "drought", "wildfire")
KEPT = 0.25  # fraction of the differences between leaves of a class that is kept
GREEN_LAWN = (0.75, 1.1, 0.45)  # mean colour of a class that no photo shows


@dataclass(frozen=True)
class ClassPalette:
    """How one class of surfaces changes its colour."""

    palette: tuple[Colour, ...]
    """Linear RGB of luminance 1; neighbours blend into each other from place to place."""
    strength: float
    """Fraction of the change that is made, 0 to 1."""
    brightness: float
    """New over old luminance, 0 to 4."""
    gate: float
    """Fraction of the change on what is not green, 0 to 1; green changes wholly."""


@dataclass(frozen=True)
class Palettes:
    """All colours of a season; classes that are None stay as they are."""

    vegetation: ClassPalette | None = None
    terrain: ClassPalette | None = None
    sky: SkyPalette | None = None
    note: str = ""


RANGES = {"strength": (0, 1), "brightness": (0, 4), "gate": (0, 1), "gradient": (-1, 4),
          "share": (0, 1)}  # fmt: skip


@functools.cache
def palettes_of(season: str) -> Palettes:
    """The colours of a season that comes with the program."""
    file = resources.files("climatenerf") / "assets" / "seasons" / f"{season}.toml"
    with resources.as_file(file) as path:
        return read_palettes(read_toml(path, "the season file"), f"the season {season}")


def read_palettes(table: dict[str, Any], where: str) -> Palettes:
    """Check the tables of a season file.

    Args:
        table: its content.
        where: name of the file, for errors.

    Raises:
        UserError: a key is unknown or missing, or a value is no number of its range.
    """
    known = {"vegetation": ClassPalette, "terrain": ClassPalette, "sky": SkyPalette}
    unknown = set(table) - set(known) - {"note"}
    if unknown:
        raise UserError(
            f"{where} has the unknown key {min(unknown)!r}; it may have"
            f" {', '.join([*known, 'note'])}"
        )
    note = table.get("note", "")
    if not isinstance(note, str):
        raise UserError(f"the note of {where} must be a text")
    if not set(table) & set(known):
        raise UserError(f"{where} changes nothing; give it a table, such as [vegetation]")
    parts = {name: _section(table[name], kind, f"[{name}] of {where}")
             for name, kind in known.items() if name in table}  # fmt: skip
    return Palettes(note=note, **parts)


def seasonal_style(
    name: str,
    palettes: Palettes,
    means: dict[int, Float[np.ndarray, "3"]],
    patch: float,
    seed: int,
) -> Style:
    """Return a season as a style of one scene.

    Args:
        name: of the season.
        palettes: its colours.
        means: mean linear colour of classes in the photos; absent or black: none shows it.
        patch: size of places that turn alike, m.
        seed: of the noise that places them.
    """
    parts = ((VEGETATION, palettes.vegetation), (TERRAIN, palettes.terrain))
    classes = tuple(
        _class_style(kind, part, means.get(kind)) for kind, part in parts if part is not None
    )
    return Style(name, classes, palettes.sky, patch, seed, note=palettes.note)


def _class_style(kind: int, part: ClassPalette, mean: Float[np.ndarray, "3"] | None) -> ClassStyle:
    if mean is None or mean @ np.array(LUMA) <= 0:
        mean = np.array(GREEN_LAWN)
    return ClassStyle(
        kind,
        part.brightness * np.array(part.palette),
        part.brightness * kept_differences(mean),
        part.strength,
        part.gate,
    )


def kept_differences(mean: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Return the map of a linear colour c to a part of how it differs from its class.

    M c = `KEPT` (c - Y(c) m), with luminance Y and the mean colour m of the class at luminance 1.

    Args:
        mean: linear mean colour of the class, not black.
    """
    luma = np.array(LUMA)
    return KEPT * (np.eye(3) - np.outer(mean / (mean @ luma), luma))


def _section(table: Any, kind: type, where: str) -> Any:
    names = {item.name for item in fields(kind)}
    if not isinstance(table, dict) or set(table) != names:
        given = set(table) if isinstance(table, dict) else set()
        odd = [f"{name!r} is unknown" for name in sorted(given - names)]
        odd += [f"{name} is missing" for name in sorted(names - given)]
        raise UserError(
            f"{where} must have exactly {', '.join(sorted(names))}; {', '.join(odd[:3])}"
        )
    values: dict[str, Any] = {}
    for name, value in table.items():
        if name == "colour":
            values[name] = _colour(value, where)
        elif name == "palette":
            if not isinstance(value, list) or not 1 <= len(value) <= MAX_COLOURS:
                raise UserError(f"the palette in {where} must be 1 to {MAX_COLOURS} colours")
            values[name] = tuple(_colour(each, where) for each in value)
        else:
            low, high = RANGES[name]
            if not _is_number(value) or not low <= value <= high:
                raise UserError(f"{name} in {where} must be a number from {low} to {high}")
            values[name] = float(value)
    return kind(**values)


def _colour(value: Any, where: str) -> Colour:
    """Three numbers, scaled to a luminance of 1."""
    if not (isinstance(value, list) and len(value) == 3 and all(map(_is_number, value))):
        raise UserError(f"each colour in {where} must be three numbers, such as [1.1, 1.0, 0.9]")
    if min(value) < 0 or max(value) <= 0:
        raise UserError(
            f"the colour {value} in {where} must have no negative part and not be black"
        )
    red, green, blue = map(float, value)
    return unit_luminance((red, green, blue))


def unit_luminance(colour: Colour) -> Colour:
    """Return a linear colour, not black, scaled to a luminance of 1."""
    luminance = sum(a * b for a, b in zip(colour, LUMA, strict=True))
    red, green, blue = (part / luminance for part in colour)
    return red, green, blue


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
