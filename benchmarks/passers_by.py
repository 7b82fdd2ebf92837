"""Measure how well transient masks cover people who pass through a capture.

python benchmarks/passers_by.py --steps 3000 --rows named unnamed quiet

Three fits of the reference street: with people in 24 photos and labels of them ("named"), with the
same photos but without these labels ("unnamed"), and without people ("quiet"). Reported are the
masked fractions of the pixels that show people and of all others, and the quality of the held-out
photos, which show no people.
"""

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import common
import numpy as np
import torch
from jaxtyping import Bool
from PIL import Image

from climatenerf.core.classes import MERGED, PERSON, UNKNOWN
from climatenerf.evaluation.heldout import evaluate
from climatenerf.scene import read_scene
from climatenerf.scene.images import load_labels
from climatenerf.scene.label_spaces import TRAIN_IDS
from climatenerf.scene.scene import Scene
from climatenerf.training.run import begin
from climatenerf.training.settings import FitSettings
from climatenerf.training.setup import compile_kernels
from climatenerf.training.trainer import Trainer
from climatenerf.training.transients import MASK_THRESHOLD

REFERENCE = Path(__file__).resolve().parents[1] / "reference"
ROWS = ("named", "unnamed", "quiet")


def without_people(scene: Scene, folder: Path) -> Scene:
    """Return the scene with labels, written to `folder`, in which people are unknown."""
    views = []
    for index, view in enumerate(scene.views):
        labels = load_labels(view, scene)
        if labels is not None:
            path = folder / f"{index}.png"
            Image.fromarray(np.where(MERGED[labels] == PERSON, UNKNOWN, labels)).save(path)
            view = replace(view, label_path=path)
        views.append(view)
    return replace(scene, views=tuple(views), label_space=TRAIN_IDS)


def people(scene: Scene) -> list[Bool[np.ndarray, "h w"]]:
    """Return the pixels of each fitted photo that show people."""
    labels = (load_labels(view, scene) for view in scene.of_split("train"))
    return [np.equal(MERGED[each], PERSON) for each in labels]


def fit(scene: Scene, settings: FitSettings, downscale: int) -> Trainer:
    """Fit a scene like `climatenerf fit`."""
    trainer = begin(scene, settings, downscale)
    compile_kernels(trainer)
    trainer.run(lambda _: None)
    trainer.field.occupancy.update(trainer.field.grid_density, 1.0, 0.8, trainer.generator)
    return trainer


def masked(trainer: Trainer, image: int, shape: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """Evaluate the mask of a photo at its pixel centres."""
    y, x = ((np.arange(side) + 0.5) / side for side in shape)
    position = torch.tensor(
        np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2), dtype=torch.float32
    )
    with torch.no_grad():
        found = trainer.masks(torch.full((len(position),), image), position) > MASK_THRESHOLD
    return found.view(shape).numpy()


def main() -> None:
    """Make the fits and print the masked fractions."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=list(ROWS))
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    settings = FitSettings(minutes=None, steps=options.steps, seed=options.seed)
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        for row in options.rows:
            scene = read_scene(REFERENCE / ("street" if row == "quiet" else "street-busy"))
            persons = people(scene)
            labelled = without_people(scene, Path(folder)) if row == "unnamed" else scene
            trainer = fit(labelled, settings, options.downscale)
            marked = [masked(trainer, i, each.shape) for i, each in enumerate(persons)]
            person, mask = np.concatenate(persons), np.concatenate(marked)
            scores = evaluate(trainer.field, scene, options.downscale, lambda *_: None, False)
            found[row] = {
                "people_pixels": float(person.mean()),
                "people_masked": float(mask[person].mean()) if person.any() else None,
                "others_masked": float(mask[~person].mean()),
                "psnr": scores["psnr"],
                "psnr_cc": scores["psnr_cc"],
            }
    question = f"transient masks after {options.steps} steps at 1/{options.downscale}"
    common.report(question, found, options.seed)


if __name__ == "__main__":
    main()
