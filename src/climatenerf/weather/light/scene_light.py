"""The light of a place under one sky: irradiance of any surface, from probes and the sun's map."""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from climatenerf.core.colour import luma
from climatenerf.field.spherical_harmonics import harmonics
from climatenerf.ops import probes
from climatenerf.ops.probes import ProbeGrid
from climatenerf.weather.light.captured import CapturedLight
from climatenerf.weather.light.probes import GatheredLight
from climatenerf.weather.light.spherical import TERMS, sphere_directions
from climatenerf.weather.light.sun_map import SunMap

BOUNCES = 2  # repetitions in which surfaces are lit anew by the surfaces around them
MAX_MEDIAN_ALBEDO = 0.3  # of the surfaces of a place
SATURATION = 0.3  # of their colour that is kept in the light that they reflect onto others
MAX_TINT = 0.15  # of the logarithm of a channel over luma: red over blue from .74 to 1.35
OFF_SURFACE = 0.15  # m; where the light of a surface is looked up, clear of its own density
DARKEST = 1e-4  # irradiance over pi; nothing real is darker, and ratios stay finite
MAX_CHANGE = 16.0  # factor by which light may change at one place
SKY_DIRECTIONS = 4096
Y_00 = 0.28209479177387814  # the constant spherical harmonic

Radiance = Callable[[Float[Tensor, "n 3"]], Float[Tensor, "n 3"]]


