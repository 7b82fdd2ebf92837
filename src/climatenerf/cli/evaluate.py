"""``climatenerf evaluate RUN --reference -o REPORT``: scores of a run against the ground truth.

``climatenerf evaluate SCENE --ablation -o REPORT`` fits and scores a reference set with one part of
the method left out at a time.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from climatenerf.cli import progress
from climatenerf.core.errors import UserError
from climatenerf.core.locks import only_writer


@dataclass(frozen=True)
class Evaluate:
    """Score a run against the ground truth: a table, report.json and pictures."""

    run: tyro.conf.Positional[Path]
    """Run folder from `climatenerf fit reference/street`; with --ablation the reference set."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for the report."""
    reference: bool = False
    """Compare with the reference set that the run was fitted to: geometry, weather, baselines."""
    views: tuple[str, ...] = ()
    """Test views to score, such as t01 t04. Default: all."""
    weathers: tuple[str, ...] = ()
    """Weathers to score, such as flood-low smog-near. Default: all."""
    ablation: bool = False
    """Fit a reference set with one part of the method left out at a time, and score each fit: eight
    rows, an hour and a half with the defaults. Re-run the same command to resume."""
    minutes: float = 4.0
    """Duration of each fit of the ablation, minutes."""
    downscale: int = 2
    """Factor by which photos are reduced for the ablation."""
    seeds: int = 2
    """Number of fits of each row of the ablation."""
    rows: tuple[str, ...] = ()
    """Rows of the ablation, such as "plain NGP" full. Default: all."""


def run(options: Evaluate) -> int:
    """Score a run or make an ablation; print the table and the path of the report."""
    if options.ablation:
        return run_ablation(options)
    if (options.minutes, options.downscale, options.seeds, options.rows) != (4.0, 2, 2, ()):
        raise UserError(
            "--minutes, --downscale, --seeds and --rows belong to --ablation; leave them out"
        )
    if not options.reference:
        raise UserError(
            "no reference to compare with; use: climatenerf evaluate RUN --reference -o OUT"
        )

    from climatenerf.api import load_run
    from climatenerf.evaluation.evaluated_run import EvaluatedRun, check_views
    from climatenerf.evaluation.reference import read_reference
    from climatenerf.evaluation.scores import evaluate
    from climatenerf.output.job import hash_of_run
    from climatenerf.output.score_report import check_folder, table_text, write_report
    from climatenerf.training.folder import check_config, checked_metrics
    from climatenerf.weather.world import Kept

    fitted = load_run(options.run)
    field, scene = fitted.field, fitted.scene
    config = check_config(options.run)
    reference = read_reference(scene.root, options.views, options.weathers)
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


def run_ablation(options: Evaluate) -> int:
    """Fit and score every row; print the table and the path of the report."""
    if not 0 < options.minutes < float("inf") or options.downscale < 1 or options.seeds < 1:
        raise UserError("--minutes must be above 0, --downscale and --seeds at least 1")
    if options.reference or options.views or options.weathers:
        raise UserError("--ablation excludes --reference, --views and --weathers; leave them out")
    from climatenerf.scene import read_scene

    scene = read_scene(options.run)

    from climatenerf.studies.ablation import TEXT_NAME, ablate, markdown, select_rows
    from climatenerf.training.trainer import Report

    selected = select_rows(options.minutes, options.rows)
    total = len(selected) * options.seeds
    with progress.Bar("ablation", float(total)) as bar:
        done = 0

        def after_step(name: str, state: Report) -> None:
            bar.update(done + state.progress, {"row": name, "PSNR": f"{state.psnr:.1f}"})

        def scoring(name: str) -> None:
            nonlocal done
            done += 1
            bar.update(float(done), {"scoring": name})

        extent = (options.minutes, options.downscale, options.seeds)
        data = ablate(scene, options.out, *extent, after_step, scoring, selected)
    progress.result(markdown(data))
    progress.result(f"report: {options.out / TEXT_NAME}")
    return 0
