"""Sky prior: radiance for directions in which no photo shows the sky.

Reflections and light from above need the whole sky. A network evaluated where it has no training
data can return anything. The prior fills those directions by diffusing the observed sky over a map
of the upper hemisphere, and the sky network is trained on it there.
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

ROWS, COLUMNS = 32, 64  # of the map: equal steps of the sine of elevation, and of azimuth
MIN_SINE = -0.05  # of the lowest elevation; below the horizon for reflected rays and haze
MAX_PIXELS = 400_000  # drawn for the map; of smaller captures four times as many as there are
ALBEDO = 0.2  # of common ground: soil .05 to .40, grass .16 to .26, asphalt .05 to .20 (Oke 1987)
MIN_PIXELS = 3  # in a cell for it to count as observed; a single one may have a wrong label
DIFFUSION_STEPS = 400  # spread colour over some 20 cells; farther cells stay near the mean


@dataclass(frozen=True)
class SkyPrior:
    """A map of the sky's radiance, with the cells that no photo shows."""

    colour: Float[Tensor, "rows columns 3"]
    """Linear radiance."""
    unseen: Bool[Tensor, "rows columns"]
    """Cells that no photo shows: only there the prior applies."""

    def draw(
        self, n: int, generator: torch.Generator
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"], Bool[Tensor, "n"]]:
        """Draw n directions, uniform over the map's solid angle.

        Returns:
            Unit directions (world, z up), their linear radiance, and which of them are unseen.
        """
        down, across = uniform(generator, n, 2, device=self.colour.device).unbind(-1)
        y, x = down * ROWS, across * COLUMNS
        row, column = y.long(), x.long()
        return direction(y, x), self.colour[row, column], self.unseen[row, column]


def direction(row: Float[Tensor, "n"], column: Float[Tensor, "n"]) -> Float[Tensor, "n 3"]:
    """Return unit directions (world, z up) of fractional map coordinates."""
    z = MIN_SINE + (1 - MIN_SINE) * row / ROWS
    azimuth = 2 * np.pi * column / COLUMNS
    horizontal = (1 - z.square()).clamp_min(0).sqrt()
    return torch.stack([horizontal * azimuth.cos(), horizontal * azimuth.sin(), z], dim=-1)


def fit_sky_prior(pixels: TrainingPixels, generator: torch.Generator) -> SkyPrior:
    """Average the sky of all photos on the map, and fill its gaps.

    If no label marks sky, all pixels above the horizon are used. Indoors, rays that leave through
    unphotographed walls then return a wall's radiance instead of black.

    If all photos look down, the prior is a uniform grey sky, at most white, that would light their
    ground as it appears: under a uniform sky of radiance L, Lambertian ground of albedo ρ has
    radiance ρ L.

    Args:
        pixels: The photos, with labels if there are any.
        generator: Random generator for the pixels.
    """
    batch = pixels.draw(min(MAX_PIXELS, 4 * pixels.rgb.shape[0]), generator)
    above = batch.rays_d[:, 2] > MIN_SINE
    labelled = above & (batch.label == SKY)
    mean, seen = average_on_map(batch, labelled if pixels.knows_sky else above)
    if not bool(seen.any()):
        # Too few pixels labelled sky, for example a lamp in a room: use all pixels above.
        mean, seen = average_on_map(batch, above)
    if not bool(seen.any()):
        ground = luma(decode_srgb(batch.rgb)).mean()
        return SkyPrior((ground / ALBEDO).clamp_max(1.0).expand(ROWS, COLUMNS, 3), ~seen)
    return SkyPrior(diffuse(mean, seen), ~seen)


def average_on_map(
    batch: Batch, rows: Bool[Tensor, "n"]
) -> tuple[Float[Tensor, "rows columns 3"], Bool[Tensor, "rows columns"]]:
    """Average the colours of rays in each cell of the map.

    Args:
        batch: The rays.
        rows: Which of them to use.

    Returns:
        Mean linear radiance, 0 in empty cells; and the cells with at least `MIN_PIXELS` rays.
    """
    d, colour = batch.rays_d[rows], decode_srgb(batch.rgb[rows])
    row = ((d[:, 2] - MIN_SINE) / (1 - MIN_SINE) * ROWS).long().clamp(0, ROWS - 1)
    turn = torch.atan2(d[:, 1], d[:, 0]) / (2 * np.pi) % 1.0
    column = (turn * COLUMNS).long().clamp(0, COLUMNS - 1)
    cell = row * COLUMNS + column
    total = colour.new_zeros(ROWS * COLUMNS, 3).index_add(0, cell, colour)
    count = torch.bincount(cell, minlength=ROWS * COLUMNS).float()
    seen = (count >= MIN_PIXELS).view(ROWS, COLUMNS)
    # At least 1: an empty cell would be 0/0.
    return (total / count.clamp_min(1)[:, None]).view(ROWS, COLUMNS, 3), seen


def diffuse(
    observed: Float[Tensor, "rows columns 3"], seen: Bool[Tensor, "rows columns"]
) -> Float[Tensor, "rows columns 3"]:
    """Fill unseen cells by Jacobi iterations of Laplace's equation; seen cells stay fixed.

    Args:
        observed: Linear radiance of the seen cells; at least one must be seen.
        seen: Boundary cells of the equation.
    """
    fixed = seen[..., None]
    colour = torch.where(fixed, observed, observed[seen].mean(0))
    for _ in range(DIFFUSION_STEPS):
        above = torch.cat([colour[1:], colour[-1:].roll(COLUMNS // 2, 1)])  # across the zenith
        below = torch.cat([colour[:1], colour[:-1]])
        sides = colour.roll(1, 1) + colour.roll(-1, 1)
        colour = torch.where(fixed, observed, (above + below + sides) / 4)
    return colour
