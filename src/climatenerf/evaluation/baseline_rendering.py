"""Apply the picture baselines to one weather, with tuned constants."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Float, UInt8

from climatenerf.core.srgb import linear_colour, to_display
from climatenerf.evaluation import baselines
from climatenerf.evaluation.baselines import CleanView
from climatenerf.weather.description import KeyframedWeather
from climatenerf.weather.flood import optics, waves
from climatenerf.weather.smog import medium as smog

Picture = UInt8[np.ndarray, "h w 3"]


class WeatherAtTime(Protocol):
    """A weather and the moment that is shown: a `WeatherMoment`, or one of the reference set."""

    @property
    def weather(self) -> KeyframedWeather:
        """The weather over time."""
        ...

    @property
    def time(self) -> float:
        """The moment, s."""
        ...


@dataclass(frozen=True)
class WeatherMoment:
    """A weather and the moment that is shown, s."""

    weather: KeyframedWeather
    time: float


@dataclass(frozen=True)
class Constants:
    """Free constants of the baselines in one weather; None where the weather lacks the effect.

    Attributes:
        sigma: extinction of depth-fog, 1/m.
        water: linear colour of flat-plane.
        water_body: linear colour below the surface of screen-reflection.
        snow: linear colour of white-paint.
    """

    sigma: float | None = None
    water: Float[np.ndarray, "3"] | None = None
    water_body: Float[np.ndarray, "3"] | None = None
    snow: Float[np.ndarray, "3"] | None = None


def tune(
    case: WeatherAtTime, ground_z: float, views: list[CleanView], true: list[Picture]
) -> Constants:
    """Fit the baselines' constants for one weather to its true pictures.

    Args:
        case: the weather.
        ground_z: ground datum of the run, m.
        views: clean renders.
        true: display pictures of the same views.
    """
    weather = case.weather.at(case.time)
    sigma = water = water_body = snow = None
    medium = smog.medium(weather.smog, ground_z)
    if medium is not None:
        sigma = baselines.tuned_sigma(views, true, medium.sigma, np.array(medium.colour))
    if weather.flood.level is not None:
        level = ground_z + weather.flood.level
        wet = [baselines.wet_pixels(view, level)[0].astype(float) for view in views]
        dry = _without(views, wet)
        water = baselines.tuned_colour(dry, wet, true)
        bases, coverages = [], []
        for base, view, coverage in zip(dry, views, wet, strict=True):
            reflected, reflectance = _reflection(case, ground_z, view)
            bases.append(base + (coverage * reflectance)[..., None] * reflected)
            coverages.append(coverage * (1 - reflectance))
        water_body = baselines.tuned_colour(bases, coverages, true)
    if weather.snow.depth is not None:
        coverages = [baselines.snow_coverage(view) for view in views]
        snow = baselines.tuned_colour(_without(views, coverages), coverages, true)
    return Constants(sigma, water, water_body, snow)


def painted_snow(
    bare: list[Float[np.ndarray, "h w 3"]],
    masks: list[Float[np.ndarray, "h w"]],
    true: list[Picture],
) -> list[Picture]:
    """White paint where our snow lies, on our own pictures: what its light and shape add.

    Args:
        bare: linear pictures of the place in the light that snow returns, without the snow.
        masks: fraction of each pixel that shows our snow.
        true: display pictures of the same views, to which the colour of the paint is fitted.
    """
    rest = [base * (1 - mask[..., None]) for base, mask in zip(bare, masks, strict=True)]
    colour = baselines.tuned_colour(rest, masks, true)
    pictures = (to_display(r + m[..., None] * colour) for r, m in zip(rest, masks, strict=True))
    return [(255 * picture + 0.5).astype(np.uint8) for picture in pictures]


def _without(
    views: list[CleanView], coverages: list[Float[np.ndarray, "h w"]]
) -> list[Float[np.ndarray, "h w 3"]]:
    """Return the radiance of clean views that their covers do not hide."""
    return [v.linear * (1 - c[..., None]) for v, c in zip(views, coverages, strict=True)]


def render_baseline(
    case: WeatherAtTime,
    ground_z: float,
    view: CleanView,
    constants: Constants,
    name: str,
    seed: int,
) -> Float[np.ndarray, "h w 3"] | None:
    """Return the display picture of a baseline; None where it cannot show this weather.

    Args:
        case: the weather.
        ground_z: ground datum of the run, m.
        view: the clean render.
        constants: of this weather, from `tune`.
        name: one of `baselines.NAMES`.
        seed: random seed of frame-noise, one per frame.
    """
    weather = case.weather.at(case.time)
    if name == "frame-noise":
        for other in ("depth-fog", "flat-plane", "white-paint"):
            picture = render_baseline(case, ground_z, view, constants, other, seed)
            if picture is not None:
                return baselines.frame_noise(picture, seed)
        return None
    if name == "depth-fog" and constants.sigma is not None:
        colour = np.array(linear_colour(weather.smog.colour or smog.PAPER_COLOUR))
        return to_display(baselines.depth_fog(view, constants.sigma, colour))
    if name == "white-paint" and constants.snow is not None:
        coverage = baselines.snow_coverage(view)
        return to_display(baselines.overlay(view.linear, coverage, constants.snow))
    if weather.flood.level is None or constants.water is None or constants.water_body is None:
        return None
    level = ground_z + weather.flood.level
    if name == "flat-plane":
        return to_display(baselines.flat_plane(view, level, constants.water))
    if name == "screen-reflection":
        wet = baselines.wet_pixels(view, level)[0]
        reflected, reflectance = _reflection(case, ground_z, view)
        r = reflectance[..., None]
        water = r * reflected + (1 - r) * constants.water_body
        return to_display(np.where(wet[..., None], water, view.linear))
    return None


def _reflection(
    case: WeatherAtTime, ground_z: float, view: CleanView
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
    """Return reflected radiance and reflectance in screen space, with the waves of our renders."""
    weather = case.weather.at(case.time)
    assert weather.flood.level is not None
    level = ground_z + weather.flood.level
    surface = waves.at_time(waves.make_waves(weather.flood, weather.seed), case.time)
    wet, t = baselines.wet_pixels(view, level)
    t = np.where(wet, t, 0.0)
    x = (view.c2w[:3, 3] + t[..., None] * view.rays_d)[..., :2].reshape(-1, 2)
    length = torch.from_numpy(t.ravel()).float()
    rays_d = torch.from_numpy(view.rays_d.reshape(-1, 3)).float()
    pixel_angle = torch.full_like(length, 1.0 / view.camera.fx)
    footprint = optics.footprint(length, rays_d, pixel_angle)
    slope = surface.at(torch.from_numpy(x).float(), footprint)[1]
    slope = slope.double().numpy().reshape(*t.shape, 2)
    return baselines.screen_reflection(view, level, weather.flood.ior, slope)
