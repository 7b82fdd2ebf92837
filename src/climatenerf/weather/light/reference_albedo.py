"""How bright surfaces of a class are in a place, to tell light from shadow in the photos.

The shadow that geometry casts misses the photo's by the errors of both. Where radiance fits a lit
surface of the usual albedo much better than one in shadow, or the reverse, the photo decides: with
the geometry's visibility as prior probability, Bayes' rule gives the fraction of the sun that is
to be expected on a sample. The usual albedo is the mean of its class nearby (log-normal).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.core.classes import SOLID, VEGETATION
from climatenerf.core.colour import luma

CELL = 2.0  # m, of the grid of means
BLUR = 2  # passes of a filter over three cells
SPREAD = 0.45  # standard deviation of log albedo within a class nearby
LEAVES_SPREAD = 0.9  # of vegetation, whose leaves shade each other
TRUST = 0.93  # probability that geometry is right
PARTIAL = 0.06  # probability of a partial shadow
FRACTIONS = ((0.0, 0.0), (0.25, PARTIAL / 3), (0.5, PARTIAL / 3), (0.75, PARTIAL / 3), (1.0, 0.0))
"""Fractions of the sun that are compared, and the probability of partial ones."""
DARKEST = 0.01  # albedo; no surface is darker
ROUNDS = 3  # of estimating light and albedo in turn
KNOWN = 2.0  # samples in a cell that count as much as the mean of the whole class


@dataclass(frozen=True)
class ReferenceAlbedo:
    """Mean log albedo (of luma) by class and place.

    Attributes:
        origin: position of the grid's first node, world m.
        log: for each class of `SOLID` the grid of means, z first.
        spread: standard deviation for each class.
    """

    origin: Float[Tensor, "3"]
    log: Float[Tensor, "c nz ny nx"]
    spread: Float[Tensor, "c"]

    def at(self, x: Float[Tensor, "n 3"], kind: Int[Tensor, "n"]) -> Float[Tensor, "n"]:
        """Mean log albedo of a class (index in `SOLID`) at positions (world m), trilinear."""
        size = torch.tensor(self.log.shape[:0:-1], device=x.device)
        place = ((x - self.origin) / CELL).clamp_min(0)
        place = torch.minimum(place, (size - 1).to(place) - 1e-3).clamp_min(0)
        corner = place.long()
        fraction = place - corner
        total = torch.zeros_like(x[:, 0])
        for k in range(8):
            step = torch.tensor([k & 1, k >> 1 & 1, k >> 2 & 1], device=x.device)
            weight = torch.where(step == 1, fraction, 1 - fraction).prod(-1)
            i, j, h = torch.minimum(corner + step, size - 1).unbind(-1)
            total = total + weight * self.log[kind, h, j, i]
        return total

    def lit(
        self,
        radiance: Float[Tensor, "n 3"],
        x: Float[Tensor, "n 3"],
        kind: Int[Tensor, "n"],
        shaded: Float[Tensor, "n 3"],
        sunny: Float[Tensor, "n 3"],
        visibility: Float[Tensor, "n"],
    ) -> Float[Tensor, "n"]:
        """Expected fraction of the sun that shines on samples.

        Args:
            radiance: of the samples in the photos.
            x: positions, world m.
            kind: classes, as indices in `SOLID`.
            shaded: irradiance without the sun.
            sunny: irradiance with it.
            visibility: of the sun by geometry, [0, 1].
        """
        mean, spread = self.at(x, kind), self.spread[kind]
        log = (torch.pi * luma(radiance)).clamp_min(1e-5).log()
        dark, sun = luma(shaded), luma(sunny) - luma(shaded)
        lit_prior = (1 - TRUST) + (2 * TRUST - 1) * visibility
        total = torch.zeros_like(log)
        expected = torch.zeros_like(log)
        for fraction, partial in FRACTIONS:
            # A shadow's soft edge is rare, and blurred by the fit.
            prior = partial + (1 - PARTIAL) * (
                lit_prior * (fraction == 1.0) + (1 - lit_prior) * (fraction == 0.0)
            )
            off = (log - (dark + fraction * sun).log() - mean) / spread
            likely = prior * torch.exp(-0.5 * off.square().clamp_max(60.0))
            total += likely
            expected += fraction * likely
        return expected / total


def estimate(
    radiance: Float[Tensor, "n 3"],
    x: Float[Tensor, "n 3"],
    kind: Int[Tensor, "n"],
    shaded: Float[Tensor, "n 3"],
    sunny: Float[Tensor, "n 3"],
    visibility: Float[Tensor, "n"],
) -> ReferenceAlbedo:
    """Estimate mean albedos from surface points in photos; see `ReferenceAlbedo.lit`."""
    origin = x.amin(0)
    count = ((x.amax(0) - origin) / CELL).ceil().long().clamp(1, 96) + 1
    shape = tuple(count.flip(0).tolist())
    node = ((x - origin) / CELL).round().long()
    node = torch.minimum(node, count - 1)
    cell = (node[:, 2] * shape[1] + node[:, 1]) * shape[2] + node[:, 0]
    spread = torch.full((len(SOLID),), SPREAD, device=x.device)
    spread[SOLID.tolist().index(VEGETATION)] = LEAVES_SPREAD
    light, found = visibility, None
    for _ in range(ROUNDS):
        received = shaded + light[:, None] * (sunny - shaded)
        albedo = (torch.pi * luma(radiance) / luma(received)).clamp(DARKEST, 1.0).log()
        grids = [_means(albedo[kind == k], cell[kind == k], shape) for k in range(len(SOLID))]
        found = ReferenceAlbedo(origin, torch.stack(grids), spread)
        light = found.lit(radiance, x, kind, shaded, sunny, visibility)
    assert found is not None
    return found


def _means(
    values: Float[Tensor, "n"], cell: Int[Tensor, "n"], shape: tuple[int, int, int]
) -> Float[Tensor, "nz ny nx"]:
    """Smoothed means of each cell, towards the median of all where a cell has few."""
    size = shape[0] * shape[1] * shape[2]
    total = torch.zeros(size, device=values.device).index_add(0, cell, values)
    weight = torch.zeros_like(total).index_add(0, cell, torch.ones_like(values))
    common = values.median() if values.numel() else total.new_tensor(-2.0)
    both = torch.stack([total, weight]).view(2, 1, *shape)
    for _ in range(BLUR):
        both = torch.nn.functional.avg_pool3d(both, 3, 1, 1, count_include_pad=False)
    total, weight = both[:, 0]
    return (total + KNOWN * common) / (weight + KNOWN)
