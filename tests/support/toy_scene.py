"""Boxes on plain ground under a sky, photographed from a circle: fast to render and to fit."""

import numpy as np
import torch
from PIL import Image

from climatenerf.core.cameras import Camera
from climatenerf.field.presets import FieldSize
from climatenerf.render.frame import FrameOptions, render_frame
from climatenerf.scene.scene import Scene, View
from climatenerf.weather.world import World
from support.analytic_fields import AnalyticField, Box, HalfSpace

TINY = FieldSize(
    geometry_levels=6,
    geometry_log2_rows=13,
    geometry_finest=128,
    geometry_hidden=32,
    appearance_levels=6,
    appearance_log2_rows=13,
    appearance_finest=128,
    colour_hidden=32,
    coarsest=8,
    embedding=2,
    sky_levels=2,
    sky_log2_rows=9,
    sky_finest=16,
    sky_hidden=8,
    occupancy_side=32,
    cascades=4,
)
CAMERA = Camera(48, 36, 40.0, 40.0, 24.0, 18.0)
FIELD = AnalyticField(
    [
        HalfSpace((0.0, 0.0, 1.0), 0.0, (0.12, 0.1, 0.08)),
        Box((-0.6, -0.6, 0.0), (0.6, 0.6, 1.2), (0.7, 0.12, 0.08)),
        Box((0.6, -0.9, 0.0), (1.4, -0.3, 0.4), (0.05, 0.4, 0.1)),
        Box((-1.2, 0.2, 0.0), (-0.6, 1.4, 0.3), (0.7, 0.6, 0.1)),
    ],
    box=((-24.0, -24.0, -1.0), (24.0, 24.0, 4.0)),
)


def poses(count: int = 24) -> list[np.ndarray]:
    """Cameras on a circle of 3 m, looking at the box."""
    found = []
    for i in range(count):
        turn = 2 * np.pi * i / count
        eye = np.array([3 * np.cos(turn), 3 * np.sin(turn), 1.3 + 0.3 * np.sin(3 * turn)])
        forward = np.array([0.0, 0.0, 0.6]) - eye
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        c2w = np.eye(4)
        c2w[:3] = np.stack([right, np.cross(forward, right), forward, eye], axis=-1)
        found.append(c2w)
    return found


def picture(c2w: np.ndarray) -> np.ndarray:
    torch.manual_seed(0)
    return render_frame(World(FIELD), CAMERA, c2w, FrameOptions(supersample=2))[0]


def make_scene(folder) -> Scene:
    """Write the toy scene to disk; every sixth picture is held out."""
    views = []
    for i, c2w in enumerate(poses()):
        path = folder / "images" / f"{i:02d}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(picture(c2w)).save(path)
        views.append(View(path.name, path, 0, c2w, "heldout" if i % 6 == 0 else "train"))
    return Scene(folder, "toy", (CAMERA,), tuple(views))
