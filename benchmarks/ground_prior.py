"""Compare the ground that is found before a fit with the true ground of the reference street.

python benchmarks/ground_prior.py
python benchmarks/ground_prior.py street-hard street-plain --downscale 1

Rows: "points" uses sparse points and matched windows, "points and patches" sweeps patches of ground
in the photos as well. `within` has the fractions of true ground, nearer than 60 m in the test
views, whose height is that close. `outside_tolerance` is the fraction of valid ground whose error
exceeds the tolerance that the fit allows.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import common
import numpy as np
import torch

from climatenerf.core.classes import GROUND, MERGED
from climatenerf.evaluation.reference import Reference, read_reference
from climatenerf.scene import load_scene
from climatenerf.training import run
from climatenerf.training.evidence import ground_height
from climatenerf.training.evidence.free_space import FreeSpace
from climatenerf.training.settings import FitSettings

REFERENCE = Path(__file__).resolve().parents[1] / "reference"
VARIANTS = ("street", "street-sparse", "street-tracks", "street-plain", "street-hard")
NEAR = 60.0  # m
STRIDE = 7  # of the ground pixels
MIN_UP = 0.9  # z of the normal: kerb faces have no height


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("captures", nargs="*", default=VARIANTS, help="folders of reference/")
    parser.add_argument("--downscale", type=int, default=2)
    options = parser.parse_args()
    rows = [row for name in options.captures for row in compare(name, options.downscale)]
    common.report("ground before the fit", rows)


def compare(name: str, downscale: int) -> list[dict[str, Any]]:
    """Return a row for each kind of evidence of a capture."""
    truth = true_ground(read_reference(REFERENCE / name))
    settings = replace(FitSettings(), minutes=None, steps=1)
    free_space = run.begin(load_scene(REFERENCE / name), settings, downscale).evidence.free_space
    rows = [
        {"capture": name, "evidence": "points and patches"} | accuracy(free_space, truth),
    ]
    sides, ground_height.PATCH_SIDES = ground_height.PATCH_SIDES, ()
    rows.insert(0, {"capture": name, "evidence": "points"} | accuracy(free_space, truth))
    ground_height.PATCH_SIDES = sides
    return rows


def true_ground(reference: Reference) -> np.ndarray:
    """Return points of level ground that the test views show, world m [n 3]."""
    found = []
    for truth in reference.truths:
        up = (truth.normal @ truth.c2w[:3, :3].T)[..., 2]
        ground = np.isin(MERGED[truth.label], GROUND) & (truth.depth < NEAR) & (up > MIN_UP)
        found.append(truth.points[ground][::STRIDE])
    return np.concatenate(found)


def accuracy(free_space: FreeSpace, truth: np.ndarray) -> dict[str, Any]:
    """Find the ground, and return its errors and the seconds it took."""
    start = time.perf_counter()
    ground = free_space.find_ground()
    seconds = time.perf_counter() - start
    if ground is None:
        return {"ground": None}
    unit = free_space.field.unit
    q = free_space.field.to_grid(torch.from_numpy(truth.astype(np.float32)))
    above, valid = ground.height_above(q)
    error = np.abs(above.numpy()) * unit
    tolerance = ground.tolerance_at(q).numpy() * unit
    known = valid.numpy()
    return {
        "within": {f"{round(100 * d)} cm": float((error < d).mean()) for d in (0.05, 0.1, 0.2)},
        "bias_m": float(-np.median(above.numpy()) * unit),
        "valid": float(known.mean()),
        "tolerance_m": float(np.median(tolerance)),
        "outside_tolerance": float((error > tolerance)[known].mean()),
        "seconds": seconds,
    }


if __name__ == "__main__":
    main()
