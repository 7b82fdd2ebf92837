"""Smog that scatters the light of the place, by similarity to a medium that scatters evenly.

Particles scatter most light forwards, where it stays with the light that passes. Counting that part
as unscattered (similarity scaling, van de Hulst 1980) leaves extinction sigma (1 - omega g) and
single-scattering albedo omega (1 - g)/(1 - omega g) of a medium that scatters evenly, whose source
is that albedo times the mean radiance around. The sun's own light keeps its phase function
(Henyey and Greenstein 1941) and adds one scattering. All for each colour channel.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.core.srgb import linear_colour
from climatenerf.weather.smog.medium import Medium, optical_depth
from climatenerf.weather.smog.parameters import Smog
from climatenerf.weather.world import Light

WAVELENGTHS = (610.0, 550.0, 465.0)  # nm, of the channels
HORIZON = 6e4  # m; a level ray leaves a layer of 300 m there, since the earth is round
MIN_ELEVATION = 0.05  # sine; the sun's path through the layer is no longer than this allows


@dataclass(frozen=True)
class Particles:
    """Optical properties of a kind of particles.

    Attributes:
        albedo: fraction of extinction that is scattering, for each channel.
        asymmetry: mean cosine of scattering.
        exponent: a of extinction proportional to wavelength^-a.
    """

    albedo: tuple[float, float, float]
    asymmetry: float
    exponent: float


KINDS = {
    "smog": Particles((0.94, 0.92, 0.86), 0.7, 1.0),
    "fog": Particles((1.0, 1.0, 1.0), 0.85, 0.0),
    "haze": Particles((0.97, 0.97, 0.96), 0.7, 1.3),
    "dust": Particles((0.97, 0.92, 0.80), 0.75, 0.3),
    "smoke": Particles((0.96, 0.95, 0.88), 0.6, 2.0),
}


@dataclass(frozen=True)
class ScatteringMedium:
    """Smog lit by the place.

    Attributes:
        air: its extinction by place.
        top_z: world height above which there is none, m.
        exponent: optical depth of each channel that counts, over that of the air.
        ambient: radiance of the infinitely thick medium without the sun's own light.
        sun: unit vector towards the sun, and its scattered radiance times 4 pi over the phase
            function; None without one.
        asymmetry: of the phase function.
    """

    air: Medium
    top_z: float
    exponent: Float[Tensor, "3"]
    ambient: Float[Tensor, "3"]
    sun: tuple[Float[Tensor, "3"], Float[Tensor, "3"]] | None
    asymmetry: float
    mask = "mask_smog"

    def optical_depth(
        self,
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        t: Float[Tensor, "n"],
    ) -> Float[Tensor, "n"]:
        """Optical depth from each origin (m) to ray length t (m; may be +inf), below the top."""
        enter, leave = self._span(rays_o, rays_d)
        t = t.clamp_max(HORIZON)
        enter, leave = torch.minimum(enter, t), torch.minimum(leave, t)
        depth = optical_depth(self.air, rays_o, rays_d, leave)
        before = optical_depth(self.air, rays_o, rays_d, enter)
        # inf - inf: a ray that never enters.
        return torch.where(leave > enter, depth - before, torch.zeros_like(depth))

    def _span(
        self, rays_o: Float[Tensor, "n 3"], rays_d: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
        """Ray lengths (m) between which rays run below the top."""
        height, slope = self.top_z - rays_o[:, 2], rays_d[:, 2]
        level = slope.abs() < 1e-9  # a level ray crosses nowhere: division by 0
        crossing = height / torch.where(level, torch.ones_like(slope), slope)
        below = height >= 0
        zero, endless = torch.zeros_like(slope), torch.full_like(slope, torch.inf)
        enter = torch.where(below, zero, torch.where(level | (slope > 0), endless, crossing))
        leave = torch.where(below & ~level & (slope > 0), crossing, endless)
        return enter, leave

    def source(
        self, rays_o: Float[Tensor, "n 3"], rays_d: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "n 3"]:
        """Radiance of the infinitely thick medium along each ray."""
        source = self.ambient.expand(rays_d.shape[0], 3)
        if self.sun is None:
            return source
        towards, strength = self.sun
        # Light that travels away from the sun and turns by the angle between ray and sun.
        return source + phase(rays_d @ towards, self.asymmetry)[:, None] * strength

    def breaks(
        self, rays_o: Float[Tensor, "n 3"], rays_d: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "n 3"]:
        """Ray lengths (m) at which the extinction jumps or bends; +inf where it does not."""
        enter, leave = self._span(rays_o, rays_d)
        enter = torch.where(enter > 0, enter, torch.inf)
        return torch.cat([self.air.breaks(rays_o, rays_d), torch.stack([enter, leave], -1)], dim=-1)


def phase(cosine: Float[Tensor, "n"], asymmetry: float) -> Float[Tensor, "n"]:
    """Henyey and Greenstein's phase function, 1/sr; its integral over the sphere is 1.

    `cosine` is that of the angle by which light turns.
    """
    g = asymmetry
    return (1 - g * g) / (4 * math.pi * (1 + g * g - 2 * g * cosine).clamp_min(1e-9) ** 1.5)


def particles_of(smog: Smog) -> Particles:
    """The particles of a request."""
    kind = KINDS[smog.kind]
    return Particles(
        kind.albedo if smog.albedo is None else smog.albedo,
        kind.asymmetry if smog.asymmetry is None else smog.asymmetry,
        kind.exponent if smog.albedo is None else 0.0,
    )


def scaled_extinction(particles: Particles) -> tuple[float, float, float]:
    """Extinction of each channel by similarity, over that at 550 nm."""
    red, green, blue = (
        (wavelength / 550.0) ** -particles.exponent * (1 - albedo * particles.asymmetry)
        for wavelength, albedo in zip(WAVELENGTHS, particles.albedo, strict=True)
    )
    return red, green, blue


def scattering_medium(
    smog: Smog, air: Medium, top_z: float, light: Light, eye: Float[Tensor, "1 3"]
) -> ScatteringMedium:
    """Light smog by the place.

    Args:
        smog: parameters.
        air: its extinction.
        top_z: world height of its top, m.
        light: the light of the moment.
        eye: middle of the cameras, world m.
    """
    particles, device = particles_of(smog), eye.device
    g = particles.asymmetry
    albedo = torch.tensor(particles.albedo, device=device)
    even = albedo * (1 - g) / (1 - albedo * g)
    if smog.colour is not None:
        even = torch.tensor(linear_colour(smog.colour), device=device)
    ambient = even * light.mean_radiance(eye)[0]
    beam, sun = light.beam(), None
    if beam is not None:
        # Extinction that is scattering, over extinction by similarity: what a thick medium sends.
        sun = beam[0], beam[1] * albedo / (1 - albedo * g)
    exponent = torch.tensor(scaled_extinction(particles), device=device)
    return ScatteringMedium(air, top_z, exponent, ambient, sun, g)


def sun_transmittance(smog: Smog, sigma: float, elevation: float) -> tuple[float, float, float]:
    """Fraction of the sun's light that arrives on the ground below the smog, by similarity.

    Args:
        smog: parameters.
        sigma: extinction at the base and below it, 1/m.
        elevation: of the sun, rad.
    """
    if smog.height_falloff is None:
        height = smog.top
    else:  # even up to the base, falling off above it
        base, scale = smog.base, smog.height_falloff
        height = min(max(base, 0.0), smog.top)
        above = math.exp(min(base, 0.0) / scale) - math.exp((base - smog.top) / scale)
        height += scale * above if smog.top > base else 0.0
    path = height / max(math.sin(elevation), MIN_ELEVATION)
    red, green, blue = (math.exp(-sigma * path * k) for k in scaled_extinction(particles_of(smog)))
    return red, green, blue
