"""Monocular depth as a loss: a network's relative depth has an unknown scale and shift per image.

Networks such as Depth Anything return an affine function of inverse z-depth, d = a/z + b, with a
and b that differ between images (Ranftl et al. 2020). Both are fitted by least squares to the
present depth of the scene. A step has few rays of each image, so the sums of the normal equations
decay exponentially over steps instead of being reset.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from climatenerf.core.device import CPU

DECAY = 0.95  # of the sums, per step
MIN_RAYS = 20.0  # of an image, before its scale and shift are used
MAX_SQUARED_ERROR = 4.0  # of a ray, in units of the image's variance of d


class DepthAlignment:
    """Scale and shift that align each image's relative depth with the scene."""

    def __init__(self, images: int, device: torch.device = CPU):
        """Start without observations of `images` images, whose rays are on `device`."""
        # Sums over rays of 1, x, d, x², xd, d² with x = 1/z.
        self.sums = torch.zeros(images, 6, dtype=torch.float64, device=device)

    def loss(
        self,
        inverse_z: Float[Tensor, "n"],
        relative: Float[Tensor, "n"],
        image: Int[Tensor, "n"],
        usable: Bool[Tensor, "n"],
    ) -> Float[Tensor, ""]:
        """Return the mean of (a/z + b - d)² over the variance of d in its image.

        Updates the sums with the rays first. Rays of images without a usable alignment count as 0.

        Args:
            inverse_z: Inverse z-depth of the scene, 1/grid unit; receives the gradients.
            relative: d, larger is nearer.
            image: Index of each ray's image.
            usable: Rays that hit matter and have a relative depth.
        """
        d = torch.where(usable, relative, 0.0)
        x, target = torch.where(usable, inverse_z.detach(), 0.0).double(), d.double()
        terms = [usable.double(), x, target, x**2, x * target, target**2]
        self.sums = (DECAY * self.sums).index_add(0, image, torch.stack(terms, dim=-1))
        scale, shift, variance = self.scale_and_shift()
        aligned = usable & (variance[image] > 0)
        residual = torch.where(aligned, scale[image] * inverse_z + shift[image] - d, 0.0)
        # 1e-12: an image of constant d would be 0/0; it is not aligned.
        squared = residual.square() / variance[image].clamp_min(1e-12)
        return squared.clamp_max(MAX_SQUARED_ERROR).sum() / inverse_z.shape[0]

    def scale_and_shift(self) -> tuple[Float[Tensor, "v"], Float[Tensor, "v"], Float[Tensor, "v"]]:
        """Return a, b and the variance of d for each image; variance 0 marks unusable a and b."""
        n, x, d, xx, xd, dd = self.sums.unbind(-1)
        safe = n.clamp_min(1e-9)  # an image without rays yet: 0/0
        variance_x, variance_d = xx / safe - (x / safe) ** 2, dd / safe - (d / safe) ** 2
        # 1e-12: an image without rays yet, or with all of them at one depth: 0/0.
        scale = (xd / safe - x * d / safe**2) / variance_x.clamp_min(1e-12)
        shift = d / safe - scale * x / safe
        # A negative scale means that the scene's depth order is still inverted.
        usable = (n > MIN_RAYS) & (variance_x > 1e-12) & (scale > 0)
        return scale.float(), shift.float(), (variance_d * usable).clamp_min(0).float()
