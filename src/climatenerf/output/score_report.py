"""Write a run's scores: report.json, report.md, and a contact sheet for each weather."""

import math
from pathlib import Path
from typing import Any

import numpy as np

import climatenerf
from climatenerf.core.errors import UserError
from climatenerf.core.storage import make_folder, read_json, write_bytes, write_json
from climatenerf.evaluation.baselines import NAMES as BASELINES
from climatenerf.evaluation.scores import Scores
from climatenerf.output.contact_sheet import contact_sheet, write_jpeg

SCHEMA_VERSION = 1
FILE_NAME, TEXT_NAME = "report.json", "report.md"
OVERVIEW = "overview.jpg"  # the first view in every weather
CELL, SMALL_CELL = 384, 256  # width of each picture in a sheet, pixels
DIFFERENCE_GAIN = 2.0  # of the difference pictures
WARPED = ("clean", "smog", "flood", "snow")  # columns of the table of warp errors


def check_folder(out: Path, names: list[str]) -> set[str]:
    """Refuse a folder in which a report would overwrite other files, or that cannot be made.

    The folder is left unchanged. Files of an earlier report are listed, for `write_report` to
    delete.

    Args:
        out: folder for the report.
        names: names, without suffix, of the contact sheets to be written.

    Returns:
        Names of the files of an earlier report.

    Raises:
        UserError: a file that no report wrote would be overwritten.
    """
    old: set[str] = set()
    if (out / FILE_NAME).exists():
        earlier = read_json(out / FILE_NAME, "an earlier report")
        if "scores" not in earlier:
            raise UserError(f"{out / FILE_NAME} is no report; choose another folder with -o")
        old = {TEXT_NAME, *map(str, earlier.get("pictures", []))}
    for name in (TEXT_NAME, OVERVIEW, *(f"{each}.jpg" for each in names)):
        if (out / name).exists() and name not in old:
            raise UserError(f"{out / name} would be overwritten; choose another folder with -o")
    absent = not out.exists()
    make_folder(out)
    if absent:
        out.rmdir()  # an evaluation takes minutes and may be interrupted: leave no empty folder
    return old


def write_report(scores: Scores, run: dict[str, Any], out: Path, old: set[str]) -> None:
    """Write report.json, report.md, one contact sheet per weather and one of all weathers.

    Args:
        scores: the measured scores and pictures.
        run: description of the run: its folder's name, seconds, steps and so on.
        out: folder for the report.
        old: files of an earlier report in that folder, from `check_folder`.
    """
    make_folder(out)
    for name in old:  # weathers that were not measured this time must not keep their sheets
        (out / name).unlink(missing_ok=True)
    overview = []
    for name, rows in scores.pictures.items():
        sheet = []
        for view, rendered, reference in rows:
            error = np.abs(rendered.astype(np.float64) - reference.astype(np.float64))
            difference = np.clip(DIFFERENCE_GAIN * error, 0, 255).astype(np.uint8)
            sheet.append((f"{name} {Path(view).stem}", [rendered, reference, difference]))
        write_jpeg(out / f"{name}.jpg", contact_sheet(sheet, cell_width=CELL), 600_000)
        overview.append(sheet[0])
    write_jpeg(out / OVERVIEW, contact_sheet(overview, cell_width=SMALL_CELL), 150_000)
    text = table_text(scores.table)
    head = f"# Scores against the reference\n\n{', '.join(f'{k} {v}' for k, v in run.items())}\n\n"
    foot = f"\n\nRendered, reference, and twice the difference:\n\n![all]({OVERVIEW})\n"
    foot += "\n".join(f"![{name}]({name}.jpg)" for name in scores.pictures)
    write_bytes(out / TEXT_NAME, f"{head}```\n{text}\n```{foot}\n".encode())
    write_json(
        out / FILE_NAME,
        {
            "schema_version": SCHEMA_VERSION,
            "climatenerf": climatenerf.__version__,
            "run": run,
            "pictures": [OVERVIEW, *(f"{name}.jpg" for name in scores.pictures)],
            "scores": _without_nan(scores.table),
            **_without_nan(scores.table),
        },
    )


def table_text(table: dict[str, Any]) -> str:
    """Return the scores as lines of text for a terminal."""
    lines = [
        f"clean            PSNR {_db(table['clean']['psnr'])}  SSIM {table['clean']['ssim']:.3f}",
        _line("frame", table["frame"]),
        _line("geometry", table["geometry"]),
        _line("classes", table["labels"]),
        _line("mirrored cameras", table["completeness"]),
    ]
    if table["weather"]:
        names = "".join(f"{name:>19}" for name in BASELINES)
        lines += ["", f"{'PSNR dB / SSIM':<14}{'ours':>13}{names}"]
    for name, scores in table["weather"].items():
        cells = [f"{_psnr_ssim(scores):>13}"]
        for baseline in BASELINES:
            other = table["baselines"].get(baseline, {}).get(name)
            cells.append(f"{'-' if other is None else _psnr_ssim(other):>19}")
        lines.append(f"{name:<14}" + "".join(cells))
    lines.append("")
    for name, scores in table["weather"].items():
        lines.append(_line(name, {k: v for k, v in scores.items() if k not in ("psnr", "ssim")}))
    lines += [_line(f"walls, {name}", walls) for name, walls in table.get("walls", {}).items()]
    lines.append(_line("light", table.get("light", {})))
    lines += [_line(f"relit, {name}", scores) for name, scores in table.get("relight", {}).items()]
    consistency = table["consistency"]
    lines += ["", f"{'warp error, next / far':<24}" + "".join(f"{k:>15}" for k in WARPED)]
    for name in ("ours", *BASELINES):
        errors = consistency if name == "ours" else consistency["baselines"].get(name, {})
        cells = [
            f"{errors[k]['next']:.3f} / {errors[k]['far']:.3f}" if k in errors else "-"
            for k in WARPED
        ]
        if any(cell != "-" for cell in cells):
            lines.append(f"{name:<24}" + "".join(f"{cell:>15}" for cell in cells))
    return "\n".join(lines)


def _psnr_ssim(score: dict[str, float]) -> str:
    return f"{_db(score['psnr'])} / {score['ssim']:.3f}"


def _db(value: float) -> str:
    return f"{value:.2f}"


def _line(title: str, values: dict[str, Any]) -> str:
    """Return a line of scores; those in groups have the group's name before theirs."""
    cells = []
    for key, value in values.items():
        inner = value.items() if isinstance(value, dict) else [("", value)]
        for name, number in inner:
            cells.append(f"{f'{key} {name}'.strip().replace('_', ' ')} {number:.3g}")
    return f"{title:<16} {'  '.join(cells)}"


def _without_nan(value: Any) -> Any:
    """Replace NaN and infinity, which JSON lacks, by None, recursively."""
    if isinstance(value, dict):
        return {key: _without_nan(each) for key, each in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value
