"""What a comparison writes beside the frames: pictures, sheets, time strips, tables."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import climatenerf
from climatenerf.core.storage import plain, write_bytes, write_json
from climatenerf.output.contact_sheet import contact_sheet, write_jpeg
from climatenerf.output.video import write_png
from climatenerf.scene import Scene
from climatenerf.scene.images import read_rgb
from climatenerf.studies.compare.material import Kind, Material, Rendered
from climatenerf.studies.compare.pictures import Picture
from climatenerf.studies.compare.strips import column_strip, lines_with_most, row_strip, widened
from climatenerf.studies.user_study.compare_folder import FILE_NAME, SCHEMA_VERSION
from climatenerf.weather.description import weather_to_table

if TYPE_CHECKING:
    from climatenerf.studies.compare.study import Plan

TEXT_NAME = "compare.md"
SHEET, COLUMNS_STRIP, ROWS_STRIP = "sheet.jpg", "time-columns.png", "time-rows.png"
OUR_LICENCE = "Apache-2.0"
PICTURES = 3  # single pictures of each method, evenly spaced
MOMENTS, CELL = 5, 320  # of a sheet, and the width of its pictures
IN_GREY_LEVELS = ("flicker", "water_warp_next", "water_warp_far")
"""Display values, which the table gives in 1/255."""
COLUMNS = {
    "psnr": ("PSNR on truth, dB", 2),
    "ssim": ("SSIM on truth", 3),
    "warp_next": ("warp error t+1", 3),
    "warp_far": ("warp error t+8", 3),
    "water_warp_next": ("in water t+1, 1/255", 1),
    "water_warp_far": ("in water t+8, 1/255", 1),
    "edge_ssim": ("edge SSIM", 3),
    "flicker": ("flicker, 1/255", 2),
    "uvq": ("UVQ", 3),
    "seconds": ("s a frame", 3),
}
"""Scores in the order of the table: heading and digits after the point."""


@dataclass(frozen=True)
class Made:
    """Frames of one method and one effect.

    Attributes:
        name: of the method.
        kind: of the method.
        licence: of the method, one line.
        folder: with `frames/` and `movie.mp4`.
        material: what was edited.
        scores: by the names of `COLUMNS`.
    """

    name: str
    kind: Kind
    licence: str
    folder: Path
    material: Material
    scores: dict[str, float]

    @property
    def label(self) -> str:
        """Name for sheets; stand-ins are named as such."""
        return f"{self.name} (stand-in)" if self.kind == "stand-in" else self.name

    def picture(self, index: int) -> Picture:
        """Read a frame."""
        return read_rgb(self.folder / "frames" / f"{index:04d}.png")


def write(
    out: Path,
    scene: Scene,
    plan: "Plan",
    clean: Rendered,
    made: Mapping[str, Sequence[Made]],
) -> dict[str, Any]:
    """Write pictures, sheets, strips, `compare.md`, and `compare.json`, whose content is returned.

    Args:
        out: folder of the comparison.
        scene: the capture.
        plan: what was compared.
        clean: the frames without weather.
        made: the methods of each effect, ours first.
    """
    items: list[dict[str, str]] = []
    for effect, methods in made.items():
        for each in methods:
            items += _items(out, effect, each)
        _write_sheet(out / effect, clean, methods)
        _write_strips(out / effect, clean, methods)
    unique = {each.name: each for methods in made.values() for each in methods}
    data = plain(
        {
            "schema_version": SCHEMA_VERSION,
            "climatenerf": climatenerf.__version__,
            "simulated": True,
            "scene": scene.root.resolve().name,
            "licence": plan.licence,
            "frames": len(clean.job),
            "fps": plan.fps,
            "size": clean.job.path.size,
            "seed": plan.seed,
            "path": clean.job.path.name,
            "weather": {name: weather_to_table(film) for name, film in plan.weathers.items()},
            "methods": [
                {"name": each.name, "kind": each.kind, "licence": each.licence}
                for each in unique.values()
            ],
            "items": items,
            "scores": [
                {"effect": effect, "method": each.name, **each.scores}
                for effect, methods in made.items()
                for each in methods
            ],
        }
    )
    write_bytes(out / TEXT_NAME, markdown(data).encode())
    write_json(out / FILE_NAME, data)
    return data


def _items(out: Path, effect: str, made: Made) -> list[dict[str, str]]:
    """Write single pictures of a method; return the entries of these and of its movie."""
    count = len(made.material)
    found = []

    def item(kind: str, view: str, path: Path) -> None:
        file = path.relative_to(out).as_posix()
        entry = {"method": made.name, "effect": effect, "kind": kind, "view": view, "file": file}
        found.append(entry)

    for earlier in made.folder.glob("*.jpg"):
        if earlier.stem.isdecimal():
            earlier.unlink(missing_ok=True)
    for index in sorted({round(i) for i in np.linspace(0, count - 1, min(PICTURES, count))}):
        path = made.folder / f"{index:04d}.jpg"
        write_jpeg(path, made.picture(index))
        item("picture", f"{index:04d}", path)
    item("movie", "path", made.folder / "movie.mp4")
    return found


def _write_sheet(folder: Path, clean: Rendered, methods: Sequence[Made]) -> None:
    """Write the moments of all methods side by side, as the paper's figure of consistency."""
    count = len(clean.job)
    moments = sorted({round(i) for i in np.linspace(0, count - 1, min(MOMENTS, count))})
    rows = [("clean", [clean.picture(i) for i in moments])]
    rows += [(each.label, [each.picture(i) for i in moments]) for each in methods]
    write_jpeg(folder / SHEET, contact_sheet(rows, cell_width=CELL))


