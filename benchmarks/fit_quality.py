"""Measure held-out quality after fits of bounded duration.

python benchmarks/fit_quality.py --minutes 5 --captures fox ditch stone_sign kitti_drive
python benchmarks/fit_quality.py --minutes 5 15 --captures fox --seed 1

Captures are names in ../shared/data or folders. Each is fitted at its stored size by the command
line in a process of its own. Each row gives held-out PSNR, SSIM and colour-corrected PSNR as `fit`
measures them, and PSNR in the mean appearance of all photos instead of that of nearby photos. With
`--holdout NAME` one photo is held out instead of every eighth.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path

from common import CAPTURES, command, report

from climatenerf.evaluation.heldout import evaluate
from climatenerf.field.checkpoint import load_field
from climatenerf.scene import load_scene

KEYS = ("psnr", "psnr_cc", "ssim", "seconds", "steps", "samples")


def in_mean_appearance(run: Path, downscale: int) -> float:
    """Return the PSNR over the held-out photos in the mean appearance of the fitted photos, dB."""
    field, scene = load_field(run), load_scene(run)
    return evaluate(field, scene, downscale, lambda done, of: None, nearby=False)["psnr"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, nargs="+", default=[5.0])
    parser.add_argument("--captures", nargs="+", default=["fox"])
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--holdout", help="photo to hold out; default: every eighth")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="folder for the runs; default: deleted")
    options = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        for capture in options.captures:
            folder = Path(capture) if Path(capture).is_dir() else CAPTURES / capture
            for minutes in options.minutes:
                run = (options.keep or Path(temporary)) / f"{folder.name}-{minutes:g}min"
                args = ["fit", str(folder), "-o", str(run), "--minutes", str(minutes)]
                args += ["--downscale", str(options.downscale), "--seed", str(options.seed)]
                args += ["--holdout", options.holdout] if options.holdout else []
                start = time.perf_counter()
                command(*args)
                metrics = json.loads((run / "metrics.json").read_text())
                row = {"capture": folder.name, "minutes": minutes, "downscale": options.downscale}
                row |= {key: metrics[key] for key in KEYS}
                row["wall_seconds"] = time.perf_counter() - start
                row["psnr_mean_appearance"] = in_mean_appearance(run, options.downscale)
                psnrs = sorted(view["psnr"] for view in metrics["views"].values())
                row["psnr_of_views"] = psnrs
                rows.append(row)
    report("held-out quality after a bounded time of fitting", rows, options.seed)


if __name__ == "__main__":
    main()
