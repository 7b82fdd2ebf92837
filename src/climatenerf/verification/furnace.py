"""White furnaces: surroundings of radiance 1 and weather of albedo 1 show 1 everywhere.

Kirchhoff's law of radiation: in thermal equilibrium nothing can be seen. It holds whatever is
absorbed, reflected or refracted, so it tests that weights sum to 1 in all of the renderer.
"""

import math
from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Float

from climatenerf.core.cameras import Camera
from climatenerf.core.device import CPU
from climatenerf.field.analytic import AnalyticField, HalfSpace
from climatenerf.verification.check import Check
from climatenerf.verification.setting import (
    IOR,
    Viewpoint,
    frame_in,
    looking,
    radiance,
    session_in,
)
from climatenerf.weather.flood.parameters import Flood
from climatenerf.weather.smog.parameters import Smog
from climatenerf.weather.snow.parameters import Snow
from climatenerf.weather.weather import Weather

WHITE = (1.0, 1.0, 1.0)
VIEW = Viewpoint(
    Camera(48, 36, 30.0, 30.0, 24.0, 18.0), looking((0.0, -1.5, 1.6), (0.0, 1.0, -0.3))
)
NEAR = Viewpoint(
    Camera(40, 30, 40.0, 40.0, 20.0, 15.0), looking((0.0, -1.2, 1.6), (0.0, 1.0, -1.3))
)
KIRCHHOFF = "Kirchhoff's law of radiation"


def checks(device: torch.device = CPU) -> Iterator[Check]:
    """Render white weather in a white scene."""
    field = AnalyticField(
        [HalfSpace(colour=WHITE)],
        zenith=WHITE,
        horizon=WHITE,
        box=((-2.0, -2.0, -1.0), (2.0, 2.0, 2.0)),
        device=device,
    )
    smog = Smog(sigma=0.3, height_falloff=5.0, colour=WHITE)
    waves = Flood(level=0.3, wind_speed=4.0, attenuation=(0.0, 0.0, 0.0), colour=WHITE, ior=IOR)
    muddy = Flood(level=0.3, wind_speed=4.0, clarity=0.5, colour=WHITE, ior=IOR)
    yield smog_furnace(radiance(frame_in(field, Weather(smog=smog), VIEW)))
    session = session_in(field, Weather(flood=waves), VIEW)
    clear = radiance(session.frame(VIEW.camera, VIEW.c2w))
    session.change(Weather(flood=muddy))
    yield water_furnace(clear, radiance(session.frame(VIEW.camera, VIEW.c2w)))
    # From nearer, as the edge of the snow is not level.
    yield snow_furnace(radiance(frame_in(field, Weather(snow=Snow(depth=0.1, albedo=1.0)), NEAR)))


def smog_furnace(measured: Float[np.ndarray, "h w 3"]) -> Check:
    """Compare white smog in a white scene with 1."""
    compares = "white smog in a scene of radiance 1 with 1"
    return Check("white furnace smog", compares, _error(measured), 1e-5, "1", KIRCHHOFF)


def water_furnace(clear: Float[np.ndarray, "h w 3"], muddy: Float[np.ndarray, "h w 3"]) -> Check:
    """Compare waves on clear and on white muddy water in a white scene with 1."""
    error = max(_error(clear), _error(muddy))
    compares = "clear and white muddy water with waves, in a scene of radiance 1, with 1"
    return Check("white furnace water", compares, error, 1e-3, "1", KIRCHHOFF)


def snow_furnace(measured: Float[np.ndarray, "h w 3"]) -> Check:
    """Compare snow on level white ground with 1.

    The tolerance is wider because the light between snow and its surroundings is stored in 8 bits,
    and is not traced: only level snow under an open sky has to be white.
    """
    compares = "level snow of albedo 1 on white ground, in a scene of radiance 1, with 1"
    return Check("white furnace snow", compares, _error(measured), 5e-3, "1", KIRCHHOFF)


def _error(measured: Float[np.ndarray, "h w 3"]) -> float:
    return float(np.abs(measured - 1).max()) if np.isfinite(measured).all() else math.nan
