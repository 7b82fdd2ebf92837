"""Checks without a formula: water levels are nested, seeds decide, and no weather changes nothing.

The functions compare frames of any scene, so that they serve the analytic one and a user's run.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from climatenerf.core.cameras import Camera
from climatenerf.core.device import CPU, to_numpy
from climatenerf.field.analytic import AnalyticField, Box, HalfSpace
from climatenerf.render.session import Frame
from climatenerf.verification.check import Check
from climatenerf.verification.closed_forms import linear_from_display, plane_distance
from climatenerf.verification.setting import (
    Viewpoint,
    clear_fraction,
    looking,
    radiance,
    session_in,
    sky_of,
)
from climatenerf.weather.flood.parameters import Flood
from climatenerf.weather.smog.parameters import Smog
from climatenerf.weather.snow.parameters import Snow
from climatenerf.weather.weather import Weather

RISE = 0.1  # of the ground along y
NORMAL = (0.0, -RISE / math.hypot(RISE, 1.0), 1.0 / math.hypot(RISE, 1.0))
LEVELS = (-0.15, -0.05, 0.05, 0.15)  # m
VIEW = Viewpoint(
    Camera(64, 36, 40.0, 40.0, 32.0, 18.0), looking((0.0, -2.8, 1.4), (0.0, 1.0, -0.35))
)
STORMY: dict[str, Any] = {
    "smog": Smog(visibility=40.0),
    "flood": Flood(level=0.0, wind_speed=4.0),
    "snow": Snow(depth=0.1),
}
NOTHING: dict[str, Any] = {"smog": Smog(sigma=0.0), "snow": Snow(depth=0.0)}
FAINT_COLOUR = (1.0, 1.0, 0.0)
FAINT: dict[str, Any] = {"smog": Smog(visibility=1e7, light="paper", colour=FAINT_COLOUR)}
OPAQUE = 1e-3  # fraction of the sky's light below which a pixel counts as opaque
DEFINITION = "definition"


def checks(device: torch.device = CPU) -> Iterator[Check]:
    """Render a rising street with two boxes, and compare its frames with each other."""
    field = street(device)

    def seen(weather: Weather) -> Frame:
        return session_in(field, weather, VIEW).frame(VIEW.camera, VIEW.c2w)

    clean = seen(Weather())
    wet = [seen(Weather(flood=Flood(level=level, wind_speed=0.0))) for level in LEVELS]
    coverage = [frame.layers["mask_water"] for frame in wet]
    yield nested(coverage)
    yield coverage_loss(coverage)
    yield water_depth(wet[-1], clean)
    first, again = (seen(Weather(seed=1, **STORMY)) for _ in range(2))
    yield same_seed(first, again)
    yield other_seed(first, seen(Weather(seed=2, **STORMY)))
    nothing = seen(Weather(**NOTHING))
    yield no_effect(clean, nothing)
    yield no_effect_on_layers(clean, nothing)
    clear = clear_fraction(field, VIEW)
    yield faint_smog(clean, seen(Weather(**FAINT)), sky_of(field, VIEW), clear)
    still = Flood(level=-1.0, wind_speed=0.0)
    yield faint("flood", clean, seen(Weather(flood=still)), clear)
    yield faint("snow", clean, seen(Weather(snow=Snow(depth=1e-4))), clear)


def street(device: torch.device) -> AnalyticField:
    """Ground that rises along y, with a checker pattern, and two boxes."""
    return AnalyticField(
        [
            HalfSpace(NORMAL, 0.0, (0.30, 0.33, 0.2), checker=0.4),
            Box((-1.4, 1.0, -0.5), (-0.4, 2.0, 1.2), (0.6, 0.3, 0.2)),
            Box((0.5, -0.4, -0.5), (1.2, 0.3, 0.5), (0.2, 0.2, 0.7)),
        ],
        zenith=(0.3, 0.5, 0.9),
        horizon=(0.8, 0.8, 0.8),
        box=((-2.0, -2.0, -1.0), (2.0, 2.0, 2.0)),
        device=device,
    )


def nested(coverage: Sequence[np.ndarray], name: str = "flood levels nested") -> Check:
    """Count the pixels that fall dry as the level rises: sets below rising planes are nested.

    Args:
        coverage: the layer `mask_water`, levels ascending; a pixel of more than one half is wet.
        name: of the check.
    """
    pairs = zip(coverage, coverage[1:], strict=False)
    dried = sum(int(((low > 0.5) & (high <= 0.5)).sum()) for low, high in pairs)
    compares = "wet pixels that are dry at a higher level"
    return Check(name, compares, float(dried), 0.0, "pixels", DEFINITION)


def coverage_loss(
    coverage: Sequence[np.ndarray],
    name: str = "flood coverage",
    threshold: float | None = 1e-4,
) -> Check:
    """Measure the largest fraction of a pixel that falls dry as the level rises.

    Args:
        coverage: the layer `mask_water`, levels ascending.
        name: of the check.
        threshold: None where it is information. The width of the soft shore follows from the
            field's normals, which differ from level to level if the field is blurred.
    """
    pairs = zip(coverage, coverage[1:], strict=False)
    lost = max(float((low - high).max()) for low, high in pairs)
    compares = "water coverage that any pixel loses as the level rises"
    return Check(name, compares, max(lost, 0.0), threshold, "1", DEFINITION)


def water_depth(wet: Frame, clean: Frame) -> Check:
    """Compare the layer `water_depth` with the level less the height of the ground behind.

    The ground is the plane z = RISE y, where the ray meets it before any box.
    """
    directions = VIEW.directions()
    distance = plane_distance(VIEW.eye, directions, NORMAL)
    ground = np.abs(clean.layers["depth"] - distance) < 0.01
    flooded = ground & (wet.layers["mask_water"] > 0.999)
    expected = LEVELS[-1] - (VIEW.eye[2] + distance[flooded] * directions[flooded][:, 2])
    errors = np.abs(wet.layers["water_depth"][flooded] - expected)
    error = 1000 * float(errors.max()) if flooded.any() else math.nan
    compares = "layer water_depth with the level over the sloping ground"
    return Check("flood water depth", compares, error, 5.0, "mm", "geometry of the ray")


def same_seed(first: Frame, again: Frame, name: str = "same seed") -> Check:
    """Count the bytes of radiance, picture and layers that differ between two equal renders."""
    layers = [(first.layers[layer], again.layers[layer]) for layer in first.layers]
    changed = sum(_differing_bytes(*pair) for pair in [*_pictures(first, again), *layers])
    compares = "bytes that differ between two sessions of one seed"
    return Check(name, compares, float(changed), 0.0, "bytes", DEFINITION)


def other_seed(first: Frame, other: Frame, name: str = "other seed") -> Check:
    """Measure the fraction of water pixels whose waves another seed leaves as they are."""
    wet = first.layers["mask_water"] > 0.5
    equal = (to_numpy(first.linear) == to_numpy(other.linear)).all(-1)
    compares = "fraction of water pixels that another seed leaves unchanged"
    if not wet.any():
        return Check(name, f"{compares} (no water in view)", math.nan, None, "1", DEFINITION)
    return Check(name, compares, float(equal[wet].mean()), 0.05, "1", DEFINITION)


def no_effect(clean: Frame, weathered: Frame, name: str = "no effect") -> Check:
    """Count the bytes of the picture that weather of zero strength changes."""
    compares = "bytes of the picture that smog of extinction 0 and snow of depth 0 change"
    changed = sum(_differing_bytes(*pair) for pair in _pictures(clean, weathered))
    return Check(name, compares, float(changed), 0.0, "bytes", DEFINITION)


def no_effect_on_layers(clean: Frame, weathered: Frame, name: str = "no effect on layers") -> Check:
    """Measure how far weather of zero strength changes the layers.

    A frame without weather is composited by another kernel, which may round otherwise.
    """
    errors = []
    for layer, before in clean.layers.items():
        after = weathered.layers[layer]
        equal = before == after  # also where both are infinite
        errors.append(np.abs(after[~equal] - before[~equal]) / (1 + np.abs(before[~equal])))
    error = float(np.concatenate(errors).max(initial=0.0))
    compares = "change of the layers by the same, over 1 + the layer's value"
    return Check(name, compares, error, 1e-5, "1", DEFINITION)


def faint_smog(
    clean: Frame,
    weathered: Frame,
    sky: Float[np.ndarray, "h w 3"],
    clear: Float[np.ndarray, "h w"],
    name: str = "no effect of faint smog",
) -> Check:
    """Compare smog of 10 000 km visibility with the clean frame under a sky of its colour.

    Smog without a top has infinite depth, so that it hides the sky at any visibility.

    Args:
        clean: the frame without weather.
        weathered: the frame in smog.
        sky: radiance of the sky in each pixel's direction.
        clear: fraction of each pixel's light that comes from the sky.
        name: of the check.
    """
    colour = np.array([linear_from_display(each) for each in FAINT_COLOUR])
    expected = radiance(clean) + clear[..., None] * (colour - sky)
    error = 255 * float(np.abs(radiance(weathered) - expected).max())
    compares = "steps of 1/255 by which smog of 10 000 km visibility changes what is not sky"
    return Check(name, compares, error, 1.0, "steps", "Beer-Lambert law, limit of sigma 0")


def faint(kind: str, clean: Frame, weathered: Frame, clear: Float[np.ndarray, "h w"]) -> Check:
    """Measure how far weather close to none changes the 8-bit picture, where no sky shows."""
    limit = {"flood": "water 1 m below the datum", "snow": "snow of 0.1 mm"}[kind]
    steps = np.abs(clean.picture.astype(int) - weathered.picture.astype(int))
    error = float(steps[clear < OPAQUE].max())
    compares = f"8-bit steps by which {limit} changes opaque pixels"
    return Check(f"no effect of faint {kind}", compares, error, 1.0, "steps", DEFINITION)


def _pictures(first: Frame, other: Frame) -> list[tuple[np.ndarray, np.ndarray]]:
    return [(to_numpy(first.linear), to_numpy(other.linear)), (first.picture, other.picture)]


def _differing_bytes(first: np.ndarray, other: np.ndarray) -> int:
    a, b = (
        np.frombuffer(np.ascontiguousarray(each).tobytes(), np.uint8) for each in (first, other)
    )
    return int((a != b).sum())
