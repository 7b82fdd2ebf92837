"""The baselines applied to one weather of the reference set, their constants tuned on its truth."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8

from climatenerf.core.srgb import linear_colour, to_display
from climatenerf.evaluation import baselines
from climatenerf.evaluation.baselines import Dry
from climatenerf.evaluation.reference import WeatherTruth
from climatenerf.weather.flood import optics as water_physics
from climatenerf.weather.flood import waves
from climatenerf.weather.smog import medium as smog

Picture = UInt8[np.ndarray, "h w 3"]


def tune(
    kind: WeatherTruth, ground_z: float, dry: list[Dry], real: list[Picture]
) -> dict[str, Any]:
    """The baselines' free constants for one weather, fitted to its true pictures.

    Args:
        kind: which weather.
        ground_z: the run's ground datum, m.
        dry: our clean views.
        real: the true pictures of the same views.
    """
    weather = kind.weather.at(kind.time)
    out: dict[str, Any] = {}
    air = smog.medium(weather.smog, ground_z)
    if air is not None:
        out["sigma"] = baselines.tuned_sigma(dry, real, air.sigma, np.array(air.colour))
    if weather.flood.level is not None:
        level = ground_z + weather.flood.level
        wet = [baselines.wet_pixels(each, level)[0].astype(float) for each in dry]
        out["flat"] = baselines.tuned_colour(_uncovered(dry, wet), wet, real)
        bases, shares = [], []
        for base, each, share in zip(_uncovered(dry, wet), dry, wet, strict=True):
            reflected, part = _mirrored(kind, ground_z, each)
            bases.append(base + (share * part)[..., None] * reflected)
            shares.append(share * (1 - part))
        out["body"] = baselines.tuned_colour(bases, shares, real)
    if weather.snow.depth is not None:
        shares = [baselines.white_paint(each) for each in dry]
        out["white"] = baselines.tuned_colour(_uncovered(dry, shares), shares, real)
    return out


def _uncovered(dry: list[Dry], shares: list[np.ndarray]) -> list[np.ndarray]:
    """What of the clean pictures is left beside what covers them."""
    return [d.linear * (1 - s[..., None]) for d, s in zip(dry, shares, strict=True)]


def painted(
    kind: WeatherTruth, ground_z: float, dry: Dry, tuned: dict[str, Any], name: str, seed: int
) -> Float[np.ndarray, "h w 3"] | None:
    """A baseline's display picture of a weather; None where it has nothing to say about it."""
    weather = kind.weather.at(kind.time)
    if name == "frame-noise":
        for simple in ("depth-fog", "flat-plane", "white-paint"):
            picture = painted(kind, ground_z, dry, tuned, simple, seed)
            if picture is not None:
                return baselines.frame_noise(picture, seed)
        return None
    if name == "depth-fog" and "sigma" in tuned:
        colour = np.array(linear_colour(weather.smog.colour))
        return to_display(baselines.depth_fog(dry, tuned["sigma"], colour))
    if name == "white-paint" and "white" in tuned:
        share = baselines.white_paint(dry)
        return to_display(baselines.painted(dry.linear, share, tuned["white"]))
    if weather.flood.level is None or "flat" not in tuned:
        return None
    level = ground_z + weather.flood.level
    if name == "flat-plane":
        return to_display(baselines.flat_plane(dry, level, tuned["flat"]))
    if name == "screen-reflection":
        wet = baselines.wet_pixels(dry, level)[0]
        reflected, part = _mirrored(kind, ground_z, dry)
        water = part[..., None] * reflected + (1 - part[..., None]) * tuned["body"]
        return to_display(np.where(wet[..., None], water, dry.linear))
    return None


def _mirrored(kind: WeatherTruth, ground_z: float, dry: Dry) -> tuple[np.ndarray, np.ndarray]:
    """Screen-space reflection in the very waves that ours has."""
    weather = kind.weather.at(kind.time)
    assert weather.flood.level is not None
    level = ground_z + weather.flood.level
    frame = waves.at_time(waves.make_waves(weather.flood, weather.seed), kind.time)
    wet, t = baselines.wet_pixels(dry, level)
    t = np.where(wet, t, 0.0)
    x = (dry.c2w[:3, 3] + t[..., None] * dry.rays_d)[..., :2].reshape(-1, 2)
    length = torch.from_numpy(t.ravel()).float()
    rays_d = torch.from_numpy(dry.rays_d.reshape(-1, 3)).float()
    angle = torch.full_like(length, 1.0 / dry.camera.fx)
    print_size = water_physics.footprint(length, rays_d, angle)
    slope = waves.slopes(frame, torch.from_numpy(x).float(), print_size)[0]
    slope = slope.double().numpy().reshape(*t.shape, 2)
    return baselines.screen_reflection(dry, level, weather.flood.ior, slope)
