"""Measure the effect of relative depth without other depth supervision: the paper's ablation.

python benchmarks/monocular.py --minutes 4 --keep runs/monocular

The capture is the reference street with a simulated network's depth: the true inverse z-depth of
each photo with a random scale and offset, blurred, and with smooth relative errors of a tenth. (The
project has no network weights.) It is fitted at half size without sparse points and ground height,
with and without that depth. Ground holes, depth and normals are scored against the truth. Needs
`pip install ".[street]"`.
"""

import argparse
import shutil
import sys
import tempfile
from pathlib import Path

import common
import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter

from climatenerf.evaluation.evaluated_run import EvaluatedRun
from climatenerf.evaluation.reference import read_reference
from climatenerf.field.checkpoint import load_field
from climatenerf.scene import load_scene, read_scene
from climatenerf.studies.geometry_ablation import score_row
from climatenerf.training.run import fit_scene
from climatenerf.training.settings import FitSettings, Losses

ROOT = Path(__file__).resolve().parents[1]
REFERENCE = ROOT / "reference" / "street"
WIDTH, HEIGHT = 192, 108
BLUR = 1.5  # pixels
ERROR, ERROR_WIDTH = 0.1, 24.0  # relative to the inverse depth; width of the errors, pixels
ROWS = {
    "no depth": Losses(sparse_depth=0.0, ground_height=0.0, monocular_depth=0.0),
    "relative depth": Losses(sparse_depth=0.0, ground_height=0.0),
    "sparse points": Losses(monocular_depth=0.0),
    "both": Losses(),
}


def inverse_z(scene, pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "h w"]:
    """Trace the true inverse z-depth, 1/m, through the pixel centres; 0 in the sky."""
    import mitsuba as mi

    from tools.reference_street.truth import pixel_rays

    rays = pixel_rays(pose, WIDTH, HEIGHT)
    out = np.zeros((HEIGHT, WIDTH))
    start = mi.Point3f(*pose[:3, 3])
    for pixel in np.ndindex(HEIGHT, WIDTH):
        hit = scene.ray_intersect_preliminary(mi.Ray3f(start, mi.Vector3f(*rays[pixel])))
        if hit.is_valid():
            out[pixel] = 1 / (float(hit.t) * float(rays[pixel] @ pose[:3, 2]))
    return out


def simulate_network(
    inverse: Float[np.ndarray, "h w"], random: np.random.Generator
) -> Float[np.ndarray, "h w"]:
    """Blur an inverse depth; add smooth errors and a random scale and offset."""
    wave = gaussian_filter(random.normal(size=inverse.shape), ERROR_WIDTH)
    seen = gaussian_filter(inverse * (1 + ERROR * wave / wave.std()), BLUR)
    return random.uniform(2.0, 20.0) * seen + random.uniform(0.0, 0.5)


def make_capture(folder: Path, seed: int) -> None:
    """Copy the reference street's photos, labels and points, and write relative depths."""
    sys.path.insert(0, str(ROOT))
    from tools.reference_street.layout import build_scene, camera_poses
    from tools.reference_street.render import load

    for name in ("images", "labels"):
        shutil.copytree(REFERENCE / name, folder / name)
    for name in ("scene.json", "points.ply", "points_seen.npz"):
        shutil.copy(REFERENCE / name, folder / name)
    (folder / "depth_relative").mkdir()
    random = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as meshes:
        scene = load(build_scene(), Path(meshes))
        for name, pose in camera_poses():
            relative = simulate_network(inverse_z(scene, pose), random).astype(np.float32)
            path = folder / "depth_relative" / f"{Path(name).stem}.npz"
            np.savez_compressed(path, inverse_depth=relative)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=4.0)
    parser.add_argument("--rows", nargs="+", choices=list(ROWS), default=list(ROWS))
    parser.add_argument("--keep", type=Path, help="folder for the capture and the runs")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        work = options.keep or Path(temporary)
        if not (work / "capture").exists():
            work.mkdir(parents=True, exist_ok=True)
            (work / "new").mkdir()
            make_capture(work / "new", options.seed)
            (work / "new").rename(work / "capture")
        scene = read_scene(work / "capture")
        found = {}
        for name in options.rows:
            settings = FitSettings(minutes=options.minutes, losses=ROWS[name], seed=options.seed)
            folder = work / name.replace(" ", "-")
            fit_scene(scene, folder, settings, 2, False, lambda _: None, lambda *_: None)
            run = EvaluatedRun(load_field(folder), load_scene(folder), read_reference(REFERENCE))
            found[name], _ = score_row(run, settings, False)
            print(name, found[name], file=sys.stderr)
    common.report("fits with and without relative depth", found, options.seed)


if __name__ == "__main__":
    main()
