"""Measure which settings prevent a degenerate fit with density in front of each camera.

python benchmarks/fit_settings.py --seeds 3

The scene is the tests' toy: boxes on plain ground, 20 photos of 48x36, 400 small steps per fit.
Plain ground constrains depth weakly, so a degenerate fit is visible: its training error falls while
held-out views become worse than a picture of one colour. Prints the held-out PSNR of each seed.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import common  # first: sets the threads' variables
import numpy as np

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / "tests")]

from support.toy_scene import CAMERA, TINY, make_scene  # noqa: E402

from climatenerf.evaluation.metrics import psnr  # noqa: E402
from climatenerf.field.normalisation import find_extent  # noqa: E402
from climatenerf.render.volume import render_view  # noqa: E402
from climatenerf.scene import Scene, load_image  # noqa: E402
from climatenerf.training.run import load_pixels  # noqa: E402
from climatenerf.training.schedule import Schedule  # noqa: E402
from climatenerf.training.settings import FitSettings, Losses  # noqa: E402
from climatenerf.training.setup import compile_kernels  # noqa: E402
from climatenerf.training.trainer import make_trainer  # noqa: E402

VARIANTS = {
    "default": {},
    "inclusion probability at least 0.1": {"schedule": Schedule(min_inclusion_probability=0.1)},
    "inclusion probability at least 0.1, 16 samples": {
        "schedule": Schedule(min_inclusion_probability=0.1, selected_per_ray=16)
    },
    "inclusion probability at least 0.5": {"schedule": Schedule(min_inclusion_probability=0.5)},
    "near density from the start": {"schedule": Schedule(first_near=0.0)},
    "no below-horizon opacity": {"losses": Losses(below_horizon_opacity=0.0)},
    "view-dependent colour from the start": {"schedule": Schedule(view=(1.0, 1.0))},
}


def heldout_psnr(scene: Scene, seed: int, variant: dict) -> float:
    """Fit a variant; return the mean PSNR of the held-out views."""
    settings = FitSettings(
        size=TINY, minutes=None, steps=400, samples_per_step=2**15, seed=seed, **variant
    )
    views = scene.of_split("train")
    extent = find_extent(np.stack([scene.c2w_world(view) for view in views]), None)
    trainer = make_trainer(load_pixels(scene, 1), extent, settings)
    compile_kernels(trainer)
    trainer.run(lambda _: None)
    found = []
    for view in scene.of_split("heldout"):
        photo = load_image(view, scene).astype(np.float32) / 255
        found.append(psnr(render_view(trainer.field, CAMERA, scene.c2w_world(view)), photo))
    return float(np.mean(found))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        scene = make_scene(Path(folder))
        rows = {}
        for name, variant in VARIANTS.items():
            values = [heldout_psnr(scene, seed, variant) for seed in range(options.seeds)]
            rows[name] = {"psnr": values, **common.spread(values)}
            print(f"{name}: {[round(v, 1) for v in values]}", file=sys.stderr)
    common.report("held-out PSNR of the toy scene by setting", rows)


if __name__ == "__main__":
    main()
