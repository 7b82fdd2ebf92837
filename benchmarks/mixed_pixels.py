"""Measure the effect of mixed pixels on the scores of the reference street.

python benchmarks/mixed_pixels.py --rays 6 --run RUN

The ground truth of a pixel is that of its central ray; its photo is the mean over its area. Pixels
at the edge of leaves and sky contain both. With `rays` times `rays` rays per pixel the script
computes the scores of a perfect field: the fraction of true sky pixels that are sky over 99 % of
their area, the same of those with sky neighbours only, and the area in front of the central
surface. For a fit of the street, RUN, it reports the fraction of empty pixels among the pure and
the mixed sky pixels, and among the sky pixels of every eighth fitted photo. Needs `pip install
".[street]"`.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import common
import numpy as np
import torch
from jaxtyping import Float

from climatenerf.core.classes import MERGED, SKY
from climatenerf.evaluation.evaluated_run import EvaluatedRun, check_views, transmittance_to
from climatenerf.evaluation.geometry import EMPTY, emptiness_scores, free_space
from climatenerf.evaluation.reference import read_reference
from climatenerf.field.checkpoint import load_field
from climatenerf.scene import load_scene
from climatenerf.scene.images import load_labels

ROOT = Path(__file__).resolve().parents[1]


def depths(scene, pose: Float[np.ndarray, "4 4"], size: tuple[int, int], rays: int):
    """Trace ray lengths at random points of each pixel's area, [h, w, rays²]; +inf in the sky."""
    import mitsuba as mi

    from tools.reference_street.render import render_view

    width, height = size
    depth_aov = mi.load_dict({"type": "aov", "aovs": "t:depth"})
    t = render_view(scene, pose, width * rays, height * rays, 1, 0, depth_aov)[..., -1]
    t = np.where(t > 0, t, np.inf).reshape(height, rays, width, rays)
    return t.transpose(0, 2, 1, 3).reshape(height, width, rays * rays)


def transmittance(fitted, camera, c2w) -> Float[np.ndarray, "h w"]:
    """Return the transmittance of the whole ray of each pixel of a view."""
    endless = torch.full((camera.width * camera.height,), 1e9)
    return transmittance_to(fitted, camera, c2w, endless).view(camera.height, camera.width).numpy()


def run_scores(folder: Path, truths, pure: list[np.ndarray]) -> dict[str, float]:
    """Return the fractions of empty sky pixels of a fit; `pure` marks pixels that are all sky."""
    reference = read_reference(ROOT / "reference" / "street")
    run = EvaluatedRun(load_field(folder), load_scene(folder), reference)
    check_views(run.scene, run.reference)
    passed = [transmittance(run.field, *run.camera(truth)) for truth in truths]
    empty = np.concatenate([(p >= EMPTY)[t.sky] for p, t in zip(passed, truths, strict=True)])
    all_sky = np.concatenate([p[t.sky] for p, t in zip(pure, truths, strict=True)])
    known = []
    for view in run.scene.of_split("train")[::8]:
        label = load_labels(view, run.scene)
        assert label is not None
        sky = MERGED[label] == SKY
        camera, c2w = run.scene.cameras[view.camera], run.scene.c2w_world(view)
        known.append((transmittance(run.field, camera, c2w) >= EMPTY)[sky])
    return {
        "pure_empty": float(empty[all_sky].mean()),
        "mixed_empty": float(empty[~all_sky].mean()),
        "fitted_photos_empty": float(np.concatenate(known).mean()),
    }


def main() -> None:
    """Trace the test views; print the scores of a perfect field, and of a run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rays", type=int, default=6)
    parser.add_argument("--run", type=Path, help="a fit of the reference street")
    options = parser.parse_args()
    rays = options.rays
    sys.path.insert(0, str(ROOT))
    from tools.reference_street.layout import build_scene, heldout_poses
    from tools.reference_street.render import load

    truths = read_reference(ROOT / "reference" / "street").truths
    with tempfile.TemporaryDirectory() as scratch:
        scene = load(build_scene(), Path(scratch), threads=2)
    poses = dict(heldout_poses())
    absorbed, skyward = [], []
    for truth in truths:
        t = depths(scene, poses[truth.name], truth.depth.shape[::-1], rays)
        absorbed.append((t < free_space(truth)[..., None]).mean(-1))
        skyward.append(np.isinf(t).mean(-1))
    found = {"perfect": emptiness_scores(absorbed, skyward, truths)}
    if options.run:
        found["run"] = run_scores(options.run, truths, [s > EMPTY for s in skyward])
    common.report("effect of mixed pixels", found)


if __name__ == "__main__":
    main()
