"""Measure floaters of a fit with exact depth supervision.

python benchmarks/true_depth.py --steps 5000 --fits sparse 1 10

Fits the reference street with its own sparse points ("sparse"), and with thousands of exact surface
points per photo, whose loss has a factor on its usual weight. Floaters that remain in these fits do
not come from missing depth, but from the field's capacity or the number of steps. Needs
`pip install ".[street]"`.
"""

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import common
import numpy as np

from climatenerf.evaluation.evaluated_run import EvaluatedRun
from climatenerf.evaluation.reference import read_reference
from climatenerf.field.checkpoint import load_field
from climatenerf.scene import load_scene, read_scene
from climatenerf.scene.scene import Scene
from climatenerf.studies.geometry_ablation import score_row
from climatenerf.training.run import fit_scene
from climatenerf.training.settings import FitSettings, Losses

ROOT = Path(__file__).resolve().parents[1]
REFERENCE = ROOT / "reference" / "street"
WIDTH, HEIGHT = 768, 432  # pixels whose centres are traced


def with_true_points(capture: Scene, each: int, seed: int) -> Scene:
    """Return the capture with `each` exact surface points per photo, seen by that photo."""
    import mitsuba as mi

    sys.path.insert(0, str(ROOT))
    from tools.reference_street.layout import build_scene
    from tools.reference_street.render import load, render_view
    from tools.reference_street.truth import pixel_rays

    random = np.random.default_rng(seed)
    points, views, count = [], [], 0
    with tempfile.TemporaryDirectory() as meshes:
        street = load(build_scene(), Path(meshes), threads=2)
        depth_aov = mi.load_dict({"type": "aov", "aovs": "t:depth"})
        for view in capture.of_split("train"):
            t = render_view(street, view.c2w, WIDTH, HEIGHT, 1, 0, depth_aov)[..., -1]
            hit = np.flatnonzero(t > 0)  # 0 in the sky
            pixels = random.choice(hit, min(each, len(hit)), replace=False)
            rays = pixel_rays(view.c2w, WIDTH, HEIGHT).reshape(-1, 3)[pixels]
            points.append(view.c2w[:3, 3] + t.reshape(-1)[pixels, None] * rays)
            views.append(replace(view, seen=np.arange(count, count + len(pixels))))
            count += len(pixels)
    heldout = (replace(view, seen=None) for view in capture.of_split("heldout"))
    return replace(capture, points=np.concatenate(points), views=(*views, *heldout))


def main() -> None:
    """Make the fits and print the scores of each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=900)
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument(
        "--fits",
        nargs="+",
        default=["sparse", "1"],
        help="sparse, or weight factors",
    )
    parser.add_argument("--points", type=int, default=3000, help="exact points per photo")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    capture = read_scene(REFERENCE)
    truth = with_true_points(capture, options.points, options.seed)
    found = {}
    with tempfile.TemporaryDirectory() as work:
        for fit in options.fits:
            scene, factor = (capture, 1.0) if fit == "sparse" else (truth, float(fit))
            losses = Losses(sparse_depth=factor * Losses().sparse_depth)
            settings = FitSettings(
                minutes=None,
                steps=options.steps,
                seed=options.seed,
                losses=losses,
                multiview_stereo=False,
            )
            folder = Path(work) / fit
            fit_scene(
                scene, folder, settings, options.downscale, False, lambda _: None, lambda *_: None
            )
            run = EvaluatedRun(load_field(folder), load_scene(folder), read_reference(REFERENCE))
            found[fit], _ = score_row(run, settings, False)
            print(fit, found[fit], file=sys.stderr, flush=True)
    common.report("floaters with sparse and with exact points", found, options.seed)


if __name__ == "__main__":
    main()
