"""``climatenerf evaluate RUN --reference -o REPORT``: a run's scores against the known truth."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from climatenerf.cli import progress
from climatenerf.errors import UserError


@dataclass(frozen=True)
class Evaluate:
    """Measure a run against the truth: a table, report.json, and pictures."""

    run: tyro.conf.Positional[Path]
    """Run folder made by `climatenerf fit reference/street`."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for the report."""
    reference: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Against the reference set that the run was fitted to: geometry, weather, baselines."""
    views: tuple[str, ...] = ()
    """Test views, such as t01 t04. Default: all."""
    weathers: tuple[str, ...] = ()
    """Weathers, such as flood-low smog-near. Default: all."""


def run(options: Evaluate) -> int:
    """Measures, prints the table, and says where the report is."""
    if not options.reference:
        raise UserError("say what to measure against: climatenerf evaluate RUN --reference -o OUT")

    from climatenerf.evaluation.reference import read_reference
    from climatenerf.evaluation.report import check_place, table_text, write_report
    from climatenerf.evaluation.scores import Place, check_views, evaluate
    from climatenerf.field.checkpoint import load_field
    from climatenerf.scene import load_scene
    from climatenerf.storage import read_json
    from climatenerf.training.run import check_config

    field = load_field(options.run)
    config = check_config(options.run)
    scene = load_scene(options.run)
    reference = read_reference(scene.root, options.views, options.weathers)
    if options.out.resolve().is_relative_to(reference.folder.resolve()):
        raise UserError(f"{options.out} lies in the reference set; choose another folder with -o")
    place = Place(field, scene, reference)
    check_views(place)
    measured = options.run / "metrics.json"  # absent where a fit was stopped before its end
    metrics = read_json(measured, "the run's measurements") if measured.exists() else {}
    names = ["clean", *(kind.name for kind in reference.weathers)]
    old = check_place(options.out, names)
    with progress.Bar("evaluate", len(names) + 7) as bar:
        scores = evaluate(
            Place(field, scene, reference), lambda what: bar.advance(1, {"now": what})
        )
    about = {
        "run": options.run.resolve().name,
        "capture": scene.root.name,
        "seconds": metrics.get("seconds"),
        "steps": metrics.get("steps"),
        "downscale": config.get("downscale"),
        "views": [Path(truth.name).stem for truth in reference.truths],
    }
    write_report(scores, about, options.out, old)
    progress.result(table_text(scores.table))
    progress.result(f"report: {options.out / 'report.md'}")
    return 0
