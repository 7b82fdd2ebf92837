"""``climatenerf evaluate RUN --reference -o REPORT``: scores of a run against the ground truth.

``--ablation`` and ``--sweep`` make the paper's figures: one part of the method left out at a time,
and one parameter of the weather changed at a time.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal

import tyro

from climatenerf.cli import progress
from climatenerf.cli.flags import names_of, optional
from climatenerf.core.errors import UserError
from climatenerf.core.locks import only_writer

PICTURE = frozenset({"weather", "view", "size"})
FLAGS: Mapping[str, frozenset[str]] = {
    "--reference": frozenset({"reference", "views", "weathers"}),
    "--ablation geometry": frozenset({"ablation", "minutes", "downscale", "seeds", "rows"}),
    "--ablation flood": PICTURE | {"ablation"},
    "--ablation snow": PICTURE | {"ablation"},
    "--ablation seasons": PICTURE | {"ablation"},
    "--sweep": PICTURE | {"sweep"},
}
"""Which flags each kind of evaluation reads."""


@dataclass(frozen=True)
class Evaluate:
    """Score a run against the ground truth, or show what parts of the method and parameters of the
    weather do: tables, JSON and pictures."""

    run: tyro.conf.Positional[Path]
    """Run folder from `climatenerf fit`; with `--ablation geometry` the reference set."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for the report."""
    reference: bool = False
    """Compare with the reference set that the run was fitted to: geometry, weather, baselines."""
    views: tuple[str, ...] = ()
    """Test views to score, such as t01 t04. Default: all."""
    weathers: tuple[str, ...] = ()
    """Weathers to score, such as flood-low smog-near. Default: all."""
    ablation: Annotated[
        Literal["geometry", "flood", "snow", "seasons"] | None,
        optional("{geometry,flood,snow,seasons}"),
    ] = None
    """geometry: fit a reference set with one part of the method left out at a time, and score each
    fit: an hour and a half with the defaults. flood, snow: render a run with one part of the
    simulation left out at a time. seasons: as it is, with snow, in another season, in both."""
    sweep: Annotated[str | None, optional("STR")] = None
    """One picture for each value of a weather flag, such as smog.visibility="50 m,100 m,200 m".
    paper: all rows of the paper's figures."""
    weather: Annotated[Path | None, optional("PATH")] = None
    """Weather file (TOML) for --sweep, or for --ablation flood, snow or seasons."""
    view: Annotated[str | None, optional("STR")] = None
    """Photo whose pose they have. Default: the most central one, or a test view."""
    size: Annotated[str | None, optional("STR")] = None
    """Size of their pictures, such as 480x270. Default: the photo's own."""
    minutes: float = 4.0
    """Duration of each fit of the ablation, minutes."""
    downscale: int = 2
    """Factor by which photos are reduced for the ablation."""
    seeds: int = 2
    """Number of fits of each row of the ablation."""
    rows: tuple[str, ...] = ()
    """Rows of the ablation of geometry, such as "plain NGP" full. Default: all."""


def kind_of(options: Evaluate) -> str:
    """Return which evaluation is asked for, a key of `FLAGS`.

    Raises:
        UserError: none is, or a flag does not belong to it.
    """
    kind = "--reference"
    if options.ablation is not None:
        kind = f"--ablation {options.ablation}"
    elif options.sweep is not None:
        kind = "--sweep"
    for item in fields(Evaluate):
        given = item.name not in ("run", "out") and getattr(options, item.name) != item.default
        if not given or item.name in FLAGS[kind]:
            continue
        if item.name in ("reference", "sweep"):
            raise UserError(f"{kind} excludes --{item.name}; leave out one of them")
        others = [name for name, flags in FLAGS.items() if item.name in flags]
        raise UserError(f"--{item.name} belongs to {' and '.join(others)}; leave it out")
    if kind == "--reference" and not options.reference:
        raise UserError(
            "no reference to compare with; use: climatenerf evaluate RUN --reference -o OUT (or"
            " --ablation, --sweep)"
        )
    return kind


def run(options: Evaluate) -> int:
    """Score a run or make a study; print the table and the path of the report."""
    kind = kind_of(options)
    if kind == "--reference":
        return run_reference(options)
    from climatenerf.cli import studies

    if kind == "--ablation geometry":
        extent = options.minutes, options.downscale, options.seeds
        return studies.geometry(options.run, options.out, *extent, names_of(*options.rows))
    picture = studies.Picture(options.run, options.weather, options.view, options.size)
    if options.sweep is not None:
        return studies.sweep(picture, options.out, options.sweep)
    assert options.ablation is not None, "`kind_of` has found no other"
    return studies.ablation(picture, options.out, options.ablation)


def run_reference(options: Evaluate) -> int:
    """Score a run; print the table and the path of the report."""
    from climatenerf.api import load_run
    from climatenerf.evaluation.evaluated_run import EvaluatedRun, check_views
    from climatenerf.evaluation.reference import read_reference
    from climatenerf.evaluation.scores import evaluate
    from climatenerf.output.job import hash_of_run
    from climatenerf.output.score_report import check_folder, table_text, write_report
    from climatenerf.training.folder import check_config, checked_metrics
    from climatenerf.weather.world import Kept

    fitted = load_run(options.run)
    if fitted.style is not None:
        raise UserError(
            f"{options.run} has other colours than the truth; evaluate the run that it was made of"
        )
    field, scene = fitted.field, fitted.scene
    config = check_config(options.run)
    reference = read_reference(scene.root, names_of(*options.views), names_of(*options.weathers))
    if options.out.resolve().is_relative_to(reference.folder.resolve()):
        raise UserError(f"{options.out} lies in the reference set; choose another folder with -o")
    check_views(scene, reference)
    measured = options.run / "metrics.json"  # absent after an interrupted fit
    metrics = checked_metrics(measured) if measured.exists() else {}
    names = ["clean", *(case.name for case in reference.weathers)]
    description = {
        "run": options.run.resolve().name,
        "capture": scene.root.name,
        "seconds": metrics.get("seconds"),
        "steps": metrics.get("steps"),
        "downscale": config.get("downscale"),
        "views": [Path(truth.name).stem for truth in reference.truths],
    }
    check_folder(options.out, names)
    with only_writer(options.out):
        old = check_folder(options.out, names)
        kept = Kept(options.run, hash_of_run(options.run))
        with progress.Bar("evaluate", len(names) + 8) as bar:
            scores = evaluate(
                EvaluatedRun(field, scene, reference, fitted.completed(), kept),
                lambda step: bar.advance(1, {"now": step}),
            )
        write_report(scores, description, options.out, old)
    progress.result(table_text(scores.table))
    progress.result(f"report: {options.out / 'report.md'}")
    return 0
