"""A style: the colours of a season as they are in one scene, and their file. No torch.

A class of surfaces shows r(c) = Y(c) a + M c in place of its linear colour c, see `recolouring`. A
season gives the palettes a, and with the mean colour of the class in the photos M; a photo of
another place gives M alone.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from climatenerf.core import parsing
from climatenerf.core.classes import CLASS_NAMES, SOLID, TERRAIN, VEGETATION
from climatenerf.core.errors import UserError
from climatenerf.core.srgb import LUMA
from climatenerf.core.storage import check_schema, write_json
from climatenerf.weather.season.palettes import (
    MAX_COLOURS,
    RANGES,
    ClassPalette,
    Palettes,
    SkyPalette,
    read_palettes,
)

FILE_NAME = "style.json"
SCHEMA_VERSION = 1
KEPT = 0.25  # fraction of the differences between leaves of a class that is kept
MAX_ENTRY = 100.0  # of palettes and matrices in a file
GREEN_LAWN = (0.75, 1.1, 0.45)  # mean colour of a class that no photo shows


@dataclass(frozen=True)
class ClassStyle:
    """How one class of surfaces changes its colour.

    Attributes:
        kind: the class, see `core.classes`.
        palette: linear colours a, one of which each place shows, or a blend of two neighbours.
        matrix: M, of linear colours.
        strength: fraction of the change that is made, 0 to 1.
        gate: fraction of the change on what is not green, 0 to 1; green changes wholly.
    """

    kind: int
    palette: Float[np.ndarray, "j 3"]
    matrix: Float[np.ndarray, "3 3"]
    strength: float
    gate: float


@dataclass(frozen=True)
class Source:
    """A file that a style was made from.

    Attributes:
        file: its name.
        sha256: hash of its content.
        licence: text of the licence beside it, shortened; "" if there is none.
    """

    file: str
    sha256: str
    licence: str


@dataclass(frozen=True)
class Style:
    """New colours of a scene.

    Attributes:
        name: of the season, or of the file that the style comes from.
        classes: the classes that change.
        sky: the sky; None: that of the photos.
        patch: size of places that turn alike, m.
        seed: of the noise that tells these places apart.
        sources: files that it was made from.
        note: what a user should know.
    """

    name: str
    classes: tuple[ClassStyle, ...]
    sky: SkyPalette | None
    patch: float
    seed: int
    sources: tuple[Source, ...] = ()
    note: str = ""


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
        seed: of the noise that tells these places apart.
    """
    parts = ((VEGETATION, palettes.vegetation), (TERRAIN, palettes.terrain))
    classes = tuple(
        _class_style(kind, part, means.get(kind)) for kind, part in parts if part is not None
    )
    return Style(name, classes, palettes.sky, patch, seed, note=palettes.note)


def _class_style(kind: int, part: ClassPalette, mean: Float[np.ndarray, "3"] | None) -> ClassStyle:
    luma = np.array(LUMA)
    if mean is None or mean @ luma <= 0:
        mean = np.array(GREEN_LAWN)
    # c - Y(c) m: how the colour differs from the mean of its class at the same luminance.
    difference = np.eye(3) - np.outer(mean / (mean @ luma), luma)
    return ClassStyle(
        kind,
        part.brightness * np.array(part.palette),
        part.brightness * KEPT * difference,
        part.strength,
        part.gate,
    )


def weakened(style: Style, strength: float) -> Style:
    """Return a style of which only a fraction is made, 0 to 1."""
    classes = tuple(replace(each, strength=each.strength * strength) for each in style.classes)
    sky = style.sky
    if sky is not None:
        sky = replace(sky, share=sky.share * strength)
    return replace(style, classes=classes, sky=sky)


def write_style(folder: Path, style: Style) -> None:
    """Write `style.json` into a run folder.

    Raises:
        UserError: the file cannot be written.
    """
    sky = style.sky
    write_json(
        folder / FILE_NAME,
        {
            "schema_version": SCHEMA_VERSION,
            "name": style.name,
            "classes": {
                CLASS_NAMES[each.kind]: {
                    "palette": each.palette.tolist(),
                    "matrix": each.matrix.tolist(),
                    "strength": each.strength,
                    "gate": each.gate,
                }
                for each in style.classes
            },
            "sky": None
            if sky is None
            else {"colour": list(sky.colour), "gradient": sky.gradient, "share": sky.share},
            "patch_m": style.patch,
            "seed": style.seed,
            "sources": [vars(each) for each in style.sources],
            "note": style.note,
        },
    )


def style_in(folder: Path) -> Style | None:
    """Return the style of a run folder; None if it has none.

    Raises:
        UserError: its file is damaged, or a newer version wrote it.
    """
    path = folder / FILE_NAME
    if not path.is_file():
        return None
    data, where = parsing.read_json(path, "the style of the run"), str(path)
    check_schema(data.get("schema_version"), SCHEMA_VERSION, f"the style in {folder}")
    names = {CLASS_NAMES[kind]: int(kind) for kind in SOLID}
    classes = []
    for name, table in parsing.entries(data, "classes", where).items():
        if name not in names or not isinstance(table, dict):
            raise UserError(f"{where} has no valid class {name!r}; make the style anew")
        classes.append(_read_class(names[name], table, f"{name} of {where}"))
    sky = None
    if data.get("sky") is not None:
        sky = read_palettes({"sky": parsing.entries(data, "sky", where)}, where).sky
    sources = []
    for table in parsing.items(data, "sources", where, []):
        if not isinstance(table, dict):
            raise UserError(f"a source of {where} is not a table; make the style anew")
        sources.append(Source(*(parsing.text(table, n, where, "") for n in _SOURCE)))
    return Style(
        parsing.text(data, "name", where),
        tuple(classes),
        sky,
        parsing.number(data, "patch_m", where, 0.1, 1e3),
        parsing.integer(data, "seed", where, -(2**63), 2**63 - 1),
        tuple(sources),
        parsing.text(data, "note", where, ""),
    )


_SOURCE = ("file", "sha256", "licence")


def _read_class(kind: int, table: dict[str, Any], where: str) -> ClassStyle:
    colours = parsing.items(table, "palette", where)
    shape = min(max(len(colours), 1), MAX_COLOURS), 3
    return ClassStyle(
        kind,
        parsing.matrix(colours, [shape], f"the palette of {where}", MAX_ENTRY).clip(0),
        parsing.matrix(table.get("matrix"), [(3, 3)], f"the matrix of {where}", MAX_ENTRY),
        parsing.number(table, "strength", where, *RANGES["strength"]),
        parsing.number(table, "gate", where, *RANGES["gate"]),
    )
