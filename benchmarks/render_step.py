"""Measure quality and time of rendering by the marching step.

python benchmarks/render_step.py RUN --steps 0.5 1 1.5 2

A factor of 1 is the finest step of a fit. Reported are the held-out PSNR and SSIM of a run, as
`fit` measures them, and the seconds that all held-out views take.
"""

import argparse
import json
import time
from pathlib import Path

import common

from climatenerf.evaluation.heldout import evaluate
from climatenerf.field.checkpoint import load_field
from climatenerf.render import volume as view
from climatenerf.scene import load_scene


def main() -> None:
    """Render the held-out views once for each step."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--steps", type=float, nargs="+", default=[0.5, 1.0, 1.5, 2.0])
    options = parser.parse_args()
    field, scene = load_field(options.run), load_scene(options.run)
    downscale = json.loads((options.run / "config.json").read_text())["downscale"]
    evaluate(field, scene, downscale, lambda *_: None)  # compiles or loads the kernels
    found = {}
    for step in options.steps:
        view.RENDER_STEP = step
        start = time.perf_counter()
        scores = evaluate(field, scene, downscale, lambda *_: None)
        found[f"{step:g}"] = {key: scores[key] for key in ("psnr", "psnr_cc", "ssim")}
        found[f"{step:g}"]["seconds"] = time.perf_counter() - start
    common.report("held-out quality by the marching step of rendering", found)


if __name__ == "__main__":
    main()
