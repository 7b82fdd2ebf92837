"""A capture with texture on ground and walls, points with observations and depths: for checks."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image
from scipy import ndimage

from climatenerf.core.cameras import Camera
from climatenerf.scene.scene import Scene, View

from .scene_builders import look_at

CAMERA = Camera(320, 240, 260.0, 260.0, 160.0, 120.0)
HALF = 12.0  # m: walls at +-HALF around a square yard


def textured_poses(count=10):
    """Cameras on a curved walk through the yard, looking aside and slightly down."""
    turns = np.linspace(0, 2 * np.pi, count, endpoint=False)
    eyes = [(5 * np.cos(t), 5 * np.sin(t), 1.6 + 0.1 * np.sin(3 * t)) for t in turns]
    return [look_at(eye, (-eye[0] * 1.5, -eye[1] * 1.5, 0.6)) for eye in eyes]


def textured_yard():
    """A textured image [n, n] that is looked up by the two coordinates of each plane."""
    random = np.random.default_rng(3)
    fine, coarse = random.normal(size=(2, 512, 512))
    texture = ndimage.gaussian_filter(fine, 1.5, mode="wrap") * 3
    texture += ndimage.gaussian_filter(coarse, 6, mode="wrap") * 8
    return np.clip(128 + 90 * texture / np.abs(texture).std() / 2, 0, 255).astype(np.uint8)


def hits(origin, directions):
    """Ray lengths to the ground and the walls, and texture coordinates in m; all [h, w]."""
    with np.errstate(divide="ignore"):
        walls = np.stack(
            [
                (np.sign(directions[..., axis]) * HALF - origin[axis]) / directions[..., axis]
                for axis in (0, 1)
            ]
        )
        ground = np.where(directions[..., 2] < 0, -origin[2] / directions[..., 2], np.inf)
    every = np.concatenate([walls, ground[None]])
    nearest = every.argmin(axis=0)
    length = every.min(axis=0)
    x, y, z = np.moveaxis(origin + length[..., None] * directions, -1, 0)
    u = np.where(nearest == 0, y + 40.0, x + 20.0 * (nearest == 1))
    v = np.where(nearest == 2, y, z)
    return length, u, v


def textured_scene(folder: Path, count=10, seen=True) -> Scene:
    """Photos and points of the yard in its own frame, in metres."""
    texture = textured_yard()
    views, points, rows = [], [], []
    poses = textured_poses(count)
    for i, pose in enumerate(poses):
        directions = CAMERA.directions().astype(float) @ pose[:3, :3].T
        length, u, v = hits(pose[:3, 3], directions)
        at = (np.stack([u, v]) * 24).astype(int) % len(texture)
        path = folder / f"{i:03}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(texture[at[0], at[1]]).convert("RGB").save(path)
        x, y = np.random.default_rng(i).integers((320, 240), size=(120, 2)).T
        own = pose[:3, 3] + length[y, x, None] * directions[y, x]
        rows.append(np.arange(len(own)) + sum(map(len, points)))
        points.append(own)
        views.append(View(path.name, path, 0, pose))
    if seen:
        views = [replace(view, seen=row) for view, row in zip(views, rows, strict=True)]
    return Scene(folder, "test", (CAMERA,), tuple(views), np.concatenate(points))


def depth_of(pose):
    """Z-depths [h, w] of a photo of the yard, m."""
    local = CAMERA.directions().astype(float)
    length, _, _ = hits(pose[:3, 3], local @ pose[:3, :3].T)
    return length * local[..., 2]
