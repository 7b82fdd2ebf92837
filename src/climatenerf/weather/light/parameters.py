"""Under which sky the place lies, and where the sun stands."""

import math
from dataclasses import dataclass
from typing import Annotated

from climatenerf.weather.effect import Effect
from climatenerf.weather.units import ANGLE, choice, number, quantity

_TURN = 2 * math.pi
_NEW = ("overcast", "clear", "storm", "dusk")


@dataclass(frozen=True)
class Sky:
    """The sky, whose light falls on the place, on snow, water and smog alike."""

    kind: Annotated[str, choice("captured", "overcast", "clear", "storm", "dusk")] = "captured"
    """captured: the light of the photos. Others replace it, with its sun and shadows."""
    cover: Annotated[float, number(0.0, 1.0)] = 0.0
    """Fraction of a clear sky that cloud hides; 1 is overcast."""
    exposure: Annotated[str, choice("kept", "fixed")] = "kept"
    """kept: surfaces stay as bright on average as in the photos. fixed: the camera's stays."""
    ev: Annotated[float, number(-10.0, 10.0)] = 0.0
    """Exposure on top, in stops (EV): +1 is twice as bright. Only for skies other than captured."""


@dataclass(frozen=True)
class Sun:
    """Position of the sun: in the photos under the captured sky, else in the new one.

    none: as found from the photos.
    """

    elevation: Annotated[
        float | None, quantity(ANGLE, -math.pi / 2, math.pi / 2, optional=True)
    ] = None
    """Height above the horizon."""
    azimuth: Annotated[float | None, quantity(ANGLE, -_TURN, _TURN, optional=True)] = None
    """Direction of the sun, clockwise from +y."""


SKY = Effect(
    name="sky",
    parameters=Sky,
    enabled_by=(),
    prepare="climatenerf.weather.light.entity:prepare",
    version="4",
    always=True,
    only_with=(("cover", "kind", ("clear",)), ("exposure", "kind", _NEW), ("ev", "kind", _NEW)),
)
SUN = Effect(name="sun", parameters=Sun, enabled_by=(), prepare=None)
