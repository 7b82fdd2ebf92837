"""What a user can ask of smog."""

from dataclasses import dataclass
from typing import Annotated

from climatenerf.core.layer_table import Layer
from climatenerf.weather.effect import Effect
from climatenerf.weather.units import LENGTH, PER_LENGTH, choice, number, quantity, triple


@dataclass(frozen=True)
class Smog:
    """Smog, fog or haze: tiny particles between the surfaces."""

    visibility: Annotated[float | None, quantity(LENGTH, 0.5, 1e7, optional=True)] = None
    """Distance at which contrast falls to `contrast`. none: no smog."""
    sigma: Annotated[float | None, quantity(PER_LENGTH, 0.0, 10.0, optional=True)] = None
    """Extinction per metre, given instead of the visibility."""
    contrast: Annotated[float, number(0.001, 0.5)] = 0.05
    """Contrast that defines visibility: 0.05 (meteorological range) or 0.02 (Koschmieder)."""
    kind: Annotated[str, choice("smog", "fog", "haze", "dust", "smoke")] = "smog"
    """What the particles are: how they scatter light, and which colours most."""
    light: Annotated[str, choice("scene", "paper")] = "scene"
    """scene: particles scatter the light of the place. paper: they absorb, and glow in `colour`."""
    colour: Annotated[tuple[float, float, float] | None, triple(0.0, 1.0, optional=True)] = None
    """Colour of thick smog, display sRGB. none: that of its kind; the paper's in its light."""
    albedo: Annotated[tuple[float, float, float] | None, triple(0.0, 1.0, optional=True)] = None
    """Fraction of red, green and blue light that a particle scatters. none: that of the kind."""
    asymmetry: Annotated[float | None, number(0.0, 0.95, optional=True)] = None
    """Mean cosine of scattering, g of Henyey and Greenstein. none: that of the kind."""
    height_falloff: Annotated[float | None, quantity(LENGTH, 0.1, 1e5, optional=True)] = None
    """Height over which extinction falls by e. none: the same everywhere."""
    base: Annotated[float, quantity(LENGTH, -1e3, 1e4)] = 0.0
    """Height above the ground datum below which extinction is constant."""
    top: Annotated[float, quantity(LENGTH, 1.0, 1e5)] = 300.0
    """Height above the ground datum at which smog ends; not in the paper's light."""


SMOG = Effect(
    name="smog",
    parameters=Smog,
    enabled_by=("visibility", "sigma"),
    prepare="climatenerf.weather.smog.entity:prepare",
    layers=(Layer("mask_smog", "1", "fraction of the pixel's light that smog added", 1 / 255, 8),),
    alternatives=(("visibility", "sigma"),),
    after=("sky",),
)
