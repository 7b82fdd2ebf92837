"""Score how far wrong labels change styled pictures.

python benchmarks/flipped_labels.py
python benchmarks/flipped_labels.py --steps 900 --downscale 2 --fraction 0.1

The reference street is fitted three times: with its labels; with a fraction of their area, in
round patches, turned into other classes; and with its labels and another seed, which shows how far
two fits differ anyway. Each is rendered clean and in every season from the test cameras.
`labels` and `seed` are RMS differences from the first fit, 8-bit values.
"""

import argparse
import dataclasses
import tempfile
from pathlib import Path

import common
import numpy as np
from PIL import Image

from climatenerf.field.checkpoint import load_field
from climatenerf.render.session import RenderSession
from climatenerf.scene import load_scene
from climatenerf.scene.scene import Scene
from climatenerf.training.run import fit_scene
from climatenerf.training.settings import FitSettings
from climatenerf.weather.season.palettes import SEASONS
from climatenerf.weather.season.parameters import Season
from climatenerf.weather.weather import Weather

STREET = Path(__file__).resolve().parents[1] / "reference" / "street"
RADII = (4, 20)  # of the patches, pixels


def flipped(label: np.ndarray, fraction: float, random: np.random.Generator) -> np.ndarray:
    """Return a label picture with round patches of other classes of the same picture."""
    row, column = np.mgrid[: label.shape[0], : label.shape[1]]
    kinds, found, wrong = np.unique(label), label.copy(), np.zeros(label.shape, bool)
    while wrong.mean() < fraction:
        at = random.integers(label.shape[0]), random.integers(label.shape[1])
        patch = (row - at[0]) ** 2 + (column - at[1]) ** 2 < random.integers(*RADII) ** 2
        others = kinds[kinds != label[at]]
        found[patch] = random.choice(others)
        wrong |= patch & (found != label)
    return found


def with_flipped_labels(scene: Scene, folder: Path, fraction: float) -> Scene:
    """Return the scene with flipped labels for the photos that are fitted to."""
    random, views = np.random.default_rng(0), []
    for view in scene.views:
        if view.label_path is not None and view.split == "train":
            label = flipped(np.asarray(Image.open(view.label_path)), fraction, random)
            path = folder / view.label_path.name
            Image.fromarray(label).save(path)
            view = dataclasses.replace(view, label_path=path)
        views.append(view)
    return dataclasses.replace(scene, views=tuple(views))


def pictures(run: Path, scene: Scene, downscale: int) -> dict[str, np.ndarray]:
    """Render the test views clean and in every season, as 8-bit values."""
    field, found = load_field(run), {}
    for name in ("captured", *SEASONS):
        session = RenderSession(field, scene, Weather(season=Season(kind=name)))
        frames = []
        for view in scene.of_split("heldout"):
            camera = scene.cameras[view.camera]
            camera = camera.resized(camera.width // downscale, camera.height // downscale)
            frames.append(session.frame(camera, scene.c2w_world(view)).picture)
        found[name] = np.stack(frames).astype(np.float64)
    return found


def rms(a: np.ndarray, b: np.ndarray) -> float:
    """Return the RMS difference."""
    return float(np.sqrt(((a - b) ** 2).mean()))


def main() -> None:
    """Fit, render, compare and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=900)
    parser.add_argument("--downscale", type=int, default=2)
    parser.add_argument("--fraction", type=float, default=0.1)
    options = parser.parse_args()
    scene, found = load_scene(STREET), {}
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        wrong = with_flipped_labels(scene, folder, options.fraction)
        for name, place, seed in (("true", scene, 0), ("labels", wrong, 0), ("seed", scene, 1)):
            settings = FitSettings(minutes=None, steps=options.steps, seed=seed)
            silent = (lambda *_: None,) * 2
            fit_scene(place, folder / name, settings, options.downscale, False, *silent)
            found[name] = pictures(folder / name, scene, options.downscale)
    results = {
        season: {
            name: rms(found[name][season], found["true"][season]) for name in ("labels", "seed")
        }
        for season in found["true"]
    }
    common.report("styled pictures with wrong labels", results)


if __name__ == "__main__":
    main()
