"""Which normals are right, and at which size of picture: predicted ones, planes, or slopes.

python benchmarks/normals.py RUN

RUN is a fit of the reference street. Its test views are seen at their size and at odd parts of it,
so that the middles of pixels stay where the truth is known. Median angles off, without vegetation:
of the normals that the field predicts, of planes fitted to the depth picture (which stand in where
none were learned), and of the density's own slope.
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
from climatenerf.studies.ablation import density_normals

REFERENCE = Path(__file__).resolve().parents[1] / "reference" / "street"


def thinned(truth: Truth, camera: Camera, part: int) -> tuple[Truth, Camera]:
    """Each `part`th pixel of a view, and the camera that sees those alone."""
    height, width = truth.depth.shape[0] // part, truth.depth.shape[1] // part

    def some(pixels: np.ndarray) -> np.ndarray:
        return pixels[part // 2 :: part, part // 2 :: part][:height, :width]

    small = replace(camera, width=width * part, height=height * part).resized(width, height)
    own = replace(
        truth, depth=some(truth.depth), normal=some(truth.normal), label=some(truth.label)
    )
    return own, small


def main() -> None:
    """Sees the test views at each size and prints the medians."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--parts", type=int, nargs="+", default=[1, 3, 5, 9], help="odd numbers")
    options = parser.parse_args()
    if any(part % 2 == 0 for part in options.parts):
        parser.error("--parts are odd: else a small pixel's middle is the middle of no true one")
    reference = read_reference(REFERENCE)
    run = EvaluatedRun(load_field(options.run), load_scene(options.run), reference)
    check_views(run.scene, run.reference)
    if not run.field.knows_normals:
        parser.error(f"{options.run} has learned no normals")
    found = {}
    for part in options.parts:
        angles = {}
        for kind in ("predicted", "planes", "slope"):
            run.field.learned[0] = kind != "planes"
            truths, normals = [], []
            for truth in run.reference.truths:
                camera, c2w = run.camera(truth)
                own, small = thinned(truth, camera, part)
                dry = render_clean(run.field, small, c2w)
                sloped = kind == "slope"
                normals.append(
                    density_normals(run.field, dry) if sloped else dry.normal @ c2w[:3, :3]
                )
                truths.append(own)
            angles[kind] = geometry.normal_scores(normals, tuple(truths))
        found[f"{truths[0].depth.shape[1]}x{truths[0].depth.shape[0]}"] = angles
    common.report("normals by size of picture", found)


if __name__ == "__main__":
    main()
