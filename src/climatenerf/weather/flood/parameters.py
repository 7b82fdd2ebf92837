"""What a user can ask of a flood."""

import math
from dataclasses import dataclass
from typing import Annotated

from climatenerf.core.layer_table import Layer
from climatenerf.field.capabilities import DENSITY
from climatenerf.weather.effect import Effect, Measure
from climatenerf.weather.units import ANGLE, LENGTH, SPEED, choice, number, quantity, triple

_TURN = 2 * math.pi


@dataclass(frozen=True)
class Flood:
    """Flood water: a level surface with waves, a body colour and a bottom."""

    level: Annotated[float | None, quantity(LENGTH, -1e3, 1e3, optional=True)] = None
    """Height of the water above the ground datum. none: no flood."""
    wind_speed: Annotated[float, quantity(SPEED, 0.0, 40.0)] = 2.0
    """Wind 10 m above the water; 0 m/s: a flat mirror."""
    wind_direction: Annotated[float, quantity(ANGLE, -_TURN, _TURN)] = 0.0
    """Where the wind comes from, clockwise from +y."""
    fetch: Annotated[float, quantity(LENGTH, 1.0, 1e6)] = 50.0
    """Length of open water that the wind has blown over."""
    depth: Annotated[float, quantity(LENGTH, 0.01, 1e3)] = 1.0
    """Water depth in the waves' dispersion relation; it is not measured from the geometry."""
    wave_scale: Annotated[float, number(0.1, 10.0)] = 1.0
    """Horizontal size of the waves at unchanged slope; 2: half the frequency."""
    spreading: Annotated[str, choice("hasselmann", "donelan-banner")] = "hasselmann"
    """How waves spread about the wind. donelan-banner: longer crests, more alike."""
    wet_band: Annotated[float, quantity(LENGTH, 0.0, 10.0)] = 0.03
    """Height above the crests up to which ground and walls are wet. 0 m: dry at the waterline."""
    colour: Annotated[tuple[float, float, float] | None, triple(0.0, 1.0, True)] = None
    """Colour of deep water under a white sky, display sRGB. none: by the clarity."""
    clarity: Annotated[float, quantity(LENGTH, 0.01, 100.0)] = 0.3
    """Depth at which a white disc keeps 2 % of its contrast."""
    attenuation: Annotated[tuple[float, float, float] | None, triple(0.0, 1e3, True)] = None
    """Attenuation of red, green and blue in 1/m, given instead of the clarity."""
    ior: Annotated[float, number(1.01, 2.0)] = 1.333
    """Refractive index of the water."""
    gloss: Annotated[float, number(10.0, 1e9)] = 1e9
    """Sharpness of reflections before waves widen them (spread 1/sqrt); 1e9: a mirror."""


FLOOD = Effect(
    name="flood",
    parameters=Flood,
    enabled_by=("level",),
    prepare="climatenerf.weather.flood.surface:prepare",
    layers=(
        Layer("water_depth", "m", "water above the ground where water is seen, else 0", 1e-3, 16),
        Layer("mask_water", "1", "fraction of the pixel that shows water", 1 / 255, 8),
    ),
    measures=(
        Measure("water_share", "mask_water"),
        Measure("mean_water_depth_m", "water_depth", "mask_water"),
    ),
    alternatives=(("clarity", "attenuation"),),
    needs=frozenset({DENSITY}),
    after=("sky",),
    prepared_from=(
        "flood.wind_speed",
        "flood.wind_direction",
        "flood.fetch",
        "flood.depth",
        "flood.wave_scale",
        "flood.spreading",
        "seed",
    ),
)
