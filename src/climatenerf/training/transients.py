"""Masks of transient objects, such as passers-by, learned with the scene.

A passer-by appears in one photo only and cannot be explained by a static scene. Each image has a
mask M in [0,1]; where M is 1, its colours do not count, at a price. Minimising
(1 - M) · error + price · M turns M on where the error stays above the price (paper, "Transient
Object Occlusion"; the price is its mask regulariser). M weights the error that no neighbouring
pixel explains, because fine texture never matches pixel by pixel. A logarithm of M beside the price
keeps M away from 0 (`losses.masked_colour_loss`).
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
from climatenerf.training.losses import RESTING_MASK

LEVELS = (6, 12, 24, 48)  # cells along each side of an image, of the levels of features
FEATURES = 2  # of a cell
HIDDEN = 16  # width of the hidden layer
MASK_THRESHOLD = 0.5  # value of M from which a pixel is masked
MOVABLE_PRICE = 0.1  # factor on the price where the label is of a movable class,
STATIC_CELLS = 24  # except in static cells, of which an image has so many along each side


class TransientMasks(nn.Module):
    """A small network over a pyramid of features for each image."""

    def __init__(self, images: int, generator: torch.Generator | None = None):
        """Initialise the masks of `images` images, on the CPU; `.to(device)` moves them.

        Args:
            images: number of training images.
            generator: source of the initial values, on the CPU; None: PyTorch's global one.
        """
        super().__init__()
        self.levels = nn.ParameterList()
        for side in LEVELS:
            # Each image has its own features, so that images cannot influence each other.
            shape = (images, side, side, FEATURES)
            drawn = torch.randn(shape, generator=generator, device="cpu")
            self.levels.append(nn.Parameter(1e-2 * drawn))
        last = _linear(HIDDEN, 1, generator)
        nn.init.constant_(last.bias, math.log(RESTING_MASK / (1 - RESTING_MASK)))
        first = _linear(FEATURES * len(LEVELS), HIDDEN, generator)
        self.net = nn.Sequential(first, nn.ReLU(), last)

    def forward(self, image: Int[Tensor, "n"], xy: Float[Tensor, "n 2"]) -> Float[Tensor, "n"]:
        """Return M of pixels: 1 where a photo shows a transient object.

        Args:
            image: index of the image.
            xy: position in the image, (x, y) in (0,1).
        """
        return torch.sigmoid(self.net(self.features(image, xy))[:, 0])

    @torch.no_grad()
    def masked_fractions(self) -> Float[Tensor, "images"]:
        """Return the fraction of each image that is masked, estimated on a lattice of pixels."""
        side = 2 * LEVELS[-1]
        device = self.levels[0].device
        line = (torch.arange(side, device=device) + 0.5) / side
        xy = torch.stack(torch.meshgrid(line, line, indexing="xy"), dim=-1).view(-1, 2)
        fractions = []
        for i in range(self.levels[0].shape[0]):
            image = torch.full((len(xy),), i, device=device)
            fractions.append((self(image, xy) > MASK_THRESHOLD).float().mean())
        return torch.stack(fractions)

    def features(
        self, image: Int[Tensor, "n"], xy: Float[Tensor, "n 2"]
    ) -> Float[Tensor, "n features"]:
        """Return bilinear interpolations of all levels, concatenated."""
        found = []
        images = self.levels[0].shape[0]
        for level in self.levels:
            side = level.shape[1]
            # All images as one tall picture, one under the other, so that one operation looks up
            # all of them. Positions in it are rounded, so they keep that distance from the next.
            rounding = 3e-7 * images * side
            x, y = (xy * side - 0.5).clamp(0, side - 1).unbind(-1)
            y = y.clamp(rounding, side - 1 - rounding)
            picture = level.reshape(images * side, side, FEATURES).permute(2, 0, 1)
            across = (x + 0.5) / (side / 2) - 1
            down = (y + 0.5 + image * side) / (images * side / 2) - 1
            values = F.grid_sample(
                picture[None],
                torch.stack([across, down], dim=-1)[None, None],
                padding_mode="border",
                align_corners=False,
            )
            found.append(values[0, :, 0].T)
        return torch.cat(found, dim=-1)


def _linear(inputs: int, outputs: int, generator: torch.Generator | None) -> nn.Linear:
    """Return a layer with PyTorch's default initialisation, drawn from a given generator."""
    # Without PyTorch's own initialisation, which draws from the global generator.
    layer = nn.Linear(inputs, outputs, device="meta").to_empty(device="cpu")
    nn.init.kaiming_uniform_(layer.weight, a=math.sqrt(5), generator=generator)
    bound = 1 / math.sqrt(inputs)
    nn.init.uniform_(layer.bias, -bound, bound, generator=generator)
    return layer


def is_movable(label: UInt8[Tensor, "n"]) -> Bool[Tensor, "n"]:
    """Return which merged classes are of objects that move."""
    return (label == PERSON) | (label == VEHICLE)


def find_static_cells(
    pixels: TrainingPixels, depths: Sequence[SparseDepth], images: int
) -> Bool[Tensor, "images cells cells"]:
    """Return the cells of each image in which measured points lie on a movable class.

    Several photos see such a point in one position: a parked car, or a cairn that a network labels
    as a person.
    """
    shape = (images, STATIC_CELLS, STATIC_CELLS)
    static = torch.zeros(shape, dtype=torch.bool, device=pixels.device)
    for each in depths:
        movable = is_movable(pixels.label_towards(each.image, each.rays_d))
        image = each.image[movable]
        cell = _cells(pixels.xy_towards(image, each.rays_d[movable]))
        static[image, cell[:, 1], cell[:, 0]] = True
    return static


def mask_prices(
    price: float,
    label: UInt8[Tensor, "n"],
    image: Int[Tensor, "n"],
    xy: Float[Tensor, "n 2"],
    static: Bool[Tensor, "images cells cells"],
) -> Float[Tensor, "n"]:
    """Return the price of masking pixels at (x, y) of images, in (0,1).

    Movable classes are cheaper to mask, except in static cells. A label alone masks nothing.
    """
    cell = _cells(xy)
    movable = is_movable(label) & ~static[image, cell[:, 1], cell[:, 0]]
    return torch.where(movable, price * MOVABLE_PRICE, price)


def _cells(xy: Float[Tensor, "n 2"]) -> Int[Tensor, "n 2"]:
    """Return the column and row of the static cell that holds each position."""
    return (xy * STATIC_CELLS).long().clamp_max(STATIC_CELLS - 1)
