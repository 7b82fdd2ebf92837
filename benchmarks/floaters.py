"""Show where a fit of the reference street has density in free space, by photo coverage.

python benchmarks/floaters.py RUN

The mass of floaters (`floater_mass` in reports) of the test views' pixels is divided by four
criteria: the number of fitted photos that show the pixel's true surface point; whether a
neighbouring pixel shows a nearer surface; distance; and the fraction of light that the pixel loses.
Haze absorbs little light in many pixels, a misplaced surface all light of few pixels. The depth of
a point that hardly any photo shows can only come from a prior. Needs `pip install ".[street]"`.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import common
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import maximum_filter, minimum_filter

from climatenerf.evaluation import geometry
from climatenerf.evaluation.evaluated_run import EvaluatedRun, check_views, transmittance_to
from climatenerf.evaluation.reference import read_reference
from climatenerf.field.checkpoint import load_field
from climatenerf.scene import load_scene
from climatenerf.scene.scene import Scene

ROOT = Path(__file__).resolve().parents[1]
DEPTH_TOLERANCE = 0.02  # relative; a photo shows a point within the depths of 3x3 pixels there
PHOTOS = (0, 1, 2, 3, 5, 9, 17)  # lower edges of the bins: number of photos,
METRES = (0, 20, 60)  # distance, m,
ABSORBED = (0, 0.1, 0.7)  # fraction of light


def depths_of_photos(scene: Scene) -> list[Float[np.ndarray, "h w"]]:
    """Trace the ray lengths (m) of every fitted photo's pixels; +inf in the sky."""
    import mitsuba as mi

    sys.path.insert(0, str(ROOT))
    from tools.reference_street.layout import build_scene
    from tools.reference_street.render import load, render_view

    with tempfile.TemporaryDirectory() as meshes:
        street = load(build_scene(), Path(meshes), threads=2)
        depth_aov = mi.load_dict({"type": "aov", "aovs": "t:depth"})
        found = []
        for view in scene.of_split("train"):
            camera = scene.cameras[view.camera]
            seen = render_view(street, view.c2w, camera.width, camera.height, 1, 0, depth_aov)
            depth = np.asarray(seen)[..., -1]
            found.append(np.where(depth > 0, depth, np.inf))
    return found


def view_counts(
    x: Float[np.ndarray, "n 3"], scene: Scene, depths: list[Float[np.ndarray, "h w"]]
) -> Int[np.ndarray, "n"]:
    """Count the fitted photos that show each point (world m)."""
    count = np.zeros(len(x), int)
    for view, depth in zip(scene.of_split("train"), depths, strict=True):
        camera = scene.cameras[view.camera]
        local = (x - view.c2w[:3, 3]) @ view.c2w[:3, :3]
        ahead = np.flatnonzero(local[:, 2] > 0)
        pixel = np.floor(camera.project(local[ahead])).astype(int)
        inside = ((pixel >= 0) & (pixel < (camera.width, camera.height))).all(-1)
        ahead, (column, row) = ahead[inside], pixel[inside].T
        distance = np.linalg.norm(local[ahead], axis=-1)
        farthest = maximum_filter(np.where(np.isinf(depth), 0.0, depth), 3)
        near, far = minimum_filter(depth, 3)[row, column], farthest[row, column]
        near, far = (1 - DEPTH_TOLERANCE) * near, (1 + DEPTH_TOLERANCE) * far
        count[ahead] += (distance > near) & (distance < far)
    return count


def contribution(absorbed: Float[np.ndarray, "n"], mask: Bool[np.ndarray, "n"]) -> dict[str, float]:
    """Return the fraction of pixels in a mask, and their contribution to the mean of all."""
    return {"pixels": float(mask.mean()), "floaters": float(absorbed[mask].sum() / len(absorbed))}


def main() -> None:
    """Render the test views and print the contributions."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    options = parser.parse_args()
    run = EvaluatedRun(
        load_field(options.run),
        load_scene(options.run),
        read_reference(ROOT / "reference" / "street"),
    )
    check_views(run.scene, run.reference)
    photos = depths_of_photos(run.scene)
    absorbed, counts, edge, distance = [], [], [], []
    for truth in run.reference.truths:
        free = torch.from_numpy(geometry.free_space(truth).astype(np.float32).ravel())
        passed = (
            transmittance_to(run.field, *run.camera(truth), free).view(truth.depth.shape).numpy()
        )
        solid = ~truth.sky
        absorbed.append(1 - passed[solid])
        counts.append(view_counts(truth.points[solid], run.scene, photos))
        edge.append(geometry.occluded_edges(truth)[solid])
        distance.append(truth.depth[solid])
    absorbed, counts, edge, distance = (
        np.concatenate(each) for each in (absorbed, counts, edge, distance)
    )
    everything = np.ones(len(absorbed), bool)
    common.report(
        "density in free space by photo coverage",
        {
            "all": contribution(absorbed, everything),
            "edges": contribution(absorbed, edge),
            "photos": {
                f"{low} to {high - 1}": contribution(absorbed, (counts >= low) & (counts < high))
                for low, high in zip(PHOTOS, (*PHOTOS[1:], len(photos) + 1), strict=True)
            },
            "metres": {
                f"from {low}": contribution(absorbed, (distance >= low) & (distance < high))
                for low, high in zip(METRES, (*METRES[1:], np.inf), strict=True)
            },
            "absorbed": {
                f"from {low}": contribution(absorbed, (absorbed >= low) & (absorbed < high))
                for low, high in zip(ABSORBED, (*ABSORBED[1:], np.inf), strict=True)
            },
        },
        0,
    )


if __name__ == "__main__":
    main()
