"""Samples along rays, packed."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

MIN_WEIGHT = 1e-4  # samples that weigh less are given no colour
MIN_TAU = 1e-3  # optical depth of samples that count as empty; later in a fit `Field.thin`


@dataclass
class Samples:
    """Samples of n rays, packed by ray, front to back.

    Lists may be longer than that takes: what follows is all zeros, and counts as the last ray's.
    """

    offsets: Int[Tensor, "rays+1"]
    """Samples of ray r are offsets[r]:offsets[r + 1]."""
    t: Float[Tensor, "s"]
    """Ray length of the sample's middle, m."""
    dt: Float[Tensor, "s"]
    """Extent along the ray, m."""
    sigma: Float[Tensor, "s"]
    """Extinction, 1/m."""
    ids: Int[Tensor, "s"] | None = None
    """The primitive that each sample belongs to, for fields made of primitives."""

    def ray_index(self) -> Int[Tensor, "s"]:
        """The ray each sample belongs to."""
        # A step at each ray's beginning; none is waited for, as counts of repetitions would be.
        steps = torch.zeros(self.t.shape[0] + 1, dtype=torch.long, device=self.offsets.device)
        begins = self.offsets[1:-1]
        steps.index_add_(0, begins, torch.ones_like(begins))
        return steps[:-1].cumsum(0)


def offsets_of(ray: Int[Tensor, "s"], rays: int) -> Int[Tensor, "rays+1"]:
    """Where each ray's samples begin in a packed list whose samples' rays are `ray`, ascending."""
    return torch.searchsorted(ray, torch.arange(rays + 1, device=ray.device))
