"""The sky that photos clip or do not show: a base from horizon to zenith, and a bright lobe."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import optimize

from climatenerf.core.srgb import LUMA
from climatenerf.weather.light.captured import CLIPPED
from climatenerf.weather.light.spherical import sphere_directions

DARK = 2e-3  # radiance; photos show nothing below
DIRECTIONS = 384  # over the whole sphere
CLOUDS = 60  # independent patches of the sky that photos show
SKY_ERROR = 0.08  # of log radiance, by clouds
GROUND_ALBEDO = 0.18  # a grey card; assumed of the log-average of level ground
ALBEDO_SPREAD = 0.5  # of its log: asphalt and grass .1, concrete .3
ANY_SKY = 0.0, 0.35  # log of zenith over horizon and its spread: clear .25 to .5, overcast 3
GLOWING_SKY = -0.2, 0.1  # the same with a bright lobe, see `fit_sky`
TYPICAL_WIDTH, WIDTH_SPREAD = np.radians(20.0), 0.5  # of a sun behind thin cloud; of its log
WHITE = np.ones(3)


def gathering_directions() -> Float[np.ndarray, "k 3"]:
    """Directions in which light is gathered, evenly over the whole sphere."""
    return sphere_directions(DIRECTIONS).double().numpy()


@dataclass(frozen=True)
class SkyModel:
    """Base and bright lobe of a sky; see `captured.CapturedLight`."""

    horizon: Float[np.ndarray, "3"]
    zenith: Float[np.ndarray, "3"]
    sun: Float[np.ndarray, "3"] | None
    width: float
    lobe: Float[np.ndarray, "3"]


def fit_sky(
    d: Float[np.ndarray, "n 3"],
    radiance: Float[np.ndarray, "n 3"],
    ground: float = 0.0,
    lobe: bool = False,
) -> SkyModel:
    """Fit base and lobe to the sky that photos show, which clip at white.

    What photos show of a bright lobe is its flank, which leaves its height open: a high and bright
    one looks like a low and dim one. Of these the fit takes the one whose light on level ground
    agrees best with an albedo of `GROUND_ALBEDO`.

    Photos show the sky near the horizon, where clouds and hills can rise faster than the sky does.
    A sky with a bright lobe is drawn towards what the CIE's general skies with one have (ISO 15469,
    types 7 to 15): their zenith is as bright as their horizon or darker.

    Args:
        d: directions of sky in the photos.
        radiance: of the fitted sky there.
        ground: log-average luma of level ground that photos show; 0: unknown.
        lobe: whether there is a lobe besides the base.
    """
    middle, spread = GLOWING_SKY if lobe else ANY_SKY
    rgb = np.minimum(radiance, 1.0)
    brightness = np.maximum(rgb @ LUMA, DARK)
    grid = gathering_directions()
    grid = grid[grid[:, 2] > 0]
    share = np.sqrt(CLOUDS / len(d)) / SKY_ERROR

    def model(p: np.ndarray, at: np.ndarray) -> np.ndarray:
        base = np.exp(p[0]) * (1 + (np.exp(p[1]) - 1) * np.clip(at[:, 2], 0, 1))
        if not lobe:
            return base
        angle = np.arccos(np.clip(at @ _direction(p[2], p[3]), -1, 1))
        return base + np.exp(p[5]) * np.exp(-((angle / np.exp(p[4])) ** 2))

    def residuals(p: np.ndarray) -> np.ndarray:
        shown = np.log(np.minimum(model(p, d), 1.0)) - np.log(brightness)
        level = (model(p, grid) * grid[:, 2]).sum() * 4 * np.pi / DIRECTIONS
        expected = np.log(level / np.pi * GROUND_ALBEDO / ground) if ground > 0 else 0.0
        prior = [(p[1] - middle) / spread, expected / ALBEDO_SPREAD]
        if lobe:
            prior.append((p[4] - np.log(TYPICAL_WIDTH)) / WIDTH_SPREAD)
        return np.concatenate([share * shown, prior])

    bright = d[brightness >= np.quantile(brightness, 0.95)].mean(0)
    azimuth = float(np.arctan2(bright[0], bright[1]))
    low = [-5.0, np.log(0.15), np.radians(3), azimuth - 2, np.log(np.radians(6)), np.log(0.05)]
    high = [1.0, np.log(4.0), np.radians(80), azimuth + 2, np.log(np.radians(40)), np.log(40.0)]
    count = 6 if lobe else 2
    best = None
    for elevation in (15.0, 40.0, 60.0) if lobe else (0.0,):
        start = [np.log(np.median(brightness)), 0.0, np.radians(elevation), azimuth]
        start = [*start, np.log(TYPICAL_WIDTH), np.log(2.0)][:count]
        start = np.clip(start, np.array(low[:count]) + 1e-3, np.array(high[:count]) - 1e-3)
        found = optimize.least_squares(
            residuals, start, bounds=(low[:count], high[:count]), loss="soft_l1"
        )
        best = found if best is None or found.cost < best.cost else best
    assert best is not None
    p = best.x
    # The base's colour is that of the sky where it is darker than white.
    plain = (rgb.max(-1) < CLIPPED) if (rgb.max(-1) < CLIPPED).any() else np.ones(len(rgb), bool)
    colour = np.median(rgb[plain] / brightness[plain, None], axis=0)
    zenith_colour = colour / (colour @ LUMA)
    horizon = np.exp(p[0]) * zenith_colour
    zenith = np.exp(p[0] + p[1]) * zenith_colour
    if not lobe:
        return SkyModel(horizon, zenith, None, 0.0, np.zeros(3))
    # Sunlight through thin cloud is white.
    return SkyModel(
        horizon, zenith, _direction(p[2], p[3]), float(np.exp(p[4])), np.exp(p[5]) * WHITE
    )


def _direction(elevation: float, azimuth: float) -> Float[np.ndarray, "3"]:
    flat = np.cos(elevation)
    return np.array([flat * np.sin(azimuth), flat * np.cos(azimuth), np.sin(elevation)])
