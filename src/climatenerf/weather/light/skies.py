"""Skies that a place can be put under: radiance by direction, and the sun that belongs to them.

Luminance follows the CIE general sky (CIE S 011/E:2003, ISO 15469:2004); colours follow from
Rayleigh scattering and haze along the path of the light. Absolute brightness, where it is wanted,
is that of the IES daylight equations (IESNA RP-21). World axes, z up; angles in rad. Radiance is
linear RGB; its unit is chosen so that illuminance in klx is luma.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.core.srgb import LUMA

# Gradation a, b and indicatrix c, d, e of CIE S 011.
OVERCAST = (4.0, -0.70, 0.0, -1.0, 0.0)  # type 1
CLEAR = (-1.0, -0.32, 10.0, -3.0, 0.45)  # type 12
MIN_UP = 0.03  # sine of an elevation; the gradation divides by it

RAYLEIGH = (0.0635, 0.0973, 0.1925)  # optical depth of clean air upwards at 610, 550 and 465 nm
HAZE = (0.115, 0.131, 0.163)  # of dust and droplets on a clear day: .06 wavelength^-1.3, um
OZONE = (0.030, 0.025, 0.003)
SUNLIGHT = (1.05, 0.99, 0.93)  # of the sun above the air, in linear sRGB of luma 1
WHITE = (1.0, 1.0, 1.0)
STORM_TINT = (0.86, 1.0, 1.12)  # thick cloud absorbs red light first
STORM_SHARE = 0.2  # of an overcast sky's light
CLOUD_BASE = 0.6  # reflectance of thick cloud for light from below
USUAL_GROUND = 0.2  # reflectance of the ground, of which the CIE's skies have the light already
DUSK_ELEVATION = math.radians(-2.5)  # of the sun, unless another one is given
NIGHT = math.radians(-12.0)  # elevation of the sun below which `dusk` ends


@dataclass(frozen=True)
class NewSky:
    """A sky with its sun.

    Attributes:
        kind: "overcast", "clear", "storm" or "dusk".
        sun: unit vector towards the sun.
        cover: fraction of a clear sky that cloud hides, [0, 1].
        ground: mean reflectance of the country around, whose light clouds send back.
    """

    kind: str
    sun: tuple[float, float, float]
    cover: float = 0.0
    ground: float = USUAL_GROUND

    @property
    def sun_irradiance(self) -> tuple[float, float, float]:
        """Irradiance by the sun's disc across its rays, klx; 0 under cloud."""
        if self.kind != "clear" or self.sun[2] <= 0:
            return (0.0, 0.0, 0.0)
        passed = direct_sun(self.elevation)
        red, green, blue = ((1 - self.cover) * value for value in passed)
        return red, green, blue

    @property
    def elevation(self) -> float:
        """Of the sun, rad."""
        return math.asin(max(-1.0, min(1.0, self.sun[2])))

    def radiance(self, d: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Radiance in unit directions without the sun's disc; below the horizon as on it."""
        if self.kind == "clear":
            clear = clear_sky(d, self.sun)
            cloudy = overcast_sky(d, self.elevation, self.ground)
            return (1 - self.cover) * clear + self.cover * cloudy
        if self.kind == "dusk":
            return dusk_sky(d, self.sun)
        cloudy = overcast_sky(d, self.elevation, self.ground)
        if self.kind == "storm":
            return STORM_SHARE * cloudy * d.new_tensor(STORM_TINT)
        return cloudy


def gradation(up: Float[Tensor, "n"], a: float, b: float) -> Float[Tensor, "n"]:
    """phi(Z) = 1 + a exp(b/cos Z); `up` is cos Z."""
    return 1 + a * torch.exp(b / up.clamp_min(MIN_UP))


def indicatrix(angle: Float[Tensor, "n"], c: float, d: float, e: float) -> Float[Tensor, "n"]:
    """f(chi) = 1 + c (exp(d chi) - exp(d pi/2)) + e cos^2 chi."""
    return 1 + c * (torch.exp(d * angle) - math.exp(d * math.pi / 2)) + e * torch.cos(angle) ** 2


def cie_luminance(
    d: Float[Tensor, "n 3"],
    sun: tuple[float, float, float],
    coefficients: tuple[float, float, float, float, float],
) -> Float[Tensor, "n"]:
    """Luminance of a CIE general sky over that of its zenith, in unit directions."""
    a, b, c, e, f = coefficients
    angle = torch.acos((d @ d.new_tensor(sun)).clamp(-1, 1))
    here = gradation(d[:, 2], a, b) * indicatrix(angle, c, e, f)
    up = d.new_tensor([[0.0, 0.0, 1.0]])
    from_sun = torch.acos((up @ d.new_tensor(sun)).clamp(-1, 1))
    return here / (gradation(up[:, 2], a, b) * indicatrix(from_sun, c, e, f))


def overcast_sky(
    d: Float[Tensor, "n 3"], elevation: float, ground: float = USUAL_GROUND
) -> Float[Tensor, "n 3"]:
    """The CIE standard overcast sky, L_z (1 + 2 sin h)/3, without colour, over usual ground.

    E = 7 pi/9 L_z is the overcast sky's illuminance, .3 + 21 sin(elevation) klx (IESNA RP-21).
    Clouds send back evenly, and many times, what the ground reflects beyond `USUAL_GROUND`: the
    illuminance becomes E/(1 - k), and the radiance k E/((1 - k) pi) is added in all directions,
    with k = `CLOUD_BASE` (ground - `USUAL_GROUND`) (Gardiner 1987).
    """
    illuminance = 0.3 + 21 * max(math.sin(elevation), 0.0)
    zenith = illuminance / (7 * math.pi / 9)
    returned = CLOUD_BASE * (ground - USUAL_GROUND)
    even = returned / (1 - returned) * illuminance / math.pi
    shape = (1 + 2 * d[:, 2].clamp(0, 1)) / 3
    return (zenith * shape + even)[:, None] * d.new_tensor(WHITE)


def clear_sky(d: Float[Tensor, "n 3"], sun: tuple[float, float, float]) -> Float[Tensor, "n 3"]:
    """CIE type 12, scaled to the illuminance .8 + 15.5 sqrt(sin(elevation)) klx, coloured.

    The sky is the bluer the less of its light was scattered by haze: white near the sun and at the
    horizon, where a path through the air is long.
    """
    sine = max(sun[2], 0.0)
    wanted = 0.8 + 15.5 * math.sqrt(sine)
    luminance = cie_luminance(d, sun, CLEAR) * (wanted / _horizontal(sun, CLEAR))
    angle = torch.acos((d @ d.new_tensor(sun)).clamp(-1, 1))
    up = d[:, 2].clamp_min(MIN_UP)
    # Share of the haze's light: forward of the sun (Henyey-Greenstein, g .7), and over long paths.
    forward = 0.51 / (1.49 - 1.4 * torch.cos(angle)) ** 1.5
    haze = 0.16 * forward + 0.35 * torch.exp(-up / 0.18) + 0.06
    haze = haze / (haze + 0.5)
    blue = _tint(RAYLEIGH, d)
    colour = haze[:, None] * d.new_tensor(WHITE) + (1 - haze[:, None]) * blue
    colour = colour / (colour @ d.new_tensor(LUMA))[:, None]
    return luminance[:, None] * colour


def dusk_sky(d: Float[Tensor, "n 3"], sun: tuple[float, float, float]) -> Float[Tensor, "n 3"]:
    """A clear sky while the sun is just below the horizon: blue, with a warm glow above the sun.

    An own form: the zenith's luminance falls by a factor e each 1.1 degrees of depression
    (Rozenberg 1966 has a factor 10 for 2.5 degrees), and the glow spans 60 degrees of azimuth and
    10 of elevation to 1/e.
    """
    depression = max(-math.degrees(math.asin(max(-1.0, min(1.0, sun[2])))), 0.0)
    zenith = 0.12 * math.exp(-depression / 1.1)  # klx over pi
    up = d[:, 2].clamp(0, 1)
    flat = torch.nn.functional.normalize(d[:, :2], dim=-1)
    towards = torch.nn.functional.normalize(d.new_tensor(sun[:2]), dim=0, eps=1e-9)
    beside = torch.acos((flat @ towards).clamp(-1, 1))
    glow = torch.exp(-((beside / math.radians(60)) ** 2) - torch.asin(up) / math.radians(10))
    blue = (1 + 1.2 * torch.exp(-up / 0.3))[:, None] * _tint(RAYLEIGH, d)
    warm = d.new_tensor((1.9, 0.85, 0.32))
    return zenith * (blue + 4.0 * glow[:, None] * warm)


def direct_sun(elevation: float) -> tuple[float, float, float]:
    """Irradiance of the sun across its rays on a clear day, in klx by luma.

    127.5 exp(-.21 m) klx (IESNA RP-21), coloured by Beer-Lambert's law through air, haze and
    ozone at the relative air mass m of Kasten and Young (1989).
    """
    if elevation <= 0:
        return (0.0, 0.0, 0.0)
    mass = air_mass(elevation)
    illuminance = 127.5 * math.exp(-0.21 * mass)
    depths = (r + h + o for r, h, o in zip(RAYLEIGH, HAZE, OZONE, strict=True))
    passed = [s * math.exp(-mass * tau) for s, tau in zip(SUNLIGHT, depths, strict=True)]
    total = sum(w * value for w, value in zip(LUMA, passed, strict=True))
    red, green, blue = (illuminance * value / total for value in passed)
    return red, green, blue


def daylight(elevation: float, sunny: bool) -> float:
    """Illuminance of level ground in klx, under a clear or an overcast sky (IESNA RP-21)."""
    sine = max(math.sin(elevation), 0.0)
    if not sunny:
        return 0.3 + 21 * sine
    direct = sum(w * e for w, e in zip(LUMA, direct_sun(elevation), strict=True))
    return 0.8 + 15.5 * math.sqrt(sine) + direct * sine


def air_mass(elevation: float) -> float:
    """Length of the light's path through the air over that from the zenith; `elevation` rad."""
    degrees = math.degrees(elevation)
    return 1 / (math.sin(elevation) + 0.50572 * (degrees + 6.07995) ** -1.6364)


def _horizontal(
    sun: tuple[float, float, float], coefficients: tuple[float, float, float, float, float]
) -> float:
    """Irradiance of a CIE sky of zenith luminance 1 on level ground."""
    count = 4096
    i = torch.arange(count, dtype=torch.float64, device="cpu") + 0.5
    radius, angle = (i / count).sqrt(), i * math.pi * (3 - math.sqrt(5))
    d = torch.stack([radius * angle.cos(), radius * angle.sin(), (1 - i / count).sqrt()], -1)
    return math.pi * float(cie_luminance(d, sun, coefficients).mean())


def _tint(depths: tuple[float, float, float], d: Tensor) -> Float[Tensor, "3"]:
    """Colour of sunlight scattered once in thin air, of luma 1."""
    scattered = d.new_tensor([s * t for s, t in zip(SUNLIGHT, depths, strict=True)])
    return scattered / (scattered @ d.new_tensor(LUMA))
