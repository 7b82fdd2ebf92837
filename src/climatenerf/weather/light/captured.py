"""The light in which a place was photographed, as found from its photos.

A sky is described by what photos show of it and by a model for the rest: a smooth base that
changes from the horizon to the zenith, and a bright lobe where the sun is, which photos clip at
white. A sun too narrow to be gathered by a few rays is kept apart, as a direction with its own
irradiance. World axes: x east or any, y ahead, z up; radiance is linear, in the units of the
photos, where display white is 1.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.core.device import to_numpy
from climatenerf.field.protocol import RadianceField, device_of
from climatenerf.weather.light.spherical import sphere_directions

CLIPPED = 0.9  # radiance from which a photo's sky may be brighter than it shows
HARD = math.radians(3.0)  # width up to which the lobe counts as a sun that casts sharp shadows
SHEET_DIRECTIONS = 8192
ROWS, COLUMNS = 18, 36  # of the map of directions: rows from the horizon up, columns from +y to +x


@dataclass(frozen=True)
class CapturedLight:
    """Sky and sun of the photos.

    Attributes:
        horizon: radiance of the sky's base at the horizon.
        zenith: radiance of its base at the zenith.
        sun: unit vector towards the middle of the bright lobe; None if there is none.
        width: angle at which the lobe falls to 1/e, rad; 0 for a hard sun.
        lobe: radiance of the lobe at its middle; for a hard sun its irradiance across its rays.
        shown: fraction of each cell of directions that photos show as sky, [0, 1].
        sun_error: error of the direction, rad; 0 without a sun.
        almanac: unit vector towards the sun by date, time and place; None if photos do not tell.
    """

    horizon: Float[np.ndarray, "3"]
    zenith: Float[np.ndarray, "3"]
    sun: Float[np.ndarray, "3"] | None
    width: float
    lobe: Float[np.ndarray, "3"]
    shown: Float[np.ndarray, "rows columns"]
    sun_error: float
    almanac: Float[np.ndarray, "3"] | None = None

    @property
    def hard(self) -> bool:
        """Whether the sun casts sharp shadows."""
        return self.sun is not None and self.width <= HARD

    @property
    def almanac_difference(self) -> float | None:
        """Angle between the sun that photos show and that of date, time and place, rad."""
        if self.sun is None or self.almanac is None:
            return None
        return math.acos(max(-1.0, min(1.0, float(self.sun @ self.almanac))))

    def base(self, d: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Radiance of the model without the lobe, linear in the sine of the elevation."""
        up = d[:, 2:].clamp(0, 1)
        return (1 - up) * d.new_tensor(self.horizon) + up * d.new_tensor(self.zenith)

    def glow(self, d: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Radiance of the lobe; 0 for a hard sun, which is no part of the sky's radiance."""
        if self.sun is None or self.hard:
            return torch.zeros_like(d)
        angle = torch.acos((d @ d.new_tensor(self.sun)).clamp(-1, 1))
        return torch.exp(-((angle / self.width) ** 2))[:, None] * d.new_tensor(self.lobe)

    def sky(
        self, d: Float[Tensor, "n 3"], photographed: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "n 3"]:
        """Radiance of the sky without a hard sun, beyond what photos can show.

        Args:
            d: unit directions.
            photographed: radiance of the fitted sky there.

        Returns:
            What photos show where they show it; the model elsewhere; and the larger of the two
            where photos clip.
        """
        model = self.base(d) + self.glow(d)
        shown = self.shown_in(d)[:, None]
        bright = photographed.amax(-1, keepdim=True)
        # Blends in below the clip, so that no edge shows in a reflection.
        clipped = ((bright - CLIPPED + 0.1) / 0.1).clamp(0, 1)
        seen = photographed + clipped * (model - photographed).clamp_min(0)
        return shown * seen + (1 - shown) * model

    def shown_in(self, d: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Fraction of each direction's surroundings that photos show as sky, interpolated."""
        table = torch.as_tensor(self.shown, dtype=d.dtype, device=d.device)
        row = torch.asin(d[:, 2].clamp(-1, 1)) / (math.pi / 2) * ROWS - 0.5
        column = torch.atan2(d[:, 0], d[:, 1]).remainder(2 * math.pi) / (2 * math.pi) * COLUMNS
        column = column - 0.5
        j, i = row.floor(), column.floor()
        fj, fi = row - j, column - i
        total = torch.zeros_like(row)
        for b, wb in ((0, 1 - fj), (1, fj)):
            for a, wa in ((0, 1 - fi), (1, fi)):
                jj = (j + b).long().clamp(0, ROWS - 1)
                ii = (i + a).long() % COLUMNS
                total = total + wa * wb * table[jj, ii]
        return total


@dataclass(frozen=True)
class UnknownLight:
    """Photos that do not tell their light.

    Attributes:
        reason: as a clause, such as "the photos show no sky".
    """

    reason: str


def open_sheet(light: CapturedLight, field: RadianceField) -> Float[np.ndarray, "3"]:
    """Radiance of a white sheet on open level ground: irradiance over pi."""
    d = sphere_directions(SHEET_DIRECTIONS).to(device_of(field))
    d = d[d[:, 2] > 0]
    sky = light.sky(d, field.sky(d)) * d[:, 2:] * (4 / SHEET_DIRECTIONS)
    total = to_numpy(sky.sum(0)).astype(float)
    if light.hard and light.sun is not None:
        total += light.lobe * max(float(light.sun[2]), 0.0) / math.pi
    return total


def elevation_azimuth(direction: Float[np.ndarray, "3"]) -> tuple[float, float]:
    """Elevation and azimuth (clockwise from +y, 0 to 2 pi) of a unit vector, rad."""
    x, y, z = (float(value) for value in direction)
    return math.asin(max(-1.0, min(1.0, z))), math.atan2(x, y) % (2 * math.pi)
