"""What a user can ask of smog."""

from dataclasses import dataclass
from typing import Annotated

from climatenerf.core.layer_table import Layer
from climatenerf.weather.effect import Effect
from climatenerf.weather.units import LENGTH, PER_LENGTH, number, quantity, triple


@dataclass(frozen=True)
class Smog:
    """Smog, fog or haze: tiny absorbing particles between the surfaces."""

    visibility: Annotated[float | None, quantity(LENGTH, 0.5, 1e7, optional=True)] = None
    """Distance at which contrast falls to `contrast`. none: no smog."""
    sigma: Annotated[float | None, quantity(PER_LENGTH, 0.0, 10.0, optional=True)] = None
    """Extinction per metre, given instead of the visibility."""
    contrast: Annotated[float, number(0.001, 0.5)] = 0.05
    """Contrast that defines visibility: 0.05 (meteorological range) or 0.02 (Koschmieder)."""
    colour: Annotated[tuple[float, float, float], triple(0.0, 1.0)] = (0.925, 0.906, 0.758)
    """Colour of thick smog, display sRGB."""
    height_falloff: Annotated[float | None, quantity(LENGTH, 0.1, 1e5, optional=True)] = None
    """Height over which extinction falls by e. none: the same everywhere."""
    base: Annotated[float, quantity(LENGTH, -1e3, 1e4)] = 0.0
    """Height above the ground datum below which extinction is constant."""


SMOG = Effect(
    name="smog",
    parameters=Smog,
    enabled_by=("visibility", "sigma"),
    prepare="climatenerf.weather.smog.entity:prepare",
    layers=(Layer("mask_smog", "1", "fraction of the pixel's light that smog added", 1 / 255, 8),),
    alternatives=(("visibility", "sigma"),),
)
