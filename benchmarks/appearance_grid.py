"""Measure how appearance decay and the size of the appearance grid affect held-out quality.

python benchmarks/appearance_grid.py --captures fox --steps 700 --decays 0 0.5
python benchmarks/appearance_grid.py --captures stone_sign --downscale 2 --steps 4000 --rows 17 19

Captures are names in ../shared/data or folders. One fit is made for each decay and each table size
(logarithm of its rows), with every eighth photo held out. Each row gives the held-out PSNR as `fit`
measures it, after the best affine colour map, and in the mean appearance of all fitted photos.
"""

import argparse
import sys
import tempfile
from dataclasses import replace
from itertools import product
from pathlib import Path

from common import CAPTURES, report

from climatenerf.evaluation.heldout import evaluate
from climatenerf.field.checkpoint import load_field
from climatenerf.field.presets import PRESETS
from climatenerf.scene import load_scene, read_scene
from climatenerf.training.run import fit_scene
from climatenerf.training.settings import FitSettings


def main() -> None:
    """Make the fits and print the scores of each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--captures", nargs="+", default=["fox"])
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--steps", type=int, default=700)
    parser.add_argument("--decays", type=float, nargs="+", default=[FitSettings().decay])
    parser.add_argument(
        "--rows", type=int, nargs="+", default=[PRESETS["cpu"].appearance_log2_rows]
    )
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as work:
        for capture in options.captures:
            folder = Path(capture) if Path(capture).is_dir() else CAPTURES / capture
            for decay, log2_rows in product(options.decays, options.rows):
                run = Path(work) / f"{folder.name}-{decay:g}-{log2_rows}"
                size = replace(PRESETS["cpu"], appearance_log2_rows=log2_rows)
                settings = FitSettings(
                    size=size, minutes=None, steps=options.steps, decay=decay, seed=options.seed
                )
                scores = fit_scene(
                    read_scene(folder),
                    run,
                    settings,
                    options.downscale,
                    resume=False,
                    after_step=lambda _: None,
                    after_view=lambda *_: None,
                )
                in_mean = evaluate(
                    load_field(run), load_scene(run), options.downscale, lambda *_: None, False
                )
                row = {"capture": folder.name, "decay": decay, "log2_rows": log2_rows}
                row["steps"] = options.steps
                row |= {key: scores[key] for key in ("psnr", "psnr_cc", "ssim", "seconds")}
                rows.append(row | {"psnr_mean_appearance": in_mean["psnr"]})
                print(rows[-1], file=sys.stderr)
    report("held-out quality by appearance decay, table size and appearance", rows, options.seed)


if __name__ == "__main__":
    main()
