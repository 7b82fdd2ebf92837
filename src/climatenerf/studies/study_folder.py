"""The folder of a study: pictures, a contact sheet, a table to read, and an index in JSON."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

import climatenerf
from climatenerf.core.errors import UserError
from climatenerf.core.parsing import read_json
from climatenerf.core.storage import remove, write_bytes, write_json
from climatenerf.output.contact_sheet import labelled_grid, write_jpeg
from climatenerf.output.video import SIMULATED, write_png

Picture = UInt8[np.ndarray, "h w 3"]
SCHEMA_VERSION = 2  # 2: `rows` is a list of name, picture and metrics; before, a table by name
ABLATION, TEXT, SHEET = "ablation.json", "ablation.md", "contact-sheet.jpg"
FIRST_FILES = ["ablation.md", "ablation.jpg"]
CELL = 480  # width of a picture in the sheet of an ablation, pixels
MAX_SHEET = 500_000  # bytes


@dataclass(frozen=True)
class Row:
    """One row of an ablation.

    Attributes:
        name: of the row.
        picture: what it renders.
        metrics: numbers by name, with their unit at its end; NaN where there is none.
        fault: the number that must show what the row leaves out, in words.
        shown: whether it does; None: nothing must show.
    """

    name: str
    picture: Picture
    metrics: Mapping[str, float] = field(default_factory=dict)
    fault: str = ""
    shown: bool | None = None


def file_name(name: str, suffix: str = ".png") -> str:
    """Return the file of a row: its name in lower case, with dashes between the words."""
    return re.sub(r"[^a-z0-9.]+", "-", name.lower()).strip("-") + suffix


def check_folder(out: Path, index: str, kind: str, names: Iterable[str]) -> set[str]:
    """Refuse a folder in which a study would overwrite files that no study of its kind wrote.

    Args:
        out: folder of the study, which need not exist.
        index: file name of its index.
        kind: of the study, such as "flood".
        names: files that it will write.

    Returns:
        Names of the files of an earlier study of this kind.

    Raises:
        UserError: such a file exists, or the folder holds a study of another kind.
    """
    earlier: set[str] = set()
    if (out / index).is_file():
        data = read_json(out / index, "an earlier study")
        # The first ablations, all of geometry, had neither kind nor list of files.
        first = "geometry" if "minutes" in data else None
        if data.get("study", first) != kind:
            raise UserError(
                f"{out / index} is of another study than {kind}; choose another folder with -o"
            )
        earlier = {index, *_plain_names(data.get("files", FIRST_FILES))}
    for name in names:
        if (out / name).exists() and name not in earlier:
            raise UserError(f"{out / name} would be overwritten; choose another folder with -o")
    return earlier


def _plain_names(listed: object) -> set[str]:
    """Return the files that an index lists; a damaged one must not name files elsewhere."""
    names = [each for each in listed if isinstance(each, str)] if isinstance(listed, list) else []
    return {name for name in names if re.fullmatch(r"\w[\w.-]*\.(json|md|png|jpg)", name)}


def remove_left_over(out: Path, earlier: Iterable[str], files: Iterable[str]) -> None:
    """Remove the files of an earlier study that have no successor in the present one."""
    for name in set(earlier) - set(files):
        if (out / name).is_file():
            remove(out / name)


def ablation_files(names: Iterable[str], suffix: str = ".png") -> list[str]:
    """Return the files of an ablation with rows of some names."""
    return [ABLATION, TEXT, SHEET, *(file_name(name, suffix) for name in names)]


def write_ablation(
    out: Path,
    kind: str,
    about: Mapping[str, Any],
    rows: Sequence[Row],
    columns: int,
    earlier: Iterable[str] = (),
) -> None:
    """Write the pictures, the sheet, the table and the index of an ablation.

    Args:
        out: an existing folder, locked and checked.
        kind: "flood", "snow" or "seasons".
        about: what was rendered, for the index.
        rows: in the order of the table.
        columns: pictures in a row of the sheet.
        earlier: files of an earlier study in the folder, which are removed if they have no
            successor.
    """
    files = ablation_files(row.name for row in rows)
    entries = [
        {
            "name": row.name,
            "picture": file_name(row.name),
            "metrics": row.metrics,
            "fault": row.fault,
            "shown": row.shown,
        }
        for row in rows
    ]
    # First: by the index the other files are known as those of a study.
    write_json(
        out / ABLATION,
        {
            "schema_version": SCHEMA_VERSION,
            "climatenerf": climatenerf.__version__,
            "study": kind,
            **about,
            "files": files,
            "rows": entries,
        },
    )
    for row in rows:
        write_png(out / file_name(row.name), row.picture, f"{kind}, {row.name}; {SIMULATED}")
    sheet = labelled_grid([(row.name, row.picture) for row in rows], columns, CELL)
    write_jpeg(out / SHEET, sheet, MAX_SHEET)
    text = f"# Ablation: {kind}\n\n{table(rows)}\n\n{findings(rows)}\n\n![pictures]({SHEET})\n"
    write_bytes(out / TEXT, text.encode())
    remove_left_over(out, earlier, files)


def table(rows: Sequence[Row]) -> str:
    """Return the metrics of all rows as a table in Markdown; a dash for what is not known."""
    names = list(dict.fromkeys(name for row in rows for name in row.metrics))
    lines = ["| row | " + " | ".join(name.replace("_", " ") for name in names) + " |"]
    lines.append("|---" * (len(names) + 1) + "|")
    for row in rows:
        values = [row.metrics.get(name, np.nan) for name in names]
        cells = ["-" if np.isnan(value) else f"{value:.3g}" for value in values]
        lines.append(f"| {row.name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def findings(rows: Sequence[Row]) -> str:
    """Return a line for each row with the number that must show its fault, and whether it does."""
    verdict = {True: "shown", False: "NOT SHOWN", None: ""}
    return "\n".join(
        f"- {row.name}: {row.fault}" + (f": {verdict[row.shown]}" if verdict[row.shown] else "")
        for row in rows
        if row.fault
    )
