"""Directions of pixels, interpolated on a coarse lattice.

Where each photo has its own camera, the directions of all pixels would take four times the memory
of the photos. Distortion is smooth, so a lattice suffices, and for a pinhole it is exact. Cameras
whose distortion cannot be inverted everywhere get a direction for each pixel.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.core.cameras import Camera
from climatenerf.core.device import CPU, to_device
from climatenerf.core.vectors import unit

SPACING = 4  # pixels between lattice points
MIN_COSINE = 0.1  # to the axis; below it directions are not scaled to z = 1
MAX_ERROR = 1e-2  # pixels between a lattice point and its direction projected back


class Directions:
    """Directions of all pixels of a list of cameras."""

    def __init__(self, cameras: Sequence[Camera], device: torch.device = CPU):
        """Compute the lattices of the cameras, and store them on a device."""
        found = [_lattice(camera) for camera in cameras]
        lattices = [lattice for lattice, _ in found]
        counts = [each.shape[0] * each.shape[1] for each in lattices]
        self.spacing = torch.tensor([spacing for _, spacing in found], device=device)
        self.across = torch.tensor([each.shape[1] for each in lattices], device=device)
        self.start = torch.tensor([0, *np.cumsum(counts)[:-1].tolist()], device=device)
        flat = [each.reshape(-1, 3) for each in lattices]
        self.lattice = to_device(np.concatenate(flat).astype(np.float32), device)

    def of(
        self, camera: Int[Tensor, "n"], column: Int[Tensor, "n"], row: Int[Tensor, "n"]
    ) -> Float[Tensor, "n 3"]:
        """Return unit directions, in the cameras' frames, through the centres of pixels."""
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
    """Return the lattice of a camera, and its spacing in pixels.

    The lattice holds vectors along the rays through every `SPACING`th pixel corner, to beyond the
    last pixel. Where the distortion folds it holds those through every pixel's centre, with one
    more row and column.
    """
    x = np.arange(-(-camera.width // SPACING) + 1) * SPACING
    y = np.arange(-(-camera.height // SPACING) + 1) * SPACING
    pixels = np.stack(np.meshgrid(x, y), axis=-1).astype(np.float64)
    d = camera.directions(pixels)
    with np.errstate(invalid="ignore"):
        error = np.abs(camera.project(d) - pixels).max(initial=0.0)
    if not error < MAX_ERROR:
        return np.pad(camera.directions(), ((0, 1), (0, 1), (0, 0)), mode="edge"), 1
    z = d[..., 2:].astype(np.float64)
    # At z = 1 the lattice of a pinhole is evenly spaced; a fisheye may see behind itself.
    return (d / z if z.min() > MIN_COSINE else d), SPACING
