"""Checks of the thickness of snow on level ground."""

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Float

from climatenerf.core.cameras import Camera
from climatenerf.core.device import CPU
from climatenerf.field.analytic import AnalyticField, HalfSpace
from climatenerf.render.session import Frame
from climatenerf.verification.check import Check
from climatenerf.verification.setting import Viewpoint, looking, session_in
from climatenerf.weather.snow.parameters import Snow
from climatenerf.weather.weather import Weather

DEPTHS = (0.05, 0.15, 0.4)  # m
VIEW = Viewpoint(
    Camera(40, 30, 40.0, 40.0, 20.0, 15.0), looking((0.0, -1.2, 1.6), (0.0, 1.0, -1.3))
)
GEOMETRY = "geometry of the ray"


def checks(device: torch.device = CPU) -> Iterator[Check]:
    """Let snow of several depths lie on a plane, and measure it in the picture."""
    field = AnalyticField([HalfSpace()], box=((-2.0, -2.0, -1.0), (2.0, 2.0, 2.0)), device=device)
    session = session_in(field, Weather(snow=Snow(depth=DEPTHS[0])), VIEW)
    frames = []
    for depth in DEPTHS:
        session.change(Weather(snow=Snow(depth=depth)))
        frames.append(session.frame(VIEW.camera, VIEW.c2w))
    heights = [surface_height(frame) for frame in frames]
    yield depth_on_plane(heights)
    yield thickness_layer([frame.layers["snow_thickness"] for frame in frames], heights)


def surface_height(frame: Frame) -> Float[np.ndarray, "h w"]:
    """Height over the ground, z = 0, of the surface that each pixel shows, m."""
    return VIEW.eye[2] + frame.layers["depth"].astype(np.float64) * VIEW.directions()[..., 2]


def depth_on_plane(heights: list[Float[np.ndarray, "h w"]]) -> Check:
    """Compare the height of the visible surface over a plane with the depth that was asked.

    The height follows from the ray length alone, not from the layer `snow_thickness`.
    """
    errors = [abs(h.mean() / asked - 1) for h, asked in zip(heights, DEPTHS, strict=True)]
    compares = "mean height over a plane, 5 to 40 cm, with the depth that was asked"
    return Check("snow depth", compares, 100 * float(max(errors)), 5.0, "%", GEOMETRY)


def thickness_layer(
    layers: list[Float[np.ndarray, "h w"]], heights: list[Float[np.ndarray, "h w"]]
) -> Check:
    """Compare the layer `snow_thickness` with the height of the visible surface."""
    errors = [np.abs(layer - h).max() for layer, h in zip(layers, heights, strict=True)]
    compares = "layer snow_thickness with the height over the plane"
    return Check("snow layer", compares, 1000 * float(max(errors)), 2.0, "mm", GEOMETRY)
