"""A tower on flat ground, photographed from a circle, with its true labels."""

import numpy as np
import torch

from climatenerf.core.cameras import Camera
from climatenerf.core.classes import BUILDING, SKY

CAMERA = Camera(80, 60, 60.0, 60.0, 40.0, 30.0)
TOWER = (np.array([-0.5, -0.5, 0.0]), np.array([0.5, 0.5, 2.0]))
GROUND = 0.0


def poses(count, distance=6.0, height=1.0):
    """Horizontal cameras on a circle, looking at the tower."""
    found = []
    for i in range(count):
        turn = 2 * np.pi * i / count
        eye = np.array([distance * np.cos(turn), distance * np.sin(turn), height])
        forward = np.array([0.0, 0.0, height]) - eye
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0, 0, 1.0])
        c2w = np.eye(4)
        c2w[:3] = np.stack([right, np.cross(forward, right), forward, eye], axis=-1)
        found.append(c2w)
    return np.stack(found)


def labels(camera, c2w):
    """True labels: the tower, the ground, and sky elsewhere."""
    d = camera.directions() @ c2w[:3, :3].T
    eye = c2w[:3, 3]
    with np.errstate(divide="ignore"):
        near = np.minimum((TOWER[0] - eye) / d, (TOWER[1] - eye) / d).max(-1)
        far = np.maximum((TOWER[0] - eye) / d, (TOWER[1] - eye) / d).min(-1)
    solid = ((near < far) & (far > 0)) | (d[..., 2] < 0)
    return np.where(solid, BUILDING, SKY).astype(np.uint8)


def in_matter(x, margin=0.0):
    """Whether positions x (m) lie in the tower or the ground, each grown by a margin (m)."""
    low, high = (torch.tensor(each).float() for each in TOWER)
    inside = ((x > low - margin) & (x < high + margin)).all(-1)
    return inside | (x[:, 2] < GROUND + margin)
