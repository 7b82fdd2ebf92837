"""Fit the reference street and its variants, beside plain NGP, and score them with the truth.

python benchmarks/variants.py --minutes 10
python benchmarks/variants.py street-hard --minutes 4 --keep RUNS

Each capture is fitted for the same time by the default method and by "plain NGP", which has
photometric losses alone. `scores` come from the truth, `without_truth` from the run alone. `ranks`
has Spearman's rank correlation between the scores that need no reference and the true ones that
they stand for, over the default fits: plain NGP has no terrain. A row of a run that --keep holds
already is only scored.
"""

import argparse
import tempfile
from pathlib import Path
from typing import Any

import common
from scipy import stats

from climatenerf.core.storage import read_json
from climatenerf.evaluation.evaluated_run import EvaluatedRun, clean_view, display_8bit
from climatenerf.evaluation.reference import read_reference
from climatenerf.evaluation.scores import frame_scores, geometry_scores, picture_scores
from climatenerf.field.checkpoint import load_field
from climatenerf.scene import load_scene
from climatenerf.studies.geometry_ablation import fit_row, select_rows
from climatenerf.training.run import METRICS

REFERENCE = Path(__file__).resolve().parents[1] / "reference"
VARIANTS = ("street", "street-sparse", "street-tracks", "street-plain", "street-hard")
ROWS = ("plain NGP", "full")
TRUE = (
    "depth_abs_rel",
    "ground_within_10cm",
    "ground_within_5cm",
    "floater_mass",
    "clear_floater_mass",
    "clear_sky_empty_fraction",
)
STAND_FOR = {
    "ground.present": "ground_within_10cm",
    "ground.roughness_cm": "ground_within_5cm",
    "neighbours.psnr": "depth_abs_rel",
    "floating.share": "floater_mass",
    "sky.empty": "clear_sky_empty_fraction",
    "points.abs_rel": "depth_abs_rel",
}
FALLING = ("ground.roughness_cm", "floating.share", "points.abs_rel")
"""Scores without truth of which less is better."""
FALLING_TRUE = ("depth_abs_rel", "floater_mass", "clear_floater_mass")
"""True scores of which less is better."""


def main() -> None:
    """Fit, score and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("captures", nargs="*", default=VARIANTS, help="folders of reference/")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="folder for the runs; default: deleted")
    options = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.keep or Path(temporary)
        for capture in options.captures:
            for row in ROWS:
                run = folder / f"{capture}-{row.replace(' ', '-')}"
                settings = select_rows(options.minutes, (row,))[row]
                scene = load_scene(REFERENCE / capture)
                fit_row(scene, run, settings, options.downscale, lambda state: None)
                rows.append({"capture": capture, "row": row} | scored(run, capture))
    about = {"minutes": options.minutes, "downscale": options.downscale}
    common.report("variants of the reference street", about | {"rows": rows, "ranks": ranks(rows)})


def scored(run: Path, capture: str) -> dict[str, Any]:
    """Return the scores of a run, with and without the truth."""
    reference = read_reference(REFERENCE / capture, weathers=())
    evaluated = EvaluatedRun(load_field(run), load_scene(run), reference)
    views = [clean_view(evaluated, truth) for truth in reference.truths]
    geometry = geometry_scores(evaluated, views, frame_scores(evaluated)["scale"])
    pictures = [display_8bit(view.linear) for view in views]
    clean = picture_scores(pictures, [display_8bit(truth.clean) for truth in reference.truths])
    metrics = read_json(run / METRICS)
    return {
        "steps": metrics["steps"],
        "scores": {"psnr": clean["psnr"]} | {name: geometry[name] for name in TRUE},
        "without_truth": {name: metrics.get(name) for name in STAND_FOR},
    }


def ranks(rows: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return the rank correlation of each score without truth with the true one.

    It is 1 if both order the fits alike, from worst to best. Fits without the score do not count.
    """
    found = {}
    for name, true in STAND_FOR.items():
        both = [(row["without_truth"][name], row["scores"][true]) for row in rows]
        both = [(mine, other) for mine, other in both if mine is not None]
        if len(both) < 3:
            continue
        mine, other = zip(*both, strict=True)
        correlation: Any = stats.spearmanr(mine, other)
        rho = correlation.statistic
        sign = (-1) ** (name in FALLING) * (-1) ** (true in FALLING_TRUE)
        found[name] = {"stands_for": true, "fits": len(both), "spearman": float(sign * rho)}
    return found


if __name__ == "__main__":
    main()
