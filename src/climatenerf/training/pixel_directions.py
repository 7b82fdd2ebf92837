"""Directions of pixels, from a coarse lattice of them.

Directions of every pixel would take four times the memory of the photos where each photo has a
camera of its own. Distortion is smooth, so a lattice does, and for a pinhole it is exact. Cameras
whose distortion has no inverse everywhere get a direction for each pixel.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.core.cameras import Camera
from climatenerf.core.device import to_device
from climatenerf.core.vectors import unit

SPACING = 4  # pixels
WIDE = 0.1  # cosine from the axis below which directions are not scaled to depth 1
EXACT = 1e-2  # pixels by which a lattice's point may come back elsewhere


class Directions:
    """Directions of all pixels of some cameras."""

    def __init__(self, cameras: Sequence[Camera]):
        found = [_lattice(camera) for camera in cameras]
        lattices = [lattice for lattice, _ in found]
        counts = [each.shape[0] * each.shape[1] for each in lattices]
        self.spacing = torch.tensor([spacing for _, spacing in found])
        self.across = torch.tensor([each.shape[1] for each in lattices])
        self.start = torch.tensor([0, *np.cumsum(counts)[:-1].tolist()])
        flat = [each.reshape(-1, 3) for each in lattices]
        self.lattice = to_device(np.concatenate(flat).astype(np.float32))

    def of(
        self, camera: Int[Tensor, "n"], column: Int[Tensor, "n"], row: Int[Tensor, "n"]
    ) -> Float[Tensor, "n 3"]:
        """Unit directions, in the cameras' frames, through the middles of pixels."""
        spacing = self.spacing[camera]
        corner_of_pixel = torch.where(spacing > 1, 0.5, 0.0)
        x, y = (column + corner_of_pixel) / spacing, (row + corner_of_pixel) / spacing
        i, j = x.long(), y.long()
        u, v = (x - i)[:, None], (y - j)[:, None]
        across = self.across[camera]
        corner = self.start[camera] + j * across + i
        upper = (1 - u) * self.lattice[corner] + u * self.lattice[corner + 1]
        below = corner + across
        lower = (1 - u) * self.lattice[below] + u * self.lattice[below + 1]
        return unit((1 - v) * upper + v * lower)


def _lattice(camera: Camera) -> tuple[Float[np.ndarray, "h w 3"], int]:
    """Vectors along the rays through every `SPACING`th pixel corner, to past the last pixel.

    Where the distortion folds, those through every pixel's middle, and a row and a column more.
    Also the spacing.
    """
    x = np.arange(-(-camera.width // SPACING) + 1) * SPACING
    y = np.arange(-(-camera.height // SPACING) + 1) * SPACING
    pixels = np.stack(np.meshgrid(x, y), axis=-1).astype(np.float64)
    d = camera.directions(pixels)
    with np.errstate(invalid="ignore"):
        back = np.abs(camera.project(d) - pixels).max(initial=0.0)
    if not back < EXACT:
        return np.pad(camera.directions(), ((0, 1), (0, 1), (0, 0)), mode="edge"), 1
    z = d[..., 2:].astype(np.float64)
    # Of a plane without distortion the lattice is evenly spaced; a fisheye may look backwards.
    return (d / z if z.min() > WIDE else d), SPACING
