"""Where the sun stands."""

import math
from dataclasses import dataclass
from typing import Annotated

from climatenerf.weather.effect import Effect
from climatenerf.weather.units import ANGLE, quantity

_TURN = 2 * math.pi


@dataclass(frozen=True)
class Sun:
    """Position of the sun. none: no shadows, light from above."""

    elevation: Annotated[
        float | None, quantity(ANGLE, -math.pi / 2, math.pi / 2, optional=True)
    ] = None
    """Height above the horizon."""
    azimuth: Annotated[float | None, quantity(ANGLE, -_TURN, _TURN, optional=True)] = None
    """Direction of the sun, clockwise from +y."""


SUN = Effect(name="sun", parameters=Sun, enabled_by=(), prepare=None)
