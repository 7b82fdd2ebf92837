"""A run's scores on disk and as text: report.json, report.md, and a picture for each weather."""

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
OVERVIEW = "overview.jpg"  # the first view in all weathers
CELL, SMALL_CELL = 384, 256  # pixels of a picture's width
GAIN = 2.0  # of the difference pictures


def check_place(out: Path, pictures: list[str]) -> set[str]:
    """Refuses a folder where a report would overwrite what is no report, or that cannot be made.

    Nothing is changed: what an earlier report left is named, to be removed by `write_report`.

    Args:
        out: folder to be.
        pictures: names of those that will be written.
    """
    old: set[str] = set()
    if (out / FILE_NAME).exists():
        earlier = read_json(out / FILE_NAME, "an earlier report")
        if "scores" not in earlier:
            raise UserError(f"{out / FILE_NAME} is no report; choose another folder with -o")
        old = {TEXT_NAME, *map(str, earlier.get("pictures", []))}
    for name in (TEXT_NAME, OVERVIEW, *(f"{each}.jpg" for each in pictures)):
        if (out / name).exists() and name not in old:
            raise UserError(f"{out / name} would be overwritten; choose another folder with -o")
    absent = not out.exists()
    make_folder(out)
    if absent:
        out.rmdir()  # measuring takes minutes and may be stopped
    return old


def write_report(scores: Scores, about: dict[str, Any], out: Path, old: set[str]) -> None:
    """Writes REPORT/report.json, report.md, one picture a weather and one of them all.

    Args:
        scores: what was measured.
        about: of the run: its folder's name, minutes, steps.
        out: folder.
        old: files in it that an earlier report left, from `check_place`.
    """
    make_folder(out)
    for name in old:  # none stays of what is not measured now
        (out / name).unlink(missing_ok=True)
    overview = []
    for name, rows in scores.pictures.items():
        sheet = []
        for view, ours, real in rows:
            apart = np.abs(ours.astype(np.float64) - real.astype(np.float64)) * GAIN
            difference = np.clip(apart, 0, 255).astype(np.uint8)
            sheet.append((f"{name} {Path(view).stem}", [ours, real, difference]))
        write_jpeg(out / f"{name}.jpg", contact_sheet(sheet, cell_width=CELL), 600_000)
        overview.append(sheet[0])
    write_jpeg(out / OVERVIEW, contact_sheet(overview, cell_width=SMALL_CELL), 150_000)
    text = table_text(scores.table)
    head = f"# Against the truth\n\n{', '.join(f'{k} {v}' for k, v in about.items())}\n\n"
    foot = f"\n\nOurs, the truth, and twice the difference:\n\n![all]({OVERVIEW})\n"
    foot += "\n".join(f"![{name}]({name}.jpg)" for name in scores.pictures)
    write_bytes(out / TEXT_NAME, f"{head}```\n{text}\n```{foot}\n".encode())
    write_json(
        out / FILE_NAME,
        {
            "schema_version": SCHEMA_VERSION,
            "climatenerf": climatenerf.__version__,
            "run": about,
            "pictures": [OVERVIEW, *(f"{name}.jpg" for name in scores.pictures)],
            "scores": _finite(scores.table),
            **_finite(scores.table),
        },
    )


def table_text(table: dict[str, Any]) -> str:
    """The scores as lines for a terminal."""
    lines = [
        f"clean            PSNR {_db(table['clean']['psnr'])}  SSIM {table['clean']['ssim']:.3f}",
        _line("frame", table["frame"]),
        _line("geometry", table["geometry"]),
        _line("classes", table["labels"]),
        _line("mirrored cameras", table["completeness"]),
        "",
        f"{'PSNR dB / SSIM':<14}{'ours':>13}" + "".join(f"{name:>19}" for name in BASELINES),
    ]
    for name, own in table["weather"].items():
        cells = [f"{_pair(own):>13}"]
        for baseline in BASELINES:
            other = table["baselines"].get(baseline, {}).get(name)
            cells.append(f"{'-' if other is None else _pair(other):>19}")
        lines.append(f"{name:<14}" + "".join(cells))
    lines.append("")
    for name, own in table["weather"].items():
        lines.append(_line(name, {k: v for k, v in own.items() if k not in ("psnr", "ssim")}))
    told = table["consistency"]
    lines += ["", f"{'warp error, next / far':<24}" + "".join(f"{k:>15}" for k in KINDS)]
    for name in ("ours", *BASELINES):
        here = told if name == "ours" else told["baselines"].get(name, {})
        cells = [
            f"{here[k]['next']:.3f} / {here[k]['far']:.3f}" if k in here else "-" for k in KINDS
        ]
        if any(cell != "-" for cell in cells):
            lines.append(f"{name:<24}" + "".join(f"{cell:>15}" for cell in cells))
    return "\n".join(lines)


KINDS = ("clean", "smog", "flood", "snow")


def _pair(score: dict[str, float]) -> str:
    return f"{_db(score['psnr'])} / {score['ssim']:.3f}"


def _db(value: float) -> str:
    return f"{value:.2f}"


def _line(title: str, values: dict[str, float]) -> str:
    told = "  ".join(f"{key.replace('_', ' ')} {value:.3g}" for key, value in values.items())
    return f"{title:<16} {told}"


def _finite(value: Any) -> Any:
    """NaN is no JSON: None stands for what could not be measured."""
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value
