"""What a user can ask of a season."""

from dataclasses import dataclass
from typing import Annotated

from climatenerf.weather.effect import Effect
from climatenerf.weather.season.palettes import SEASONS
from climatenerf.weather.units import LENGTH, choice, number, quantity


@dataclass(frozen=True)
class Season:
    """Colours of another season: of leaves and lawns, and of the sky. Shapes stay."""

    kind: Annotated[str, choice("captured", *SEASONS)] = "captured"
    """captured: the season of the photos, or the style that the run was given."""
    strength: Annotated[float, number(0.0, 1.0)] = 1.0
    """How far the colours change; 0: not at all."""
    patch: Annotated[float, quantity(LENGTH, 0.1, 1e3)] = 4.0
    """Size of the patches in which leaves turn alike."""


SEASON = Effect(
    name="season",
    parameters=Season,
    enabled_by=(),
    prepare="climatenerf.weather.season.entity:prepare",
    after=("sky",),
    always=True,
)
