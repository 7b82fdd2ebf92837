"""Where a fit of the reference street loses light in clear air, and how few photos look there.

python benchmarks/floaters.py RUN

Floaters (`floater_mass` in reports) of the test views' pixels, shared out by how many of the fitted
photos show the place that a pixel truly shows, by whether a pixel beside it shows what is nearer,
by distance, and by how much of its own light a pixel loses: haze takes a little of many, a surface
in the wrong place all of some. What hardly any photo shows has a depth that no photo can tell: only
a prior could. Needs `pip install ".[street]"`.
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
SAME = 0.02  # of the distance: a photo shows a place that lies in the range of its 3x3 pixels there
PHOTOS = (0, 1, 2, 3, 5, 9, 17)  # from so many photos on
METRES = (0, 20, 60)
LOST = (0, 0.1, 0.7)


def depths_of_photos(scene: Scene) -> list[Float[np.ndarray, "h w"]]:
    """Traced ray lengths (m) of every fitted photo's pixels; +inf in the sky."""
    import mitsuba as mi

    sys.path.insert(0, str(ROOT))
    from tools.reference_street.layout import build_scene
    from tools.reference_street.render import load, render_view

    with tempfile.TemporaryDirectory() as meshes:
        street = load(build_scene(), Path(meshes), threads=2)
        asked = mi.load_dict({"type": "aov", "aovs": "t:depth"})
        found = []
        for view in scene.of_split("train"):
            camera = scene.cameras[view.camera]
            seen = render_view(street, view.c2w, camera.width, camera.height, 1, 0, asked)
            depth = np.asarray(seen)[..., -1]
            found.append(np.where(depth > 0, depth, np.inf))
    return found


def times_shown(
    x: Float[np.ndarray, "n 3"], scene: Scene, depths: list[Float[np.ndarray, "h w"]]
) -> Int[np.ndarray, "n"]:
    """How many fitted photos show places (world m)."""
    count = np.zeros(len(x), int)
    for view, depth in zip(scene.of_split("train"), depths, strict=True):
        camera = scene.cameras[view.camera]
        local = (x - view.c2w[:3, 3]) @ view.c2w[:3, :3]
        ahead = np.flatnonzero(local[:, 2] > 0)
        place = np.floor(camera.project(local[ahead])).astype(int)
        inside = ((place >= 0) & (place < (camera.width, camera.height))).all(-1)
        ahead, (column, row) = ahead[inside], place[inside].T
        way = np.linalg.norm(local[ahead], axis=-1)
        farthest = maximum_filter(np.where(np.isinf(depth), 0.0, depth), 3)
        least, most = minimum_filter(depth, 3)[row, column], farthest[row, column]
        count[ahead] += (way > (1 - SAME) * least) & (way < (1 + SAME) * most)
    return count


def shares(lost: Float[np.ndarray, "n"], which: Bool[np.ndarray, "n"]) -> dict[str, float]:
    """The share of pixels that these are, and their part in the mean of all."""
    return {"pixels": float(which.mean()), "floaters": float(lost[which].sum() / len(lost))}


def main() -> None:
    """Renders the test views and prints the shares."""
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
    lost, shown, edge, way = [], [], [], []
    for truth in run.reference.truths:
        free = torch.from_numpy(geometry.free_space(truth).astype(np.float32).ravel())
        passed = (
            transmittance_to(run.field, *run.camera(truth), free).view(truth.depth.shape).numpy()
        )
        solid = ~truth.sky
        lost.append(1 - passed[solid])
        shown.append(times_shown(truth.points[solid], run.scene, photos))
        edge.append(geometry.occluded_edges(truth)[solid])
        way.append(truth.depth[solid])
    lost, shown, edge, way = (np.concatenate(each) for each in (lost, shown, edge, way))
    everything = np.ones(len(lost), bool)
    common.report(
        "floaters by how well the photos show the place",
        {
            "all": shares(lost, everything),
            "edges": shares(lost, edge),
            "photos": {
                f"{least} to {most - 1}": shares(lost, (shown >= least) & (shown < most))
                for least, most in zip(PHOTOS, (*PHOTOS[1:], len(photos) + 1), strict=True)
            },
            "metres": {
                f"from {least}": shares(lost, (way >= least) & (way < most))
                for least, most in zip(METRES, (*METRES[1:], np.inf), strict=True)
            },
            "lost": {
                f"from {least}": shares(lost, (lost >= least) & (lost < most))
                for least, most in zip(LOST, (*LOST[1:], np.inf), strict=True)
            },
        },
        0,
    )


if __name__ == "__main__":
    main()
