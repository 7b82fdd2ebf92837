"""Photos of a textured wall, the plane y = 4 + 0.3 x (m), from cameras in a row."""

import numpy as np

from climatenerf.core.cameras import Camera
from climatenerf.core.device import CPU
from climatenerf.training.dataset import TrainingPixels

PINHOLE = Camera(96, 72, 90.0, 90.0, 48.0, 36.0)
DISTORTED = Camera(96, 72, 90.0, 90.0, 47.0, 36.5, k1=-0.12, k2=0.02, p1=1e-3)


def pattern(seed=0):
    """Return a smooth, non-repeating texture: grey values in [0,1] of plane coordinates."""
    random = np.random.default_rng(seed)
    wave = random.normal(size=(60, 2)) * random.uniform(2.0, 14.0, (60, 1))
    turn, size = random.uniform(0, 2 * np.pi, 60), 1 / np.linalg.norm(wave, axis=-1) ** 0.5

    def grey(x):
        value = (np.sin(x @ wave.T + turn) * size).sum(-1)
        return np.clip(0.5 + 0.5 * value / (3 * size.sum() ** 0.5), 0, 1)

    return grey


def rows_of_cameras(count=5):
    """Cameras in a row 0.3 m apart, all looking along +y, x to the right, z up."""
    found = np.tile(np.eye(4), (count, 1, 1))
    for i, pose in enumerate(found):
        pose[:3, :3] = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
        pose[:3, 3] = ((i - count // 2) * 0.3, 0.0, 0.1 * (i % 2))
    return found


def wall(camera, pose, tilt=0.3):
    """Return each pixel's ray length (m) to the plane y = 4 + tilt x, and its (x, z) there."""
    d = camera.directions().astype(float) @ pose[:3, :3].T
    eye = pose[:3, 3]
    t = (4.0 + tilt * eye[0] - eye[1]) / (d[..., 1] - tilt * d[..., 0])
    x = eye + t[..., None] * d
    return t, x[..., [0, 2]]


def photos(camera, texture, c2w=None, labels=None, masks=None, exposure=lambda i: 1.0, device=CPU):
    """Return training pixels; `texture(i, t, x)` maps ray lengths and plane coordinates to grey."""
    c2w = rows_of_cameras() if c2w is None else c2w
    images = []
    for i, pose in enumerate(c2w):
        grey = texture(i, *wall(camera, pose)) * exposure(i)
        images.append(np.repeat((255 * grey + 0.5).astype(np.uint8)[..., None], 3, -1))
    return TrainingPixels([camera], [0] * len(c2w), c2w, images, labels, masks, device=device)
