"""How bright surfaces of a class are in a place, to tell light from shadow in the photos.

The shadow that geometry casts misses the photo's by the errors of both. Where radiance fits a lit
surface of the usual albedo much better than one in shadow, or the reverse, the photo decides, by
brightness and by tint: sunlight is redder than a blue sky's light. With the geometry's visibility
as prior probability, Bayes' rule gives the sunlight that is to be expected on a sample. The usual
albedo is the mean of its class nearby (log-normal), its spread that of the class.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.core.classes import SOLID
from climatenerf.core.colour import luma
from climatenerf.core.device import to_numpy
from climatenerf.ops import relighting

CELL = 2.0  # m, of the grid of means
MAX_CELLS = 96  # along a side
BLUR = 2  # passes of a filter over three cells
SPREAD = (0.45, 0.25)  # first standard deviations of the logs of albedo and of red over blue
MIN_SPREAD, MAX_SPREAD = 0.15, 1.0  # of what is measured then
TRUST = 0.93  # probability that geometry is right
PARTIAL = 0.06  # probability of a partial shadow
MISJUDGED = 0.03  # probability that a surface's normal is wrong, and it faces the sun
FACING = 0.6  # cosine to the sun of such a surface
RIGHT, WRONG = (1 - PARTIAL - MISJUDGED) * TRUST, (1 - PARTIAL - MISJUDGED) * (1 - TRUST)
CHOICES = (
    (0.0, 0.0, RIGHT, WRONG),
    *((part, 0.0, PARTIAL / 3, PARTIAL / 3) for part in (0.25, 0.5, 0.75)),
    (1.0, 0.0, WRONG, RIGHT),
    (0.0, FACING, MISJUDGED, MISJUDGED),
)
"""Fractions of the sun that are compared, on the surface's slope and on one that faces the sun, and
their probability in geometry's shadow and sun. A shadow's soft edge is rare: the fit blurs it.
"""
DARKEST = 0.01  # albedo; no surface is darker
ROUNDS = 3  # of estimating light and albedo in turn
KNOWN = 2.0  # samples in a cell that count as much as the mean of the whole class


@dataclass(frozen=True)
class ReferenceAlbedo:
    """Mean logarithms of albedo's luma, and of its red over blue, by class and place.

    Attributes:
        origin: position of the grid's first node, world m.
        log: for each class of `SOLID` the grids of both means, z first.
        spread: their standard deviations for each class.
    """

    origin: Float[Tensor, "3"]
    log: Float[Tensor, "2 c nz ny nx"]
    spread: Float[Tensor, "c 2"]

    def at(self, x: Float[Tensor, "n 3"], kind: Int[Tensor, "n"]) -> Float[Tensor, "n 2"]:
        """Means of a class (index in `SOLID`) at positions (world m), trilinear."""
        means = [relighting.interpolated(grids, self.origin, CELL, x, kind) for grids in self.log]
        return torch.stack(means, dim=-1)

    def sunlight(
        self,
        radiance: Float[Tensor, "n 3"],
        x: Float[Tensor, "n 3"],
        kind: Int[Tensor, "n"],
        shaded: Float[Tensor, "n 3"],
        sun: Float[Tensor, "n 3"],
        beam: Float[Tensor, "3"],
        visibility: Float[Tensor, "n"],
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]:
        """Expected irradiance by the sun, and the probability that a normal is wrong.

        Args:
            radiance: of the samples in the photos.
            x: positions, world m.
            kind: classes, as indices in `SOLID`.
            shaded: irradiance without the sun.
            sun: irradiance by the sun where nothing hides it.
            beam: of a surface that faces it.
            visibility: of the sun by geometry, [0, 1].
        """
        fractions = relighting.expected_fractions(
            torch.tensor(CHOICES, device=x.device),
            _luma_red_blue(torch.pi * radiance),
            _luma_red_blue(shaded),
            _luma_red_blue(sun),
            _luma_red_blue(beam[None])[0],
            self.at(x, kind),
            self.spread[kind],
            visibility,
        )
        direct = fractions[:, :1] * sun + fractions[:, 1:] * beam
        return direct, fractions[:, 1] / FACING


def estimate(
    radiance: Float[Tensor, "n 3"],
    x: Float[Tensor, "n 3"],
    kind: Int[Tensor, "n"],
    shaded: Float[Tensor, "n 3"],
    sun: Float[Tensor, "n 3"],
    beam: Float[Tensor, "3"],
    visibility: Float[Tensor, "n"],
) -> ReferenceAlbedo:
    """Estimate mean albedos from surface points in photos; see `ReferenceAlbedo.sunlight`."""
    middle = x.median(0).values  # what is far from it gets the values of the grid's border
    origin = torch.maximum(x.amin(0), middle - CELL * MAX_CELLS / 2)
    count = ((x.amax(0) - origin) / CELL).ceil().long().clamp(1, MAX_CELLS) + 1
    nx, ny, nz = (int(n) for n in to_numpy(count))
    shape = nz, ny, nx
    node = ((x - origin) / CELL).round().long().clamp_min(0)
    node = torch.minimum(node, count - 1)
    cell = (node[:, 2] * shape[1] + node[:, 1]) * shape[2] + node[:, 0]
    spread = torch.tensor(SPREAD, device=x.device).repeat(len(SOLID), 1)
    sent = relighting.brightness_and_tint(
        _luma_red_blue(torch.pi * radiance), relighting.DARKEST_SENT
    )
    direct, found = visibility[:, None] * sun, None
    for _ in range(ROUNDS):
        received = _luma_red_blue(shaded + direct)
        albedo = sent - relighting.brightness_and_tint(received, relighting.MIN_RECEIVED)
        albedo[:, 0].clamp_(math.log(DARKEST), 0.0)
        grids = [
            torch.stack(
                [_means(albedo[kind == k, j], cell[kind == k], shape) for k in range(len(SOLID))]
            )
            for j in range(2)
        ]
        found = ReferenceAlbedo(origin, torch.stack(grids), spread)
        direct, _ = found.sunlight(radiance, x, kind, shaded, sun, beam, visibility)
        off = (albedo - found.at(x, kind)).abs()
        for k in range(len(SOLID)):
            if bool((kind == k).any()):
                # Of a normal distribution, from the median of absolute deviations.
                measured = 1.4826 * off[kind == k].median(0).values
                spread[k] = measured.clamp(MIN_SPREAD, MAX_SPREAD)
    assert found is not None
    return found


def _luma_red_blue(light: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    return torch.stack([luma(light), light[:, 0], light[:, 2]], dim=-1)


def _means(
    values: Float[Tensor, "n"], cell: Int[Tensor, "n"], shape: tuple[int, int, int]
) -> Float[Tensor, "nz ny nx"]:
    """Smoothed means of each cell, towards the median of all where a cell has few."""
    size = shape[0] * shape[1] * shape[2]
    total = torch.zeros(size, device=values.device).index_add(0, cell, values)
    weight = torch.zeros_like(total).index_add(0, cell, torch.ones_like(values))
    common = values.median() if values.numel() else total.new_tensor(0.0)
    both = torch.stack([total, weight]).view(2, 1, *shape)
    for _ in range(BLUR):
        both = torch.nn.functional.avg_pool3d(both, 3, 1, 1, count_include_pad=False)
    total, weight = both[:, 0]
    return (total + KNOWN * common) / (weight + KNOWN)