@dataclass(frozen=True)
class SceneLight:
    """Light at all places of a scene.

    Attributes:
        grid: where the probes are.
        coefficients: of the irradiance by the sky and by surfaces, for each probe.
        radiance: of the sky without a hard sun, by direction, as pictures show it.
        sun_irradiance: of a hard sun across its rays; 0 without one.
        sun: its map; None without one.
        captured: the light of the photos, if it is theirs.
        balance: gains of the sky's channels where its light falls on surfaces.
    """

    grid: ProbeGrid
    coefficients: Float[Tensor, "p 9 3"]
    radiance: Radiance
    sun_irradiance: Float[Tensor, "3"]
    sun: SunMap | None
    captured: CapturedLight | None = None
    balance: float | Float[Tensor, "3"] = 1.0

    def irradiance(
        self,
        x: Float[Tensor, "n 3"],
        normal: Float[Tensor, "n 3"],
        diffuse: Float[Tensor, "n"] | None = None,
    ) -> Float[Tensor, "n 3"]:
        """Irradiance of surfaces at positions x (world m) with unit normals.

        `diffuse` is the fraction of the light of sky and surfaces that arrives; None: all.
        """
        (shaded,) = self.shaded((self,), x, normal)
        if diffuse is not None:
            shaded = shaded * diffuse[:, None]
        return shaded + self.direct(x, normal)

    @staticmethod
    def shaded(
        lights: "tuple[SceneLight, ...]", x: Float[Tensor, "n 3"], normal: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, "n 3"], ...]:
        """Irradiance without the sun's own light, under lights that share their grid."""
        basis = harmonics(normal).T[:TERMS].contiguous()
        tables = tuple(light.coefficients for light in lights)
        found = probes.irradiance(
            lights[0].grid, tables, x + OFF_SURFACE * normal, normal.contiguous(), basis
        )
        return tuple(each.clamp_min(DARKEST * math.pi) for each in found)

    def direct(self, x: Float[Tensor, "n 3"], normal: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Irradiance by the sun's disc alone."""
        if self.sun is None:
            return torch.zeros_like(x)
        return self.visibility(x, normal)[:, None] * self.full_sun(normal)

    def full_sun(self, normal: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Irradiance by the sun's disc where nothing hides it."""
        if self.sun is None:
            return torch.zeros_like(normal)
        facing = (normal @ normal.new_tensor(self.sun.direction)).clamp_min(0)
        return facing[:, None] * self.sun_irradiance

    def visibility(
        self, x: Float[Tensor, "n 3"], normal: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "n"]:
        """Fraction of the sun that surfaces see; their own density is left out."""
        if self.sun is None:
            return torch.zeros_like(x[:, 0])
        return self.sun.visibility(x + OFF_SURFACE * normal)

    def open_irradiance(self) -> Float[Tensor, "3"]:
        """Irradiance of level ground in the open, without what surrounds it."""
        d = sphere_directions(SKY_DIRECTIONS).to(self.coefficients.device)
        d = d[d[:, 2] > 0]
        sky = self.radiance(d) * d[:, 2:] * (4 * math.pi / SKY_DIRECTIONS)
        sun = 0.0 if self.sun is None else max(float(self.sun.direction[2]), 0.0)
        return self.balance * sky.sum(0) + sun * self.sun_irradiance

    def reflected_sky(
        self, d: Float[Tensor, "n 3"], sky: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "n 3"]:
        """Sky as surfaces reflect it: beyond white where photos clip it, or show none."""
        return sky if self.captured is None else self.captured.sky(d, sky)

    def sun_elevation(self) -> float | None:
        """Elevation of a sun that casts shadows, rad; None without one."""
        return None if self.sun is None else math.asin(float(self.sun.direction[2]))

    def mean_radiance(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Mean over all directions of the radiance that arrives at x (m), without a hard sun."""
        up = torch.zeros_like(x)
        up[:, 2] = 1.0
        # The first coefficient is the integral of L Y_00, times the cosine's factor pi.
        first = probes.interpolated(self.grid, self.coefficients, x, up)[:, 0]
        return (first / (math.pi * Y_00 * 4 * math.pi)).clamp_min(0)

    def beam(self) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]] | None:
        """Unit vector towards a hard sun and its irradiance across its rays; None without one."""
        if self.sun is None:
            return None
        return self.sun_irradiance.new_tensor(self.sun.direction), self.sun_irradiance


def light_of_photos(
    gathered: GatheredLight,
    radiance: Radiance,
    sun_irradiance: Float[Tensor, "3"],
    sun: SunMap | None,
    balance: float | Float[Tensor, "3"] = 1.0,
) -> SceneLight:
    """The light in which the photos were taken: surfaces send what photos show of them."""
    sky = balance * _sky_in(gathered, radiance)
    arriving = gathered.through[..., None] * sky + gathered.radiance
    coefficients = gathered.coefficients(arriving)
    return SceneLight(gathered.grid, coefficients, radiance, sun_irradiance, sun, balance=balance)


@dataclass(frozen=True)
class Surfaces:
    """How weather changes what surfaces send back.

    Attributes:
        cover: fraction of a surface that snow covers, from its normal's z and from whether it is
            of a class that lies on the ground.
        albedo: of that snow.
    """

    cover: Callable[[Float[Tensor, "*n"], Bool[Tensor, "*n"]], Float[Tensor, "*n"]]
    albedo: Float[Tensor, "3"]


def relit(
    gathered: GatheredLight,
    old: SceneLight,
    new: SceneLight,
    surfaces: Surfaces | None = None,
) -> SceneLight:
    """Complete a new light with the light that surfaces send back under it.

    Args:
        gathered: what the probes' rays meet.
        old: the light of the photos.
        new: the new sky and sun; its coefficients are computed here.
        surfaces: snow on the surfaces; None: they stay as they are.
    """
    sky = gathered.through[..., None] * (new.balance * _sky_in(gathered, new.radiance))
    x, normal = gathered.x.reshape(-1, 3), gathered.normal.reshape(-1, 3)
    hit = (normal != 0).any(-1).nonzero()[:, 0]
    x, normal = x[hit], normal[hit]
    photographed = gathered.radiance.reshape(-1, 3)
    before = old.irradiance(x, normal)
    brighter = new.open_irradiance() / old.open_irradiance()
    usual = float(luma(new.open_irradiance()) / luma(old.open_irradiance()))
    light = replace(new, coefficients=gathered.coefficients(sky + brighter * gathered.radiance))
    opacity = (1 - gathered.through).reshape(-1)[hit, None]
    cover = None
    if surfaces is not None:
        cover = surfaces.cover(normal[:, 2], gathered.ground.reshape(-1)[hit])[:, None]
    for _ in range(BOUNCES):
        now = light.irradiance(x, normal)
        sent = photographed[hit] * (now / before).clamp(usual / MAX_CHANGE, usual * MAX_CHANGE)
        if surfaces is not None and cover is not None:
            white = opacity * (surfaces.albedo / math.pi) * now
            sent = (1 - cover) * sent + cover * white
        bounced = photographed * brighter
        bounced[hit] = sent
        arriving = sky + bounced.view(gathered.radiance.shape)
        light = replace(new, coefficients=gathered.coefficients(arriving))
    return light


def camera_balance(irradiance: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    """Gains of the channels that bound the tint of the photos' light and keep its luma.

    A blue sky that shows between yellow leaves is not the colour of the light below them. Cameras
    leave a part of a light's tint; the logarithm of each channel over luma is bounded smoothly.

    Args:
        irradiance: of level ground in the open, as found.
    """
    irradiance = irradiance.clamp_min(DARKEST * math.pi)  # a channel without light: log 0
    tint = (irradiance / luma(irradiance)).log()
    gain = (MAX_TINT * torch.tanh(tint / MAX_TINT) - tint).exp()
    return gain * (luma(irradiance) / luma(gain * irradiance))


def plausible_surfaces(gathered: GatheredLight, irradiance: Float[Tensor, "3"]) -> GatheredLight:
    """Limit the albedo and the saturation of surfaces in the light that they reflect onto others.

    Where trees hide the sun, the light of the photos is estimated too low, and the albedo of sunlit
    surfaces too high. The colour of crowns that no photo shows is arbitrary. So the median albedo
    is limited to `MAX_MEDIAN_ALBEDO`, and a fraction `SATURATION` of the colour is kept.

    Args:
        gathered: what the probes' rays meet in the photos.
        irradiance: of level ground in the open, in the photos.
    """
    white = irradiance / math.pi
    opacity = (1 - gathered.through)[..., None]
    albedo = luma(gathered.radiance / white) / opacity[..., 0].clamp_min(0.5)
    met = opacity[..., 0] > 0.5
    middle = float(albedo[met].median()) if bool(met.any()) else 0.0
    level = min(1.0, MAX_MEDIAN_ALBEDO / middle) if middle > 0 else 1.0
    grey = luma(gathered.radiance / white)[..., None] * white
    return replace(
        gathered, radiance=level * (SATURATION * gathered.radiance + (1 - SATURATION) * grey)
    )


def white_balanced(light: SceneLight, eyes: Float[Tensor, "n 3"]) -> SceneLight:
    """Return a new light with the white balance of a camera among the surfaces of the place.

    A level white sheet at the cameras gets the chromaticity of one in the open. So the tint that
    surfaces add is removed, as a camera does, and that of the sky stays.

    Args:
        light: a new sky, complete with the light of surfaces.
        eyes: positions of the cameras, world m.
    """
    up = torch.zeros_like(eyes)
    up[:, 2] = 1.0
    (sheets,) = SceneLight.shaded((light,), eyes, up)
    sheet, sky = sheets.mean(0), light.open_irradiance() - light.full_sun(up[:1])[0]
    balance = (sky / luma(sky)) / (sheet / luma(sheet))
    return replace(
        light,
        radiance=functools.partial(scaled, balance, light.radiance),
        sun_irradiance=balance * light.sun_irradiance,
        coefficients=balance * light.coefficients,
    )


def between(one: SceneLight, other: SceneLight, part: float) -> SceneLight:
    """Light between two that share their grid and their sun; `part` 0 is the first, 1 the other."""
    sky = one.radiance
    if other.radiance is not sky:
        sky = functools.partial(_mixed, sky, other.radiance, part)
    return replace(
        one,
        coefficients=torch.lerp(one.coefficients, other.coefficients, part),
        radiance=sky,
        sun_irradiance=torch.lerp(one.sun_irradiance, other.sun_irradiance, part),
    )


def _mixed(
    one: Radiance, other: Radiance, part: float, d: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 3"]:
    return torch.lerp(one(d), other(d), part)


def scaled(
    factor: float | Float[Tensor, "3"], sky: Radiance, d: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 3"]:
    """Radiance of a sky times a factor; for `functools.partial`, which can be sent to workers."""
    return factor * sky(d)


def _sky_in(gathered: GatheredLight, radiance: Radiance) -> Float[Tensor, "k 3"]:
    """The sky in the probes' directions; nothing comes from below the horizon."""
    above = gathered.directions[:, 2:] > 0
    return torch.where(above, radiance(gathered.directions), 0.0)
