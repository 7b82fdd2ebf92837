"""Optical depth and transmittance of smog: a homogeneous or exponentially stratified medium.

ClimateNeRF section 3.2; Beer-Lambert law. Notation: sigma is the extinction in 1/m, tau the
dimensionless optical depth and T = exp(-tau) the transmittance. The extinction is constant, or
decreases with height above `base_z`: sigma(z) = sigma0 exp(-(z - base_z)/H) above it, sigma0 below
it. All integrals are closed forms: there is no step size, and empty space costs nothing.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.core.srgb import linear_colour
from climatenerf.weather.smog.parameters import Smog

# Rays with a smaller |dz| count as horizontal. The gradient of a division by dz contains 1/dz^2,
# which still fits float32 at this bound.
_HORIZONTAL = 1e-12
PAPER_COLOUR = (0.925, 0.906, 0.758)  # of thick smog in the paper's figures, display sRGB


@dataclass(frozen=True)
class Medium:
    """A participating medium that fills the air, in world units.

    Attributes:
        sigma: extinction at and below `base_z`, 1/m, >= 0.
        falloff: scale height H over which sigma falls by a factor e, m, > 0; None: homogeneous.
        base_z: world height above which the extinction decreases, m.
        colour: linear radiance of an infinitely thick medium.
    """

    sigma: float
    falloff: float | None
    base_z: float
    colour: tuple[float, float, float]
    mask = "mask_smog"

    def optical_depth(
        self,
        rays_o: Float[Tensor, "*n 3"],
        rays_d: Float[Tensor, "*n 3"],
        t: Float[Tensor, "*n"],
    ) -> Float[Tensor, "*n"]:
        """See the function `optical_depth`."""
        return optical_depth(self, rays_o, rays_d, t)

    def source(
        self, rays_o: Float[Tensor, "*n 3"], rays_d: Float[Tensor, "*n 3"]
    ) -> Float[Tensor, "3"]:
        """Radiance of the infinitely thick medium, the same for all rays."""
        return torch.tensor(self.colour, dtype=rays_o.dtype, device=rays_o.device)

    def breaks(
        self, rays_o: Float[Tensor, "n 3"], rays_d: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "n 1"]:
        """Ray length (m) at which rays cross `base_z`; +inf where they do not."""
        dz = rays_d[:, 2]
        level = dz.abs() < _HORIZONTAL
        t = (self.base_z - rays_o[:, 2]) / torch.where(level, torch.ones_like(dz), dz)
        crossed = ~level & (t > 0) & (self.falloff is not None)
        return torch.where(crossed, t, torch.full_like(t, torch.inf))[:, None]


def sigma_of(smog: Smog) -> float | None:
    """Extinction on the ground, 1/m; None without smog."""
    if smog.sigma is not None:
        return smog.sigma
    if smog.visibility is not None:
        return sigma_from_visibility(smog.visibility, smog.contrast)
    return None


def sigma_from_visibility(visibility: float, contrast: float = 0.05) -> float:
    """Return the extinction in 1/m at which contrast falls to `contrast` over `visibility` metres.

    A contrast of 0.05 defines the meteorological optical range (2.996/V), 0.02 Koschmieder's
    visibility (3.912/V).
    """
    return -math.log(contrast) / visibility


def medium(smog: Smog, ground_z: float) -> Medium | None:
    """Build the medium from the user's parameters; None without smog.

    Args:
        smog: parameters, with heights relative to the ground datum.
        ground_z: world height of the ground datum, m.
    """
    sigma = sigma_of(smog)
    if sigma is None:
        return None
    colour = PAPER_COLOUR if smog.colour is None else smog.colour
    return Medium(sigma, smog.height_falloff, ground_z + smog.base, linear_colour(colour))


def optical_depth(
    air: Medium,
    rays_o: Float[Tensor, "*n 3"],
    rays_d: Float[Tensor, "*n 3"],
    t: Float[Tensor, "*n"],
) -> Float[Tensor, "*n"]:
    """Return the optical depth from the origin of each ray to ray length `t`, in closed form.

    Args:
        air: the medium.
        rays_o: ray origins, world frame, m.
        rays_d: unit ray directions, world frame.
        t: ray length, m, >= 0; may be +inf (the sky).

    Returns:
        tau >= 0; +inf where an infinite ray never leaves the medium. Values and gradients are
        finite for finite `t`, including horizontal rays.
    """
    if air.sigma == 0:
        return torch.zeros_like(t)  # 0 times an infinite ray length would be NaN
    if air.falloff is None:
        return air.sigma * t
    u0 = rays_o[..., 2] - air.base_z  # height above the base, m
    dz = rays_d[..., 2]
    infinite = torch.isinf(t)
    bounded_t = torch.where(infinite, torch.ones_like(t), t)
    finite = _equivalent_length(u0, dz, bounded_t, air.falloff)
    length = torch.where(infinite, _infinite_equivalent_length(u0, dz, air.falloff), finite)
    return air.sigma * length


def _equivalent_length(
    u0: Float[Tensor, "*n"], dz: Float[Tensor, "*n"], t: Float[Tensor, "*n"], falloff: float
) -> Float[Tensor, "*n"]:
    """Integrate exp(-max(u, 0)/H) along u = u0 + s dz, s in [0, t], for finite t.

    The result is the ray length in m that gives the same optical depth at constant sigma0.
    """
    u1 = u0 + dz * t
    # The division happens only where the ray crosses the base: 0/0 would spoil the gradients.
    crosses = ((u0 > 0) != (u1 > 0)) & (dz.abs() > _HORIZONTAL)
    s = -u0 / torch.where(crosses, dz, torch.ones_like(dz))
    above = torch.where(crosses, torch.where(dz > 0, t - s, s), torch.where(u0 > 0, t, 0 * t))
    above = torch.minimum(torch.maximum(above, 0 * t), t)  # rounding
    # The integral starts at the lower end, so that no exponential overflows. At a tie minimum()
    # halves the gradient, which is exactly right for a horizontal ray.
    lower = torch.where(crosses, 0 * u0, torch.minimum(u0, u1)).clamp(min=0)
    return t - above + torch.exp(-lower / falloff) * _decaying_length(above, dz.abs() / falloff)


def _decaying_length(length: Float[Tensor, "*n"], rate: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Integrate exp(-rate s) over [0, length]; `rate` >= 0, in 1/m, may be 0."""
    x = rate * length
    small = x < 1e-2
    # (1 - exp(-x))/x = 1 - x/2 + x^2/6 - ...; the first omitted term is below 1e-15 here.
    xs = torch.where(small, x, 0 * x)
    series = 1 - xs / 2 * (1 - xs / 3 * (1 - xs / 4 * (1 - xs / 5 * (1 - xs / 6))))
    safe = torch.where(small, torch.ones_like(rate), rate)  # no 0/0 in the branch not taken
    return torch.where(small, length * series, -torch.expm1(-x) / safe)


def _infinite_equivalent_length(
    u0: Float[Tensor, "*n"], dz: Float[Tensor, "*n"], falloff: float
) -> Float[Tensor, "*n"]:
    """Return the same integral to infinity: (depth below the base + H exp(-u0/H)) / sin(elevation).

    The result is +inf for rays that do not rise.
    """
    rises = dz > _HORIZONTAL
    slope = torch.where(rises, dz, torch.ones_like(dz))
    length = ((-u0).clamp(min=0) + falloff * torch.exp(-u0.clamp(min=0) / falloff)) / slope
    return torch.where(rises, length, torch.full_like(length, torch.inf))


def transmittance(
    air: Medium,
    rays_o: Float[Tensor, "*n 3"],
    rays_d: Float[Tensor, "*n 3"],
    t: Float[Tensor, "*n"],
) -> Float[Tensor, "*n"]:
    """Return T = exp(-tau) in [0, 1] from the origin of each ray to ray length `t`.

    Args and units: see `optical_depth`.
    """
    return torch.exp(-optical_depth(air, rays_o, rays_d, t))
