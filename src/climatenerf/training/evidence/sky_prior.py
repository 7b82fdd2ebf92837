"""A sky for directions that no photo looked in: what is known, spread smoothly over the sphere.

Reflections and light from above ask for all of the sky. A network asked where it learned nothing
may answer with anything; so it learns there what the nearest known sky says.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from climatenerf.core.classes import SKY
from climatenerf.core.colour import decode_srgb, luma
from climatenerf.core.device import uniform
from climatenerf.training.dataset import Batch, TrainingPixels

ROWS, COLUMNS = 32, 64  # of the map: height over the horizon in even steps of its sine, azimuth
LOWEST = -0.05  # sine of the lowest elevation: reflected rays and the horizon's haze
LOOKS = 400_000  # pixels that are looked at, or four times all there are
ALBEDO = 0.2  # of common ground: soil .05 to .40, grass .16 to .26, asphalt .05 to .20 (Oke 1987)
MIN_LOOKS = 3  # of them for a cell to be seen: a single one may be labelled wrongly
SPREADS = 400  # rounds of spreading, over some 20 cells; what lies farther stays near the mean


@dataclass(frozen=True)
class SkyPrior:
    """Colours of the sky where no photo shows it."""

    colour: Float[Tensor, "rows columns 3"]
    """Linear radiance of the map."""
    unseen: Bool[Tensor, "rows columns"]
    """Cells that no photo shows."""

    def draw(
        self, n: int, generator: torch.Generator
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"], Bool[Tensor, "n"]]:
        """n random directions, even over the sphere; their colours; which no photo shows."""
        across, along = uniform(generator, n, 2).unbind(-1)
        y, x = across * ROWS, along * COLUMNS
        row, column = y.long(), x.long()
        return direction(y, x), self.colour[row, column], self.unseen[row, column]


def direction(row: Float[Tensor, "n"], column: Float[Tensor, "n"]) -> Float[Tensor, "n 3"]:
    """Unit vectors of places in the map."""
    z = LOWEST + (1 - LOWEST) * row / ROWS
    azimuth = 2 * np.pi * column / COLUMNS
    flat = (1 - z.square()).clamp_min(0).sqrt()
    return torch.stack([flat * azimuth.cos(), flat * azimuth.sin(), z], dim=-1)


def fit_sky_prior(pixels: TrainingPixels, generator: torch.Generator) -> SkyPrior:
    """The sky of all photos on a map, and its gaps filled.

    Where no label tells sky, whatever photos show above the horizon stands for it: indoors, rays
    that leave through walls that nobody photographed find a wall's light, not night. Where all
    photos look down it is an even grey sky, as bright as what lights ground like theirs, white at
    most: ground of albedo ρ that reflects in all directions alike shows ρ times the radiance of
    such a sky.
    """
    batch = pixels.draw(min(LOOKS, 4 * pixels.rgb.shape[0]), generator)
    above = batch.rays_d[:, 2] > LOWEST
    labelled = above & (batch.label == SKY)
    known, seen = looked_at(batch, labelled if pixels.knows_sky else above)
    if not bool(seen.any()):
        # A few pixels that a network took for sky, in a room perhaps: what is above, then.
        known, seen = looked_at(batch, above)
    if not bool(seen.any()):
        ground = luma(decode_srgb(batch.rgb)).mean()
        return SkyPrior((ground / ALBEDO).clamp_max(1.0).expand(ROWS, COLUMNS, 3), ~seen)
    return SkyPrior(spread(known, seen), ~seen)


def looked_at(
    batch: Batch, which: Bool[Tensor, "n"]
) -> tuple[Float[Tensor, "rows columns 3"], Bool[Tensor, "rows columns"]]:
    """Mean linear colours of some rays on the map, and the cells that enough of them look at."""
    d, colour = batch.rays_d[which], decode_srgb(batch.rgb[which])
    row = ((d[:, 2] - LOWEST) / (1 - LOWEST) * ROWS).long().clamp(0, ROWS - 1)
    turn = torch.atan2(d[:, 1], d[:, 0]) / (2 * np.pi) % 1.0
    column = (turn * COLUMNS).long().clamp(0, COLUMNS - 1)
    cell = row * COLUMNS + column
    total = torch.zeros(ROWS * COLUMNS, 3).index_add(0, cell, colour)
    count = torch.bincount(cell, minlength=ROWS * COLUMNS).float()
    seen = (count >= MIN_LOOKS).view(ROWS, COLUMNS)
    # 1: a cell that nothing looks at, 0/0.
    return (total / count.clamp_min(1)[:, None]).view(ROWS, COLUMNS, 3), seen


def spread(
    known: Float[Tensor, "rows columns 3"], seen: Bool[Tensor, "rows columns"]
) -> Float[Tensor, "rows columns 3"]:
    """Unseen cells as the mean of their neighbours on the map, seen ones as they are."""
    held = seen[..., None]
    colour = torch.where(held, known, known[seen].mean(0))
    for _ in range(SPREADS):
        above = torch.cat([colour[1:], colour[-1:].roll(COLUMNS // 2, 1)])  # over the zenith
        below = torch.cat([colour[:1], colour[:-1]])
        beside = colour.roll(1, 1) + colour.roll(-1, 1)
        colour = torch.where(held, known, (above + below + beside) / 4)
    return colour
