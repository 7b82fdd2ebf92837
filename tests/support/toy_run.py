"""Short fits of the toy scene that write a run folder, and ways to interrupt them."""

import errno
import os

import numpy as np

from climatenerf.field.sampler import Sampler
from climatenerf.render import photo_rays
from climatenerf.training import run as run_module
from climatenerf.training.run import fit_scene, load_pixels
from climatenerf.training.settings import FitSettings
from climatenerf.training.setup import make_trainer
from support.toy_scene import TINY


def limit_cost(monkeypatch):
    """Reduce the preview and the rays that are traced: haze after a few steps renders slowly."""
    monkeypatch.setattr(photo_rays, "MAX_RAYS", 4000)
    monkeypatch.setattr(run_module, "PREVIEW_WIDTH", 32)
    mark_seen = Sampler.mark_seen
    monkeypatch.setattr(Sampler, "mark_seen", lambda self, o, d: mark_seen(self, o[:50], d[:50]))


def nothing(*_):
    pass


def fitted(scene, folder, steps=6, resume=False, report=nothing, evaluated=nothing, **settings):
    chosen = {"size": TINY, "minutes": None, "samples_per_step": 2**13, **settings}
    settings = FitSettings(steps=steps, **chosen)
    return fit_scene(scene, folder, settings, 1, resume, report, evaluated)


def contents(folder):
    return {p.name: p.read_bytes() for p in folder.iterdir() if p.is_file()}


def full_disk_for(name, monkeypatch):
    """Let renaming onto a file of this name fail as on a full disk."""
    real = os.replace

    def replace(source, target):
        if os.path.basename(target) == name:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(source, target)

    monkeypatch.setattr(os, "replace", replace)


def begin(scene, **settings):
    views = scene.of_split("train")
    poses = np.stack([scene.c2w_world(v) for v in views])
    chosen = {"size": TINY, "minutes": None, "samples_per_step": 2**13, **settings}
    extent = run_module.find_extent(poses, None)
    pixels, settings = load_pixels(scene, 1), FitSettings(**chosen)
    points = run_module.unmasked_sparse_depth(scene, pixels)
    return make_trainer(pixels, extent, settings, points)


def stop_at(step):
    def report(state):
        if state.step == step:
            raise KeyboardInterrupt

    return report
