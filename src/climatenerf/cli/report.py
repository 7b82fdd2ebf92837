"""``climatenerf report RUN``: what a user should know of a fit, as one HTML file."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from climatenerf.cli import progress
from climatenerf.cli.page import check_html
from climatenerf.core.errors import UserError

NAME = "report.html"


@dataclass(frozen=True)
class Report:
    """Write one HTML file with what a user should know of a fit: scores and pictures of held-out
    photos, ground, scale, classes, and what weather will look wrong in it."""

    run: tyro.conf.Positional[Path]
    """Run folder made by `climatenerf fit`."""
    out: Annotated[
        Path | None, tyro.conf.arg(aliases=["-o"], metavar="PATH", help_behavior_hint="")
    ] = None
    """HTML file to write. Default: report.html in the run folder."""


def run(options: Report) -> int:
    """Write the report, and print where it is and what is weak.

    Raises:
        UserError: the run is not finished, or the file cannot be written.
    """
    out = options.run / NAME if options.out is None else options.out
    from climatenerf.api import load_run
    from climatenerf.page.report import write_report
    from climatenerf.render.run_terrain import terrain_of_run
    from climatenerf.studies.shot import Place
    from climatenerf.training.folder import checked_metrics
    from climatenerf.weather.world import Kept

    fitted = load_run(options.run)
    check_html(out)
    if not (options.run / "metrics.json").is_file():
        raise UserError(f"{options.run} is not fitted to its end; resume the fit first")
    metrics = checked_metrics(options.run / "metrics.json")
    with progress.StageBars() as bars:
        terrain = terrain_of_run(options.run, fitted.field, fitted.scene, fitted.checkpoint, bars)
        kept = None if fitted.digest is None else Kept(fitted.folder, fitted.digest)
        place = Place(fitted.field, fitted.scene, kept, fitted.style)
        title = f"Report of {fitted.scene.root.resolve().name or options.run.resolve().name}"
        points = write_report(place, terrain, metrics, out, title, bars)
    for each in points:
        progress.say(f"{each.title}: {each.evidence}")
    progress.result(f"report: {out}")
    return 0
