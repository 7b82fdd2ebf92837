"""Relative depth from one photo as a loss: right in shape, unknown in scale and shift.

Networks such as Depth Anything give an affine function of the inverse z-depth, d = a/z + b, with a
and b of their own for each image (Ranftl et al. 2020). They are found by least squares against the
scene as it stands, from sums that forget slowly, since a step has few rays of each image.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

KEPT = 0.95  # of the sums from step to step
MIN_RAYS = 20.0  # of an image, before its scale and shift are believed


class DepthAlignment:
    """Scale and shift of every image's relative depth."""

    def __init__(self, images: int):
        # Sums over rays of 1, x, d, x², xd, d² with x = 1/z.
        self.sums = torch.zeros(images, 6, dtype=torch.float64)

    def loss(
        self,
        inverse_z: Float[Tensor, "n"],
        relative: Float[Tensor, "n"],
        image: Int[Tensor, "n"],
        counts: Bool[Tensor, "n"],
    ) -> Float[Tensor, ""]:
        """Mean squared difference of d and a/z + b, in units of d's variance over its image.

        Args:
            inverse_z: of the scene, 1/grid unit; gradients go here.
            relative: d, larger is nearer.
            image: of each ray.
            counts: rays that show matter and have a relative depth.
        """
        d = torch.where(counts, relative, 0.0)
        fixed, goal = torch.where(counts, inverse_z.detach(), 0.0).double(), d.double()
        rows = torch.stack([counts.double(), fixed, goal, fixed**2, fixed * goal, goal**2], dim=-1)
        self.sums = (KEPT * self.sums).index_add(0, image, rows)
        scale, shift, spread = self.affine()
        known = counts & (spread[image] > 0)
        off = torch.where(known, scale[image] * inverse_z + shift[image] - d, 0.0)
        squared = off.square() / spread[image].clamp_min(1e-12)  # flat d: 0/0, not known
        return squared.clamp_max(4.0).sum() / inverse_z.shape[0]

    def affine(self) -> tuple[Float[Tensor, "v"], Float[Tensor, "v"], Float[Tensor, "v"]]:
        """a, b and the variance of d for each image; the variance is 0 where a is not known."""
        n, x, d, xx, xd, dd = self.sums.unbind(-1)
        safe = n.clamp_min(1e-9)  # no rays yet: 0/0
        variance_x, variance_d = xx / safe - (x / safe) ** 2, dd / safe - (d / safe) ** 2
        # 1e-12: of an image without rays yet, or of which all are equally far, 0/0.
        scale = (xd / safe - x * d / safe**2) / variance_x.clamp_min(1e-12)
        shift = d / safe - scale * x / safe
        # Nearer must be larger: a scene that stands inside out says nothing yet.
        known = (n > MIN_RAYS) & (variance_x > 1e-12) & (scale > 0)
        return scale.float(), shift.float(), (variance_d * known).clamp_min(0).float()
