"""The sky of a season: part of the photographed sky, and of its sun, gives way to it."""

import functools
import math
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from climatenerf.core.colour import luma
from climatenerf.weather.light.scene_light import Radiance, SceneLight
from climatenerf.weather.season.palettes import palettes_of
from climatenerf.weather.season.parameters import Season
from climatenerf.weather.style import SkyPalette, Style


def sky_of(season: Season, style: Style | None) -> SkyPalette | None:
    """The sky that a season brings, or the style of the run; None if it stays that of the photos.

    Args:
        season: as asked for.
        style: of the run; None: it has none.
    """
    if season.strength == 0:
        return None
    if season.kind == "captured":
        return None if style is None else style.sky
    return palettes_of(season.kind).sky


def under_season(season: Season, style: Style | None, light: SceneLight) -> SceneLight:
    """The light of the photos under the season's sky; what surfaces send back is still the old.

    L'(d) = (1 - u) L(d) + u l a (1 + g z), with the sky's share u, colour a, gradient g and the
    height z of the direction. Its level l keeps the luminance of open ground, as a camera would.
    """
    palette = sky_of(season, style)
    if palette is None:
        return light
    share = palette.share * season.strength
    # Integral of (1 + g z) z over the upper hemisphere.
    whole = math.pi * (1 + palette.gradient * 2 / 3)
    level = float(luma(light.open_irradiance())) / whole
    colour = light.sun_irradiance.new_tensor(palette.colour) * level
    radiance = functools.partial(_mixed, light.radiance, share, colour, palette.gradient)
    beam = (1 - share) * light.sun_irradiance
    balance = (1 - share) * light.balance + share  # the season's sky has the colour that it has
    return replace(light, radiance=radiance, sun_irradiance=beam, captured=None, balance=balance)


def _mixed(
    sky: Radiance,
    share: float,
    colour: Float[Tensor, "3"],
    gradient: float,
    d: Float[Tensor, "n 3"],
) -> Float[Tensor, "n 3"]:
    height = d[:, 2:].clamp_min(0)
    return (1 - share) * sky(d) + share * colour * (1 + gradient * height)
