"""What a user can ask of the weather: one frozen dataclass for each phenomenon.

All values are SI floats (angles in radians); a flag or a weather file gives them with a unit.
A section is always present, and its main value `None` means that the phenomenon is absent. Colours
are display sRGB in [0, 1]. Compass directions run clockwise from +y (north where the photos carry
GPS). This module loads no torch.
"""

import math
from dataclasses import dataclass, field, fields

from climatenerf.core.errors import UserError
from climatenerf.weather.units import (
    Angle,
    Kind,
    Length,
    OptionalAngle,
    OptionalLength,
    OptionalPerLength,
    Speed,
)


@dataclass(frozen=True)
class Smog:
    """Smog, fog or haze: tiny absorbing particles between the surfaces."""

    visibility: OptionalLength = None
    """Distance at which contrast falls to `contrast`; 0.5 m to 10000 km. none: no smog."""
    sigma: OptionalPerLength = None
    """Extinction per metre, 0 to 10 1/m, given instead of the visibility."""
    contrast: float = 0.05
    """What visibility means: 0.05 (meteorological optical range) or 0.02 (Koschmieder)."""
    colour: tuple[float, float, float] = (0.925, 0.906, 0.758)
    """Colour of thick smog, display sRGB, 0 to 1."""
    height_falloff: OptionalLength = None
    """Height over which extinction falls by e, 0.1 m to 100 km. none: the same everywhere."""
    base: Length = 0.0
    """Height above the ground datum below which the fall-off stops, -1 km to 10 km."""

    @property
    def present(self) -> bool:
        """Whether there is any smog."""
        return self.visibility is not None or self.sigma is not None


@dataclass(frozen=True)
class Flood:
    """Flood water: a level plane with waves, a body colour and a bed."""

    level: OptionalLength = None
    """Height of the water above the ground datum, -1 km to 1 km. none: no flood."""
    wind_speed: Speed = 2.0
    """Wind 10 m above the water, 0 to 40 m/s; 0 m/s: flat as a mirror."""
    wind_direction: Angle = 0.0
    """Where the wind comes from, clockwise from +y, -360 to 360 deg."""
    fetch: Length = 50.0
    """Length of open water the wind has blown over, 1 m to 1000 km."""
    depth: Length = 1.0
    """Water depth the waves feel, 1 cm to 1 km (the geometry is not asked)."""
    wave_scale: float = 1.0
    """Horizontal size of the waves at unchanged slope, 0.1 to 10; 2: half the frequency."""
    colour: tuple[float, float, float] = (0.488, 0.406, 0.32)
    """Colour of deep water under a white sky, display sRGB, 0 to 1."""
    clarity: Length = 0.3
    """Depth at which a white disc is lost (2 % of its contrast left), 1 cm to 100 m."""
    attenuation: tuple[float, float, float] | None = None
    """Attenuation of red, green and blue in 1/m, 0 to 1000, given instead of the clarity."""
    ior: float = 1.333
    """Refractive index of the water, 1.01 to 2."""
    gloss: float = 20000.0
    """Sharpness of the reflection's lobe before waves widen it, 10 to 1e9 (spread 1/sqrt)."""

    @property
    def present(self) -> bool:
        """Whether there is any flood."""
        return self.level is not None


@dataclass(frozen=True)
class Snow:
    """Fallen snow on upward surfaces."""

    depth: OptionalLength = None
    """Thickness on open level ground, 0 to 2 m. none: no snow."""
    fall_tilt: Angle = 0.0
    """Angle between the fall direction and the vertical, 0 to 80 deg."""
    wind_direction: Angle = 0.0
    """Where tilted snow comes from, clockwise from +y, -360 to 360 deg."""
    slope: Angle = math.radians(37.0)
    """Slope on which half of the snow stays, 0 to 90 deg."""
    slope_sharpness: float = 50.0
    """Steepness a' of the logistic in cos(slope), 1 to 1000."""
    albedo_offset: float = 4.0
    """c0 of the snow's colour (g + c0)/(1 + c0); 0 to 100; larger is whiter."""
    wrap: float = 8.0
    """Wrap lighting gamma of (n.l + gamma)/(1 + gamma), 0 to 100; larger is flatter."""
    sun_share: float = 0.7
    """beta_s: brightness that the sun's shadow takes away, 0 to 1."""
    shade: float = 0.3
    """V_s0: brightness that is left in shadow, 0 to 1."""

    @property
    def present(self) -> bool:
        """Whether there is any snow."""
        return self.depth is not None


