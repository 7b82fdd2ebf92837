"""Samples along rays, packed."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

LEAST_WEIGHT = 1e-4  # samples that weigh less are given no colour
LEAST_TAU = 1e-3  # optical depth of samples that count as empty; later in a fit `Field.thin`


@dataclass
class Samples:
    """Samples of n rays, packed by ray, front to back."""

    offsets: Int[Tensor, "rays+1"]
    """Samples of ray r are offsets[r]:offsets[r + 1]."""
    t: Float[Tensor, "s"]
    """Ray length of the sample's middle, m."""
    dt: Float[Tensor, "s"]
    """Extent along the ray, m."""
    sigma: Float[Tensor, "s"]
    """Extinction, 1/m."""

    def ray_index(self) -> Int[Tensor, "s"]:
        """The ray each sample belongs to."""
        counts = self.offsets[1:] - self.offsets[:-1]
        return torch.repeat_interleave(torch.arange(counts.shape[0], device=counts.device), counts)


def offsets_of(ray: Int[Tensor, "s"], rays: int) -> Int[Tensor, "rays+1"]:
    """Where each ray's samples begin in a packed list whose samples' rays are `ray`, ascending."""
    offsets = torch.zeros(rays + 1, dtype=torch.long, device=ray.device)
    offsets[1:] = torch.bincount(ray, minlength=rays).cumsum(0)
    return offsets
