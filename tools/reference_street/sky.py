"""The illumination: a cloudy sky with a broad sun, dusk, an overcast sky, a clear sky with its sun.

All but the last are equirectangular pictures.
"""

import numpy as np
from jaxtyping import Float

from tools.reference_street.textures import noise

SUN_AZIMUTH = 218.0  # degrees from +y towards +x
SUN_ELEVATION = 40.0  # degrees
SUN_WIDTH = 24.0  # degrees to 1/e, as through thin cloud. Paths through water hit the sun only by
# chance; a narrow sun would give fireflies at any affordable number of samples.
SUN_RADIANCE = 5.5  # relative to a cloudy sky of about 0.8

OVERCAST_ZENITH = 1.28  # radiance; exposed, the sky is white from 70 degrees up
TURBIDITY = 3.0  # of the clear sky: clean air
GROUND_ALBEDO = 0.15  # of the surroundings that light the clear sky from below
CLEAR_GAIN = 3.9  # of the clear sky's model, for about the cloudy sky's irradiance
CLEAR_SHEET = (1.334, 1.216, 1.130)  # irradiance over pi of level ground under it, integrated

DUSK_WIDTH, DUSK_HEIGHT = 55.0, 11.0  # degrees to 1/e of the glow at the horizon after sunset


def direction(azimuth: float, elevation: float) -> Float[np.ndarray, "3"]:
    """Return the unit world vector of an azimuth (from +y to +x) and elevation, degrees."""
    a, e = np.deg2rad([azimuth, elevation])
    return np.array([np.sin(a) * np.cos(e), np.cos(a) * np.cos(e), np.sin(e)])


def _directions(height: int) -> Float[np.ndarray, "h w 3"]:
    """Return the world direction of each texel of an environment."""
    width = 2 * height
    azimuth = 2 * np.pi * (np.arange(width) + 0.5) / width
    polar = np.pi * (np.arange(height) + 0.5) / height
    az, po = np.meshgrid(azimuth, polar)
    return np.stack([np.sin(po) * np.sin(az), np.sin(po) * np.cos(az), np.cos(po)], -1)


def environment(height: int = 512) -> Float[np.ndarray, "h w 3"]:
    """Return linear radiance; row 0 is the zenith, column 0 faces +y, columns go towards +x."""
    rng = np.random.default_rng(11)
    d = _directions(height)
    up = np.clip(d[..., 2], 0, 1)[..., None]
    zenith, horizon = np.array([0.66, 0.74, 0.86]), np.array([0.80, 0.84, 0.88])
    sky = horizon + (zenith - horizon) * up**0.5
    # A flat cloud layer in perspective: noise at the intersection of each ray with the layer.
    tile = 1024
    layer = 0.75 * noise((tile, tile), 1.5, rng) + 0.25 * noise((tile, tile), 1.0, rng)
    plane = d[..., :2] / (up + 0.18) * 190.0
    low = np.floor(plane).astype(int)
    fx, fy = np.moveaxis(plane - low, -1, 0)
    cloud = sum(
        layer[(low[..., 1] + j) % tile, (low[..., 0] + i) % tile]
        * (fx if i else 1 - fx)
        * (fy if j else 1 - fy)
        for i in (0, 1)
        for j in (0, 1)
    )
    cover = np.clip(1.4 * (cloud - 0.55), 0, 1) * np.clip((up[..., 0] - 0.03) / 0.2, 0, 1)
    sky += 0.8 * cover[..., None] * (np.array([1.02, 1.0, 0.98]) - sky)
    sun = direction(SUN_AZIMUTH, SUN_ELEVATION)
    angle = np.rad2deg(np.arccos(np.clip(d @ sun, -1, 1)))
    glow = SUN_RADIANCE * np.exp(-((angle / SUN_WIDTH) ** 2))
    sky += glow[..., None] * np.array([1.0, 0.95, 0.86])
    below = d[..., 2] < 0
    sky[below] = np.array([0.16, 0.17, 0.12])  # not visible: the ground extends beyond the hills
    return sky


def dusk(height: int = 128) -> Float[np.ndarray, "h w 3"]:
    """Return the linear radiance of a clear sky after sunset, laid out as `environment`.

    The horizon glows where the sun has set; the rest is an even blue without clouds.
    """
    d = _directions(height)
    up = np.clip(d[..., 2], 0, 1)
    zenith, horizon = np.array([0.16, 0.21, 0.33]), np.array([0.46, 0.47, 0.50])
    sky = zenith + (horizon - zenith) * np.exp(-up / 0.35)[..., None]
    azimuth = np.rad2deg(np.arctan2(d[..., 0], d[..., 1]))
    beside = (azimuth - SUN_AZIMUTH + 180.0) % 360.0 - 180.0
    elevation = np.rad2deg(np.arcsin(up))
    glow = np.exp(-((beside / DUSK_WIDTH) ** 2) - elevation / DUSK_HEIGHT)
    sky += glow[..., None] * np.array([0.95, 0.60, 0.34])
    sky[d[..., 2] < 0] = np.array([0.05, 0.05, 0.04])
    return sky


def overcast(height: int = 128) -> Float[np.ndarray, "h w 3"]:
    """Return the linear radiance of the CIE standard overcast sky, laid out as `environment`.

    L = L_z (1 + 2 sin h)/3 at elevation h, without colour (CIE S 011, type 1 of the older form).
    """
    up = _directions(height)[..., 2]
    sky = np.where(up < 0, 0.1, OVERCAST_ZENITH * (1 + 2 * up) / 3)
    return np.repeat(sky[..., None], 3, axis=-1)


def clear() -> dict:
    """Return Mitsuba's description of a clear sky with its sun, which is 0.53 degrees wide.

    It is the model of Hosek and Wilkie (2012, 2013), z up.
    """
    return {
        "type": "sunsky",
        "sun_direction": direction(SUN_AZIMUTH, SUN_ELEVATION).tolist(),
        "turbidity": TURBIDITY,
        "albedo": GROUND_ALBEDO,
        "sun_scale": CLEAR_GAIN,
        "sky_scale": CLEAR_GAIN,
    }
