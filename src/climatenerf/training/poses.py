"""Corrections of the cameras while fitting: a small turn and shift for each image."""

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

RATE = 2e-3  # rad and grid units a step, at first
SMALL = 1e-3  # squared angle below which the series' next term is 1e-8 and less
PULL = 1e-2  # towards the given poses, so that the scene does not drift as a whole


class PoseCorrections(nn.Module):
    """Six numbers for each image; zero leaves its pose as it is."""

    def __init__(self, images: int):
        super().__init__()
        self.turn = nn.Parameter(torch.zeros(images, 3))
        self.shift = nn.Parameter(torch.zeros(images, 3))

    def rays(
        self,
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        image: Int[Tensor, "n"],
        unit: float,
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
        """Corrected origins (m) and unit directions of rays of some images; `unit` m to 1 shift."""
        turned = (rotations(self.turn)[image] @ rays_d[:, :, None])[:, :, 0]
        return rays_o + unit * self.shift[image], turned

    def loss(self) -> Float[Tensor, ""]:
        """Squared corrections (rad, grid units), times `PULL`: their mean must not grow."""
        return PULL * (self.turn.square().sum(-1) + self.shift.square().sum(-1)).mean()

    @torch.no_grad()
    def corrected(self, c2w: Float[Tensor, "v 4 4"], unit: float) -> Float[Tensor, "v 4 4"]:
        """The poses (world m) as they are believed to be; `unit`: metres per grid unit."""
        out = c2w.clone()
        out[:, :3, :3] = rotations(self.turn) @ c2w[:, :3, :3]
        out[:, :3, 3] += unit * self.shift
        return out


def rotations(turn: Float[Tensor, "v 3"]) -> Float[Tensor, "v 3 3"]:
    """Rotation matrices of rotation vectors, by Rodrigues' formula.

    The exponential of the cross-product matrix; `torch.linalg.matrix_exp` would wait for a GPU.
    """
    x, y, z = turn.unbind(-1)
    none = torch.zeros_like(x)
    cross = torch.stack([none, -z, y, z, none, -x, -y, x, none], dim=-1).view(-1, 3, 3)
    squared = turn.square().sum(-1)
    small = squared < SMALL
    # Where the angle is 0 the root has no gradient, and 0/0: there the series stand in.
    angle = torch.where(small, 1.0, squared).sqrt()
    first = torch.where(small, 1 - squared / 6, angle.sin() / angle)
    half = angle / 2  # (1 - cos) / angle², without its loss of digits
    second = torch.where(small, 0.5 - squared / 24, 0.5 * (half.sin() / half).square())
    one = torch.eye(3, dtype=turn.dtype)
    return one + first[:, None, None] * cross + second[:, None, None] * (cross @ cross)
