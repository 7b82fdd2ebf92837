"""What a user can ask of fallen snow."""

import math
from dataclasses import dataclass
from typing import Annotated

from climatenerf.core.layer_table import Layer
from climatenerf.weather.effect import Effect, Measure
from climatenerf.weather.units import ANGLE, LENGTH, SHORT_LENGTH, choice, folder, number, quantity

_TURN = 2 * math.pi


@dataclass(frozen=True)
class Snow:
    """Fallen snow on upward surfaces."""

    depth: Annotated[float | None, quantity(LENGTH, 0.0, 2.0, optional=True)] = None
    """Thickness on open level ground. none: no snow."""
    fall_tilt: Annotated[float, quantity(ANGLE, 0.0, math.radians(80))] = 0.0
    """Angle between the fall direction and the vertical."""
    wind_direction: Annotated[float, quantity(ANGLE, -_TURN, _TURN)] = 0.0
    """Where the wind comes from, for tilted snow and drifts, clockwise from +y."""
    drift: Annotated[float, number(0.0, 1.0)] = 0.0
    """Drifts: deeper in the lee, thinner where exposed. 1: slopes towards the wind may be bare."""
    light: Annotated[str, choice("scene", "paper")] = "scene"
    """scene: the light that falls on each place. paper: that of the open, with wrap lighting."""
    slope: Annotated[float | None, quantity(ANGLE, 0.0, math.pi / 2, optional=True)] = None
    """Slope that keeps half, as in the paper. none: as roofs (EN 1991) and rough ground do."""
    slope_sharpness: Annotated[float, number(1.0, 1000.0)] = 50.0
    """Steepness a' of the logistic in cos(slope), with a `slope`."""
    grain: Annotated[float, quantity(SHORT_LENGTH, 3e-5, 2e-3)] = 1e-4
    """Optical radius of the grains. Fresh snow: 0.05 mm; wet: 1 mm; coarser is darker."""
    soot: Annotated[float, number(0.0, 1e5)] = 300.0
    """Soot in nanograms per gram of snow. Arctic: 10; near towns: 100 to 1000."""
    albedo: Annotated[float | None, number(0.0, 1.0, optional=True)] = None
    """Reflectance of deep snow, instead of that of `grain` and `soot`. none: theirs."""
    sparkle: Annotated[float, number(0.0, 1.0)] = 0.3
    """Area of crystal faces that sparkle in a hard sun, over that of the snow. 0: none."""
    relief: Annotated[float, quantity(SHORT_LENGTH, 0.0, 0.05)] = 0.003
    """Standard deviation of the fine bumps that tilt the surface towards the light. 0: smooth."""
    albedo_offset: Annotated[float, number(0.0, 100.0)] = 4.0
    """c0 of the colour (g + c0)/(1 + c0) for `light` = paper; larger is whiter."""
    wrap: Annotated[float, number(0.0, 100.0)] = 8.0
    """Wrap lighting gamma of (n.l + gamma)/(1 + gamma) for `light` = paper; larger is flatter."""
    sun_share: Annotated[float, number(0.0, 1.0)] = 0.7
    """beta_s: brightness that the sun's shadow takes away, for `light` = paper."""
    shade: Annotated[float, number(0.0, 1.0)] = 0.3
    """V_s0: brightness that is left in shadow, for `light` = paper."""
    shadows: Annotated[str | None, folder()] = None
    """Masks of the photos, white in shadow, for `light` = paper. none: shadows by geometry."""


# Parameters that only one kind of light reads. With both, the light of the place depends on grain.
_PAPER = ("albedo_offset", "wrap", "sun_share", "shade")
_SCENE = ("sparkle", "relief")

SNOW = Effect(
    name="snow",
    parameters=Snow,
    enabled_by=("depth",),
    prepare="climatenerf.weather.snow.layer:prepare",
    layers=(
        Layer("snow_thickness", "m", "snow upon the surface that is seen, else 0", 1e-4, 16),
        Layer("mask_snow", "1", "fraction of the pixel that shows snow", 1 / 255, 8),
    ),
    measures=(
        Measure("snow_share", "mask_snow"),
        Measure("mean_snow_thickness_m", "snow_thickness", "mask_snow"),
    ),
    only_with=(
        *((name, "light", ("paper",)) for name in _PAPER),
        *((name, "light", ("scene",)) for name in _SCENE),
        ("soot", "albedo", (None,)),
    ),
    only_beside=(("slope_sharpness", ("slope",)), ("wind_direction", ("fall_tilt", "drift"))),
    after=("sky", "flood", "season"),
    version="6",
    prepared_from=(
        "snow.fall_tilt",
        "snow.wind_direction",
        "snow.drift",
        "snow.light",
        "snow.slope",
        "snow.slope_sharpness",
        "snow.sun_share",
        "snow.shade",
        "snow.shadows",
        "sun.elevation",
        "sun.azimuth",
        "seed",
    ),
)
