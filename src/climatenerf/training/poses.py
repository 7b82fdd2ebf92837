"""Corrections of the camera poses during a fit: a small rotation and translation an image."""

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

SMALL_ANGLE = 1e-3  # squared, rad²; below it the next term of the series is 1e-8 or less
PULL = 1e-2  # weight of the corrections in the loss, so that the scene does not drift as a whole


class PoseCorrections(nn.Module):
    """Six numbers for each image; zeros leave its pose unchanged."""

    def __init__(self, images: int):
        """Begin with no corrections of `images` images, on the CPU; `.to(device)` moves them."""
        super().__init__()
        self.rotation = nn.Parameter(torch.zeros(images, 3, device="cpu"))
        self.translation = nn.Parameter(torch.zeros(images, 3, device="cpu"))

    def rays(
        self,
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        image: Int[Tensor, "n"],
        unit: float,
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
        """Return the corrected origins (m) and unit directions of rays.

        Args:
            rays_o: origins, world m.
            rays_d: unit directions.
            image: index of each ray's image.
            unit: metres per unit of the translations.
        """
        rotated = (rotations(self.rotation)[image] @ rays_d[:, :, None])[:, :, 0]
        return rays_o + unit * self.translation[image], rotated

    def loss(self) -> Float[Tensor, ""]:
        """Return the mean squared correction (rad, grid units) times `PULL`."""
        return PULL * (self.rotation.square().sum(-1) + self.translation.square().sum(-1)).mean()

    @torch.no_grad()
    def corrected(self, c2w: Float[Tensor, "v 4 4"], unit: float) -> Float[Tensor, "v 4 4"]:
        """Return the corrected poses (world m); `unit`: metres per grid unit."""
        out = c2w.clone()
        out[:, :3, :3] = rotations(self.rotation) @ c2w[:, :3, :3]
        out[:, :3, 3] += unit * self.translation
        return out


def rotations(vectors: Float[Tensor, "v 3"]) -> Float[Tensor, "v 3 3"]:
    """Return the rotation matrices of rotation vectors (rad), by Rodrigues' formula.

    They are the exponentials of the cross-product matrices; `torch.linalg.matrix_exp` would
    synchronise with a GPU.
    """
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).view(-1, 3, 3)
    squared = vectors.square().sum(-1)
    small = squared < SMALL_ANGLE
    # At angle 0 the root has no gradient and the quotients are 0/0: series replace them.
    angle = torch.where(small, 1.0, squared).sqrt()
    first = torch.where(small, 1 - squared / 6, angle.sin() / angle)
    half = angle / 2  # (1 - cos) / angle², without its loss of digits
    second = torch.where(small, 0.5 - squared / 24, 0.5 * (half.sin() / half).square())
    one = torch.eye(3, dtype=vectors.dtype, device=vectors.device)
    return one + first[:, None, None] * cross + second[:, None, None] * (cross @ cross)
