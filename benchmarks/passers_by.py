"""What of the people who pass through a capture is masked, and what else is.

python benchmarks/passers_by.py --steps 3000 --rows named unnamed quiet

Fits the reference street with people in 24 of its photos, once with labels that name them and once
with labels that leave them open, and the street that nobody passes. Of the pixels that truly show
people the share that is masked, of all others the share that is too, and how well the held-out
photos are met, in which nobody is.
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
from climatenerf.scene import read_scene
from climatenerf.scene.images import load_labels
from climatenerf.scene.label_spaces import TRAIN_IDS
from climatenerf.scene.scene import Scene
from climatenerf.training.run import begin, evaluate
from climatenerf.training.settings import FitSettings
from climatenerf.training.trainer import Fitting
from climatenerf.training.transients import MASKED

REFERENCE = Path(__file__).resolve().parents[1] / "reference"
ROWS = ("named", "unnamed", "quiet")


def without_people(scene: Scene, folder: Path) -> Scene:
    """The scene with labels, written into `folder`, that leave open what is a person."""
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
    """The pixels of each fitted photo that show people; all photos have labels."""
    labels = (load_labels(view, scene) for view in scene.of_split("train"))
    return [np.equal(MERGED[each], PERSON) for each in labels]


def fit(scene: Scene, settings: FitSettings, downscale: int) -> Fitting:
    """A fit of the scene, as `climatenerf fit` makes it."""
    fitting = begin(scene, settings, downscale)
    fitting.run(lambda _: None)
    fitting.field.occupancy.update(fitting.field.grid_density, 1.0, 0.8, fitting.generator)
    return fitting


def masked(fitting: Fitting, image: int, shape: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """What is masked in a photo, at the middles of its pixels."""
    y, x = ((np.arange(side) + 0.5) / side for side in shape)
    place = torch.tensor(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2), dtype=torch.float32)
    with torch.no_grad():
        found = fitting.masks(torch.full((len(place),), image), place) > MASKED
    return found.view(shape).numpy()


def main() -> None:
    """Makes the fits asked for, and prints what each masked."""
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
            shown = people(scene)
            given = without_people(scene, Path(folder)) if row == "unnamed" else scene
            fitting = fit(given, settings, options.downscale)
            marked = [masked(fitting, i, each.shape) for i, each in enumerate(shown)]
            person, mask = np.concatenate(shown), np.concatenate(marked)
            scores = evaluate(fitting.field, scene, options.downscale, lambda *_: None, False)
            found[row] = {
                "people_pixels": float(person.mean()),
                "people_masked": float(mask[person].mean()) if person.any() else None,
                "others_masked": float(mask[~person].mean()),
                "psnr": scores["psnr"],
                "psnr_cc": scores["psnr_cc"],
            }
    question = f"what is masked after {options.steps} steps at 1/{options.downscale}"
    common.report(question, found, options.seed)


if __name__ == "__main__":
    main()
