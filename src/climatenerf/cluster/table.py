"""The table of a batch: one row for each task, as CSV for programs and HTML for people."""

import contextlib
import csv
import html
import io
import urllib.parse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from climatenerf.cluster.batch import Outcome, Task
from climatenerf.core.errors import UserError
from climatenerf.core.storage import read_json, write_bytes

SCORES = ("psnr", "psnr_cc", "ssim", "steps")
COLUMNS = ["scene", "task", "status", "seconds", *SCORES, "result", "message"]
HEADINGS = ("scene", "task", "status", "time", "PSNR, dB", "colour-corrected, dB", "SSIM", "steps")
SHOWN = ("movie.mp4", "index.html", "report.md", "ablation.json", "compare.json")
"""Files that show a result, the best first."""

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; margin: 2rem; color: #1a1a1a; background: #fff }
table { border-collapse: collapse } caption { text-align: left; margin-bottom: .5rem }
th, td { padding: .3rem .8rem; text-align: left; border-bottom: 1px solid #ccc }
td.number { text-align: right; font-variant-numeric: tabular-nums }
.failed { color: #a00000; font-weight: bold } .skipped, .waiting { color: #595959 }
"""


def write_table(
    out: Path, title: str, tasks: Sequence[Task], outcomes: Mapping[Task, Outcome]
) -> Path:
    """Write `table.csv` and `table.html`, and return the latter.

    Args:
        out: folder of the batch.
        title: name of the batch.
        tasks: all tasks, in the order of the rows.
        outcomes: those that have ended.

    Raises:
        UserError: a disk error.
    """
    rows = [_row(out, task, outcomes.get(task)) for task in tasks]
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_bytes(out / "table.csv", text.getvalue().encode("utf-8", "replace"))
    write_bytes(out / "table.html", _page(title, rows).encode("utf-8", "replace"))
    return out / "table.html"


def _row(out: Path, task: Task, outcome: Outcome | None) -> dict[str, Any]:
    row: dict[str, Any] = dict.fromkeys(COLUMNS, "")
    row |= {"scene": task.scene, "task": task.name, "status": "waiting"}
    if outcome is None:
        return row
    row |= {"status": outcome.status, "message": outcome.message}
    if outcome.status != "skipped":
        row["seconds"] = round(outcome.seconds, 1)
    if outcome.status == "done":
        found = next((task.out / n for n in SHOWN if (task.out / n).is_file()), task.out)
        row["result"] = found.relative_to(out).as_posix()
    if outcome.status == "failed":
        row["result"] = task.log.relative_to(out).as_posix()
    if task.words[0] == "fit" and outcome.status == "done":
        with contextlib.suppress(UserError, OSError):
            metrics = read_json(task.out / "metrics.json")
            row |= {name: _rounded(metrics.get(name)) for name in SCORES}
    return row


def _rounded(value: object) -> object:
    return round(value, 4) if isinstance(value, float) else "" if value is None else value


def _page(title: str, rows: Sequence[Mapping[str, Any]]) -> str:
    body = "\n".join(_html_row(row) for row in rows)
    counts = {status: sum(row["status"] == status for row in rows) for status in _STATUSES}
    summary = ", ".join(f"{count} {status}" for status, count in counts.items() if count)
    heading = "".join(f'<th scope="col">{html.escape(text)}</th>' for text in HEADINGS)
    return f"""<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<title>{html.escape(title)}</title>
<style>{STYLE}</style>
<h1>{html.escape(title)}</h1>
<table>
<caption>{len(rows)} tasks: {summary}</caption>
<thead><tr>{heading}<th scope="col">result</th></tr></thead>
<tbody>
{body}
</tbody>
</table>
</html>
"""


_STATUSES = ("done", "failed", "skipped", "waiting")


def _html_row(row: Mapping[str, Any]) -> str:
    status = row["status"]
    seconds = row["seconds"]
    time = "" if seconds == "" else "{}:{:02}".format(*divmod(round(seconds), 60))
    numbers = [time, _digits(row["psnr"], 2), _digits(row["psnr_cc"], 2), _digits(row["ssim"], 3)]
    cells = [f"<td>{html.escape(row[name])}</td>" for name in ("scene", "task")]
    cells.append(f'<td class="{status}">{status}</td>')
    cells += [f'<td class="number">{text}</td>' for text in (*numbers, row["steps"])]
    shown = ""
    if row["result"]:
        link = urllib.parse.quote(row["result"], errors="replace")
        shown = f'<a href="{link}">{html.escape(row["result"])}</a>'
    if status == "failed":
        shown = f"{html.escape(row['message'])} ({shown})"
    cells.append(f"<td>{shown}</td>")
    return f"<tr>{''.join(cells)}</tr>"


def _digits(value: object, digits: int) -> str:
    return f"{value:.{digits}f}" if isinstance(value, float) else str(value)
