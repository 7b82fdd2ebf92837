"""Fits of the toy scene, optionally with labels and points."""

from dataclasses import replace

import numpy as np

from climatenerf.field.normalisation import find_extent
from climatenerf.render.frame import render_frame
from climatenerf.scene import load_image
from climatenerf.training.dataset import TrainingPixels
from climatenerf.training.evidence.sparse_depth import read_sparse_depth
from climatenerf.training.run import load_pixels
from climatenerf.training.settings import FitSettings
from climatenerf.training.setup import make_trainer
from climatenerf.weather.world import World
from support.toy_scene import CAMERA, FIELD, TINY


def begin(scene, **settings):
    views = scene.of_split("train")
    chosen = {"size": TINY, "minutes": None, "samples_per_step": 2**15, **settings}
    extent = find_extent(np.stack([scene.c2w_world(v) for v in views]), None)
    return make_trainer(load_pixels(scene, 1), extent, FitSettings(**chosen))


def labelled(scene):
    """The scene with points on its ground, and labels of its pixels: terrain, building or sky."""
    labels, ends = [], []
    for view in scene.of_split("train"):
        _, layers = render_frame(World(FIELD), CAMERA, scene.c2w_world(view))
        d = CAMERA.directions() @ scene.c2w_world(view)[:3, :3].T
        x = scene.c2w_world(view)[:3, 3] + layers["depth"][..., None] * d
        ground = np.isfinite(layers["depth"]) & (x[..., 2] < 0.02)
        labels.append(np.where(ground, 9, np.where(np.isfinite(layers["depth"]), 2, 10)))
        ends.append(x[ground & (layers["depth"] < 6)][::40])
    views = scene.of_split("train")
    seen = np.cumsum([0] + [len(each) for each in ends])
    known = {
        view.name: replace(view, seen=np.arange(a, b))
        for view, a, b in zip(views, seen, seen[1:], strict=False)
    }
    shown = tuple(known.get(view.name, view) for view in scene.views)
    return replace(scene, points=np.concatenate(ends), views=shown), labels


def labelled_pixels(scene, labels):
    """The current photos, with labels."""
    views = scene.of_split("train")
    return TrainingPixels(
        [CAMERA],
        [0] * len(views),
        np.stack([scene.c2w_world(view) for view in views]),
        [load_image(view, scene) for view in views],
        [each.astype(np.uint8) for each in labels],
    )


def with_labels(scene, relabel, **settings):
    """A fit of the labelled scene with changed labels, after the first quarter of its steps."""
    known, labels = labelled(scene)
    views = known.of_split("train")
    extent = find_extent(np.stack([known.c2w_world(v) for v in views]), None)
    chosen = FitSettings(size=TINY, minutes=None, steps=1000, **settings)
    pixels = labelled_pixels(known, [relabel(each) for each in labels])
    trainer = make_trainer(pixels, extent, chosen, read_sparse_depth(known))
    trainer.resumed_progress = 0.5
    return trainer