def _write_strips(folder: Path, clean: Rendered, methods: Sequence[Made]) -> None:
    """Write a row and a column of pixels over time, for each method."""
    every = range(len(clean.job))
    row, column = lines_with_most([methods[0].material.mask(i) for i in every])
    movies = [("clean", [clean.picture(i) for i in every])]
    movies += [(each.label, [each.picture(i) for i in every]) for each in methods]
    for name, strips in (
        (COLUMNS_STRIP, [(label, column_strip(movie, column)) for label, movie in movies]),
        (ROWS_STRIP, [(label, row_strip(movie, row)) for label, movie in movies]),
    ):
        rows = [(label, [widened(strip)]) for label, strip in strips]
        sheet = contact_sheet(rows, cell_width=rows[0][1][0].shape[1])
        line = f"column {column} over time" if name == COLUMNS_STRIP else f"row {row} over time"
        write_png(folder / name, sheet, f"simulated weather; {line}")


def markdown(data: Mapping[str, Any]) -> str:
    """Return the tables in Markdown from the content of `compare.json`."""
    kinds = {each["name"]: each["kind"] for each in data["methods"]}
    width, height = data["size"]
    lines = [
        f"# Comparison: {data['scene']}",
        "",
        f"{data['frames']} frames of {width}x{height} along the path {data['path']}."
        " Warp errors, edge SSIM and flicker are defined in the guide of `climatenerf compare`.",
    ]
    for effect in data["weather"]:
        rows = [row for row in data["scores"] if row["effect"] == effect]
        used = [name for name in COLUMNS if any(row.get(name) is not None for row in rows)]
        heads = ["method", "kind", *(COLUMNS[name][0] for name in used)]
        lines += ["", f"## {effect}", "", f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
        for row in rows:
            cells = [row["method"], kinds[row["method"]], *(_cell(row, name) for name in used)]
            lines.append(f"| {' | '.join(cells)} |")
        lines += ["", f"![{effect} at some moments]({effect}/{SHEET})"]
        lines += [f"![a column over time]({effect}/{COLUMNS_STRIP})"]
        lines += [f"![a row over time]({effect}/{ROWS_STRIP})"]
    lines += ["", "## Licences", ""]
    lines += [f"- capture: {data['licence'] or 'not stated'}"]
    lines += [f"- {each['name']}: {each['licence']}" for each in data["methods"]]
    return "\n".join(lines) + "\n"


def _cell(row: Mapping[str, Any], name: str) -> str:
    value = row.get(name)
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value * 255 if name in IN_GREY_LEVELS else value:.{COLUMNS[name][1]}f}"
