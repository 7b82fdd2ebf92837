"""Samples along rays, packed."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

MIN_WEIGHT = 1e-4
"""Rendering weight below which the colour of a sample is not evaluated."""
MIN_TAU = 1e-3
"""Initial pruning threshold: optical depth below which a sample counts as empty."""

COMPLETED = -2
"""Id of samples on ground that no photo shows; see `render.completed_ground`."""
PLACED = -3
"""Id of samples on objects that were put into the scene; see `render.placed_objects`."""


@dataclass
class Samples:
    """Samples of n rays, packed by ray, front to back.

    Lists of fixed capacity are padded with zeros, which count as samples of the last ray.
    """

    offsets: Int[Tensor, "rays+1"]
    """The samples of ray r are offsets[r]:offsets[r + 1]."""
    t: Float[Tensor, "s"]
    """Ray length at the middle of the sample, m."""
    dt: Float[Tensor, "s"]
    """Extent along the ray, m."""
    sigma: Float[Tensor, "s"]
    """Extinction, 1/m."""
    ids: Int[Tensor, "s"] | None = None
    """The primitive that each sample belongs to, for fields made of primitives."""

    def ray_index(self) -> Int[Tensor, "s"]:
        """Return the index of the ray that each sample belongs to."""
        # A cumulative sum of ones at the rays' first samples: `repeat_interleave` would
        # synchronise with the GPU because its output size depends on the data.
        steps = torch.zeros(self.t.shape[0] + 1, dtype=torch.long, device=self.offsets.device)
        begins = self.offsets[1:-1]
        steps.index_add_(0, begins, torch.ones_like(begins))
        return steps[:-1].cumsum(0)


def offsets_of(ray: Int[Tensor, "s"], rays: int) -> Int[Tensor, "rays+1"]:
    """Return the offsets of a packed list from the ray index of each sample, ascending."""
    return torch.searchsorted(ray, torch.arange(rays + 1, device=ray.device))