@dataclass(frozen=True)
class Sun:
    """Where the sun stands. none: no shadows, light from above."""

    elevation: OptionalAngle = None
    """Height above the horizon, -90 to 90 deg."""
    azimuth: OptionalAngle = None
    """Direction of the sun, clockwise from +y, -360 to 360 deg."""


@dataclass(frozen=True)
class Weather:
    """Everything that is put into the scene, in any combination."""

    smog: Smog = field(default_factory=Smog)
    flood: Flood = field(default_factory=Flood)
    snow: Snow = field(default_factory=Snow)
    sun: Sun = field(default_factory=Sun)
    seed: int = 0
    """Seed of all that is random (waves, snow), 0 to 2^63 - 1."""

    @property
    def present(self) -> bool:
        """Whether anything at all happens."""
        return self.smog.present or self.flood.present or self.snow.present


_TURN = 2 * math.pi
_RANGES: dict[str, tuple[float, float]] = {
    "smog.visibility": (0.5, 1e7),
    "smog.sigma": (0.0, 10.0),
    "smog.contrast": (0.001, 0.5),
    "smog.colour": (0.0, 1.0),
    "smog.height_falloff": (0.1, 1e5),
    "smog.base": (-1e3, 1e4),
    "flood.level": (-1e3, 1e3),
    "flood.wind_speed": (0.0, 40.0),
    "flood.wind_direction": (-_TURN, _TURN),
    "flood.fetch": (1.0, 1e6),
    "flood.depth": (0.01, 1e3),
    "flood.wave_scale": (0.1, 10.0),
    "flood.colour": (0.0, 1.0),
    "flood.clarity": (0.01, 100.0),
    "flood.attenuation": (0.0, 1e3),
    "flood.ior": (1.01, 2.0),
    "flood.gloss": (10.0, 1e9),
    "snow.depth": (0.0, 2.0),
    "snow.fall_tilt": (0.0, math.radians(80)),
    "snow.wind_direction": (-_TURN, _TURN),
    "snow.slope": (0.0, math.pi / 2),
    "snow.slope_sharpness": (1.0, 1000.0),
    "snow.albedo_offset": (0.0, 100.0),
    "snow.wrap": (0.0, 100.0),
    "snow.sun_share": (0.0, 1.0),
    "snow.shade": (0.0, 1.0),
    "sun.elevation": (-math.pi / 2, math.pi / 2),
    "sun.azimuth": (-_TURN, _TURN),
    "seed": (0, 2**63 - 1),
}


def kind_of(annotation: object) -> Kind | None:
    """Dimension that a field's annotation asks for; None for a plain number or a colour."""
    return next((m for m in getattr(annotation, "__metadata__", ()) if isinstance(m, Kind)), None)


def check(weather: Weather) -> Weather:
    """Check every value against its range.

    Returns:
        The same weather, so that the call can be chained.

    Raises:
        UserError: a value lies outside its range, is not finite, or contradicts another one.
    """
    smog = weather.smog
    if smog.visibility is not None and smog.sigma is not None:
        raise UserError("--smog.visibility and --smog.sigma say the same thing: give only one")
    for section in fields(Weather):
        value = getattr(weather, section.name)
        if section.name == "seed":
            _check_range("seed", value, None)
            continue
        for item in fields(value):
            entry = getattr(value, item.name)
            if entry is not None:
                _check_range(f"{section.name}.{item.name}", entry, kind_of(item.type))
    return weather


def _check_range(name: str, value: float | tuple[float, ...], kind: Kind | None) -> None:
    low, high = _RANGES[name]
    for number in value if isinstance(value, tuple) else (value,):
        # A comparison chain, since it is False for NaN; the slack forgives 360 deg in radians.
        slack = 1e-12 * max(abs(low), abs(high)) if kind is not None else 0.0
        if not low - slack <= number <= high + slack:
            low_text, high_text, got = (
                f"{x / kind.scale:.6g} {kind.unit}" if kind is not None else f"{x:g}"
                for x in (low, high, number)
            )
            raise UserError(
                f"--{name.replace('_', '-')} must lie between {low_text} and {high_text}; got {got}"
            )
