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
from climatenerf.core.classes import CLASS_NAMES, SOLID
from climatenerf.core.errors import UserError
from climatenerf.core.storage import check_schema, write_json

Colour = tuple[float, float, float]

FILE_NAME = "style.json"
SCHEMA_VERSION = 1
MAX_ENTRY = 100.0  # of palettes and matrices in a file
MAX_COLOURS = 16  # of a palette


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
class SkyPalette:
    """A sky that takes the place of part of the photographed one."""

    colour: Colour
    """Linear RGB of luminance 1."""
    gradient: float
    """Luminance of the zenith over that of the horizon, less 1; -1 to 4."""
    share: float
    """Fraction of the photographed sky, its sun included, that is replaced, 0 to 1."""


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
class FineTuned:
    """How the field itself got the colours: its appearance grid was fitted to pictures.

    Attributes:
        teacher: what made the pictures: "operator", "wct", "pictures" or "editor".
        steps: of the fit that were taken.
        views: that taught.
        width: of their pictures, pixels.
        irradiance: on open level ground before, linear; recoloured ground would give another.
        psnr: of other views against their pictures, dB: before, after. None: there were none.
    """

    teacher: str
    steps: int
    views: int
    width: int
    irradiance: Colour
    psnr: tuple[float, float] | None = None


@dataclass(frozen=True)
class Style:
    """New colours of a scene.

    Attributes:
        name: of the season, or of the file that the style comes from.
        classes: the classes that change.
        sky: the sky; None: that of the photos.
        patch: size of places that turn alike, m.
        seed: of the noise that places them.
        sources: files that it was made from.
        note: what a user should know.
        fine_tuned: how the field got its colours, if not by `classes`, which are empty then.
    """

    name: str
    classes: tuple[ClassStyle, ...]
    sky: SkyPalette | None
    patch: float
    seed: int
    sources: tuple[Source, ...] = ()
    note: str = ""
    fine_tuned: FineTuned | None = None


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
    write_json(folder / FILE_NAME, {"schema_version": SCHEMA_VERSION, **as_table(style)})


def as_table(style: Style) -> dict[str, Any]:
    """Return a style as its file holds it, without the version."""
    sky = style.sky
    return {
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
        "fine_tuned": None if style.fine_tuned is None else vars(style.fine_tuned),
    }


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
        sky = _read_sky(parsing.entries(data, "sky", where), f"the sky of {where}")
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
        _read_fine_tuned(data, where),
    )


def _read_fine_tuned(data: dict[str, Any], where: str) -> FineTuned | None:
    if data.get("fine_tuned") is None:
        return None
    table = parsing.entries(data, "fine_tuned", where)
    psnr = None
    if table.get("psnr") is not None:
        before, after = parsing.matrix([table["psnr"]], [(1, 2)], f"the PSNR of {where}", 1e3)[0]
        psnr = float(before), float(after)
    what = f"the irradiance of {where}"
    rgb = parsing.matrix([table.get("irradiance")], [(1, 3)], what, MAX_ENTRY)[0].clip(0)
    red, green, blue = rgb.tolist()
    return FineTuned(
        parsing.text(table, "teacher", where),
        parsing.integer(table, "steps", where, 0, 10**9),
        parsing.integer(table, "views", where, 1, 10**6),
        parsing.integer(table, "width", where, 1, 10**6),
        (red, green, blue),
        psnr,
    )


_SOURCE = ("file", "sha256", "licence")


def _read_class(kind: int, table: dict[str, Any], where: str) -> ClassStyle:
    colours = parsing.items(table, "palette", where)
    shape = min(max(len(colours), 1), MAX_COLOURS), 3
    return ClassStyle(
        kind,
        parsing.matrix(colours, [shape], f"the palette of {where}", MAX_ENTRY).clip(0),
        parsing.matrix(table.get("matrix"), [(3, 3)], f"the matrix of {where}", MAX_ENTRY),
        parsing.number(table, "strength", where, 0, 1),
        parsing.number(table, "gate", where, 0, 1),
    )


def _read_sky(table: dict[str, Any], where: str) -> SkyPalette:
    colour = parsing.matrix([table.get("colour")], [(1, 3)], f"the colour of {where}", MAX_ENTRY)
    red, green, blue = colour[0].clip(0).tolist()
    return SkyPalette(
        (red, green, blue),
        parsing.number(table, "gradient", where, -1, 4),
        parsing.number(table, "share", where, 0, 1),
    )
