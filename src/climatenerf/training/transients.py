"""What one photo shows and the others do not: a mask for each image, learned with the scene.

A passer-by is seen by one photo only and cannot be explained by a static scene. Each image has a
mask M in [0,1] over it; where M is 1 its colours do not count, at a price. Minimising
(1 - M) · error + price · M turns M on just where the error stays above the price (paper,
"Transient Object Occlusion"; the price is its mask regulariser). The error that M weighs is what
no pixel nearby explains: fine texture, never met pixel by pixel, is no passer-by. A logarithm of M
beside its price keeps M from wearing out (`losses.masked_colour_loss`).
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor, nn
from torch.nn import functional as F

from climatenerf.core.classes import PERSON, VEHICLE
from climatenerf.training.dataset import TrainingPixels
from climatenerf.training.evidence.sparse_depth import SparseDepth
from climatenerf.training.losses import FAINT

CELLS = (6, 12, 24, 48)  # along each side of an image, of the mask's levels
HIDDEN = 16
MASKED = 0.5  # of M: such a pixel is of a passer-by
FEATURES = 2
SUSPECT = 0.1  # of the price of a mask where the label is of a kind that can move,
STILL_CELLS = 24  # unless points lie on it in a cell of so many along a photo's sides


class TransientMasks(nn.Module):
    """A small network over a pyramid of features of each image's own."""

    def __init__(self, images: int, generator: torch.Generator | None = None):
        """Initialise the masks of `images` images; generator: on the CPU; None: the global one."""
        super().__init__()
        self.levels = nn.ParameterList()
        for side in CELLS:
            # The image is a row of its own, so images never leak into each other.
            shape = (images, side, side, FEATURES)
            drawn = torch.randn(shape, generator=generator, device="cpu")
            self.levels.append(nn.Parameter((1e-2 * drawn).to(torch.get_default_device())))
        last = _linear(HIDDEN, 1, generator)
        nn.init.constant_(last.bias, math.log(FAINT / (1 - FAINT)))  # all is believed at first
        self.net = nn.Sequential(_linear(FEATURES * len(CELLS), HIDDEN, generator), nn.ReLU(), last)

    def forward(self, image: Int[Tensor, "n"], place: Float[Tensor, "n 2"]) -> Float[Tensor, "n"]:
        """M of pixels: 1 where a photo shows what is not of the scene.

        Args:
            image: index of the image.
            place: (x, y) in the image, (0,1).
        """
        return torch.sigmoid(self.net(self.features(image, place))[:, 0])

    def shares(self) -> Float[Tensor, "images"]:
        """Share of each image's pixels that is masked, by a lattice of them."""
        side = 2 * CELLS[-1]
        line = (torch.arange(side) + 0.5) / side
        place = torch.stack(torch.meshgrid(line, line, indexing="xy"), dim=-1).view(-1, 2)
        with torch.no_grad():
            masked = [
                (self(torch.full((len(place),), i), place) > MASKED).float().mean()
                for i in range(self.levels[0].shape[0])
            ]
        return torch.stack(masked)

    def features(
        self, image: Int[Tensor, "n"], place: Float[Tensor, "n 2"]
    ) -> Float[Tensor, "n features"]:
        """Bilinear lookups of every level, side by side."""
        found = []
        images = self.levels[0].shape[0]
        for level in self.levels:
            side = level.shape[1]
            # All images' cells as one tall picture, one under the other, so that one operation
            # looks at all. Places in it are rounded; no closer to the next image than by that.
            rounding = 3e-7 * images * side
            x, y = (place * side - 0.5).clamp(0, side - 1).unbind(-1)
            y = y.clamp(rounding, side - 1 - rounding)
            picture = level.reshape(images * side, side, FEATURES).permute(2, 0, 1)
            across = (x + 0.5) / (side / 2) - 1
            down = (y + 0.5 + image * side) / (images * side / 2) - 1
            looked = F.grid_sample(
                picture[None],
                torch.stack([across, down], dim=-1)[None, None],
                padding_mode="border",
                align_corners=False,
            )
            found.append(looked[0, :, 0].T)
        return torch.cat(found, dim=-1)


def _linear(inputs: int, outputs: int, generator: torch.Generator | None) -> nn.Linear:
    """A layer with PyTorch's default initialisation, drawn from a given generator."""
    # Without PyTorch's own initialisation, which draws from the global generator.
    layer = nn.utils.skip_init(nn.Linear, inputs, outputs, device=torch.get_default_device())
    weight = torch.empty(outputs, inputs, device="cpu")
    nn.init.kaiming_uniform_(weight, a=math.sqrt(5), generator=generator)
    bound = 1 / math.sqrt(inputs)
    bias = torch.empty(outputs, device="cpu").uniform_(-bound, bound, generator=generator)
    with torch.no_grad():
        layer.weight.copy_(weight)
        layer.bias.copy_(bias)
    return layer


def can_move(label: UInt8[Tensor, "n"]) -> Bool[Tensor, "n"]:
    """Which merged classes are of things that come and go."""
    return (label == PERSON) | (label == VEHICLE)


def still_cells(
    pixels: TrainingPixels, measured: Sequence[SparseDepth], images: int
) -> Bool[Tensor, "images cells cells"]:
    """Where in each image points lie on what its label says can move.

    A point is found by several photos in one place: a parked car, or a cairn that a network takes
    for a person.
    """
    still = torch.zeros(images, STILL_CELLS, STILL_CELLS, dtype=torch.bool)
    for points in measured:
        own = can_move(pixels.label_towards(points.image, points.rays_d))
        image = points.image[own]
        place = pixels.place_towards(image, points.rays_d[own])
        cell = (place * STILL_CELLS).long().clamp_max(STILL_CELLS - 1)
        still[image, cell[:, 1], cell[:, 0]] = True
    return still


def prices_of_masks(
    price: float,
    label: UInt8[Tensor, "n"],
    image: Int[Tensor, "n"],
    place: Float[Tensor, "n 2"],
    still: Bool[Tensor, "images cells cells"],
) -> Float[Tensor, "n"]:
    """What it costs to mask pixels, at (x, y) of images in (0,1).

    What can move is suspected sooner; but a word alone removes nothing, and what several photos
    show in one place has not moved.
    """
    cell = (place * STILL_CELLS).long().clamp_max(STILL_CELLS - 1)
    movable = can_move(label) & ~still[image, cell[:, 1], cell[:, 0]]
    return torch.where(movable, price * SUSPECT, price)
