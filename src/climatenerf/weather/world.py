"""What a ray can meet: the fitted field, and the weather put into it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.core.samples import Samples
from climatenerf.field.protocol import RadianceField
from climatenerf.weather.flood.waves import WaveFrame
from climatenerf.weather.parameters import Flood
from climatenerf.weather.smog.medium import Medium


class Matter(Protocol):
    """What lies on the scene (snow): density and colour of its own."""

    def march(self, rays_o: Tensor, rays_d: Tensor, t_min: Tensor, t_max: Tensor) -> Samples:
        """Samples where it is."""
        ...

    def colour(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Linear radiance."""
        ...

    def normal(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Outward unit normal."""
        ...

    def thickness(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Height above the ground under it, m."""
        ...


@dataclass(frozen=True)
class Water:
    """A flood at one moment."""

    flood: Flood
    level: float
    """World height of the surface, m."""
    waves: WaveFrame
    irradiance: Float[Tensor, "3"]
    """On level ground in the open, linear."""
    sun_elevation: float | None = None
    """rad; None: light from an even sky."""
    mirror_only: bool = False
    """Reflectance 1 and no gloss: a check against a mirrored camera."""


@dataclass(frozen=True)
class World:
    """Everything there is at one moment."""

    field: RadianceField
    appearance: Float[Tensor, "1 e"] | None = None
    """Exposure and light in which the field is rendered; None: the mean of all photos."""
    air: Medium | None = None
    matter: Matter | None = None
    water: Water | None = None


@dataclass
class RenderOutput:
    """What rays see; all per ray, colours linear."""

    rgb: Float[Tensor, "n 3"]
    depth: Float[Tensor, "n"]
    """Ray length to the surface seen (water counts), m; +inf for sky."""
    normal: Float[Tensor, "n 3"]
    """Of water and snow; 0 elsewhere: solid surfaces' come from the field (`frame.py`)."""
    transmittance: Float[Tensor, "n"]
    """Of the air to that surface."""
    water_depth: Float[Tensor, "n"]
    snow_thickness: Float[Tensor, "n"]
    mask_water: Float[Tensor, "n"]
    mask_snow: Float[Tensor, "n"]
    mask_smog: Float[Tensor, "n"]


def concatenate(parts: Sequence[RenderOutput], order: Int[Tensor, "n"] | slice) -> RenderOutput:
    """What all the parts' rays see, one part after the other, and then in this order."""
    return RenderOutput(
        **{
            key: torch.cat([getattr(p, key) for p in parts])[order]
            for key in RenderOutput.__annotations__
        }
    )


SKY_OPACITY = 0.5  # rays with more sky than this on them have no surface
TINY = math.exp(-12)  # keeps means over nothing finite: 0/0
