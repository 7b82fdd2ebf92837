"""Compare three kinds of normals at several picture sizes: predicted, planes, density gradient.

python benchmarks/normals.py RUN

RUN is a fit of the reference street. Its test views are rendered at full size and at odd fractions
of it, so that pixel centres coincide with those of the truth. Reported are the median angles
without vegetation of the normals that the field predicts, of planes fitted to the depth picture
(used for fields without predicted normals), and of the density's gradient.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import common
import numpy as np

from climatenerf.evaluation import geometry
from climatenerf.evaluation.evaluated_run import EvaluatedRun, check_views, render_clean
from climatenerf.evaluation.reference import Truth, read_reference
from climatenerf.field.checkpoint import load_field
from climatenerf.scene import Camera, load_scene
from climatenerf.studies.geometry_ablation import density_normals

REFERENCE = Path(__file__).resolve().parents[1] / "reference" / "street"


def subsampled(truth: Truth, camera: Camera, part: int) -> tuple[Truth, Camera]:
    """Return every `part`th pixel of a view, and the camera with these pixels."""
    height, width = truth.depth.shape[0] // part, truth.depth.shape[1] // part

    def subset(pixels: np.ndarray) -> np.ndarray:
        return pixels[part // 2 :: part, part // 2 :: part][:height, :width]

    small = replace(camera, width=width * part, height=height * part).resized(width, height)
    subset_truth = replace(
        truth, depth=subset(truth.depth), normal=subset(truth.normal), label=subset(truth.label)
    )
    return subset_truth, small


def main() -> None:
    """Render the test views at each size and print the medians."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--parts", type=int, nargs="+", default=[1, 3, 5, 9], help="odd numbers")
    options = parser.parse_args()
    if any(part % 2 == 0 for part in options.parts):
        parser.error("--parts must be odd, so that centres of small and full-size pixels coincide")
    reference = read_reference(REFERENCE)
    run = EvaluatedRun(load_field(options.run), load_scene(options.run), reference)
    check_views(run.scene, run.reference)
    if not run.field.knows_normals:
        parser.error(f"{options.run} has no predicted normals; fit with labels")
    found = {}
    for part in options.parts:
        angles = {}
        for kind in ("predicted", "planes", "slope"):
            run.field.learned[0] = kind != "planes"
            truths, normals = [], []
            for truth in run.reference.truths:
                camera, c2w = run.camera(truth)
                small_truth, small = subsampled(truth, camera, part)
                view = render_clean(run.field, small, c2w)
                from_density = kind == "slope"
                normals.append(
                    density_normals(run.field, view) if from_density else view.normal @ c2w[:3, :3]
                )
                truths.append(small_truth)
            angles[kind] = geometry.normal_scores(normals, tuple(truths))
        found[f"{truths[0].depth.shape[1]}x{truths[0].depth.shape[0]}"] = angles
    common.report("normals by picture size", found)


if __name__ == "__main__":
    main()
