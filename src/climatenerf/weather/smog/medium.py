"""Smog: an absorbing medium with its own colour, exact along any segment (paper 3.2; Beer-Lambert).

Vocabulary: sigma is the extinction in 1/m, tau the optical depth (no unit), T = exp(-tau) the
transmittance. The medium is homogeneous, or falls off with height above `base_z`:
sigma(z) = sigma0 exp(-(z - base_z)/H), and sigma0 below it. Nothing is sampled, so empty space
costs nothing and there is no step size.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.weather.parameters import Smog, linear_colour

# Slopes below this count as level: 1/dz^2, in the gradient of a division by dz, still fits float32.
_HORIZONTAL = 1e-12


@dataclass(frozen=True)
class Medium:
    """What fills the air, in world units.

    Attributes:
        sigma: extinction at and below `base_z`, 1/m, >= 0.
        falloff: height over which sigma falls by e, m, > 0; None: homogeneous.
        base_z: world height at which the fall-off begins, m.
        colour: linear radiance of the infinitely thick medium.
    """

    sigma: float
    falloff: float | None
    base_z: float
    colour: tuple[float, float, float]


def sigma_from_visibility(visibility: float, contrast: float = 0.05) -> float:
    """Extinction at which contrast falls to `contrast` over `visibility` metres.

    5 % is the meteorological optical range (2.996/V), 2 % is Koschmieder's (3.912/V).
    """
    return -math.log(contrast) / visibility


def medium(smog: Smog, ground_z: float) -> Medium | None:
    """The medium a user asked for; None without smog.

    Args:
        smog: the user's parameters, heights relative to the ground datum.
        ground_z: world height of the ground datum, m.
    """
    if smog.sigma is not None:
        sigma = smog.sigma
    elif smog.visibility is not None:
        sigma = sigma_from_visibility(smog.visibility, smog.contrast)
    else:
        return None
    return Medium(sigma, smog.height_falloff, ground_z + smog.base, linear_colour(smog.colour))


def optical_depth(
    air: Medium,
    rays_o: Float[Tensor, "*n 3"],
    rays_d: Float[Tensor, "*n 3"],
    t: Float[Tensor, "*n"],
) -> Float[Tensor, "*n"]:
    """Optical depth from the origin of each ray to ray length `t`, in closed form.

    Args:
        air: the medium.
        rays_o: origins, world metres.
        rays_d: unit directions.
        t: ray length in m, >= 0, may be +inf (the sky).

    Returns:
        tau >= 0; +inf where an infinite ray never leaves the medium. Values and gradients are
        finite for finite `t`, horizontal rays included.
    """
    if air.sigma == 0:
        return torch.zeros_like(t)  # 0 times an infinite ray would be NaN
    if air.falloff is None:
        return air.sigma * t
    u0 = rays_o[..., 2] - air.base_z  # height above the base, m
    dz = rays_d[..., 2]
    endless = torch.isinf(t)
    finite = _equivalent_length(u0, dz, torch.where(endless, torch.ones_like(t), t), air.falloff)
    length = torch.where(endless, _endless_length(u0, dz, air.falloff), finite)
    return air.sigma * length


def _equivalent_length(
    u0: Float[Tensor, "*n"], dz: Float[Tensor, "*n"], t: Float[Tensor, "*n"], falloff: float
) -> Float[Tensor, "*n"]:
    """Integral of exp(-max(u, 0)/H) along u = u0 + s dz, s in [0, t], t finite."""
    u1 = u0 + dz * t
    # Dividing only where the ray crosses the base keeps 0/0 out of the backward pass.
    crosses = ((u0 > 0) != (u1 > 0)) & (dz.abs() > _HORIZONTAL)
    s = -u0 / torch.where(crosses, dz, torch.ones_like(dz))
    above = torch.where(crosses, torch.where(dz > 0, t - s, s), torch.where(u0 > 0, t, 0 * t))
    above = torch.minimum(torch.maximum(above, 0 * t), t)  # rounding
    # Counted from the lower end, so that no exponential overflows. minimum() halves the gradient
    # of a tie, which is exactly right for a horizontal ray.
    lower = torch.where(crosses, 0 * u0, torch.minimum(u0, u1)).clamp(min=0)
    return t - above + torch.exp(-lower / falloff) * _decaying_length(above, dz.abs() / falloff)


def _decaying_length(length: Float[Tensor, "*n"], rate: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Integral of exp(-rate s) over [0, length]; `rate` >= 0 may be 0."""
    x = rate * length
    small = x < 1e-2
    # (1 - exp(-x))/x = 1 - x/2 + x^2/6 - ...; the first term left out is below 1e-15 here.
    xs = torch.where(small, x, 0 * x)
    series = 1 - xs / 2 * (1 - xs / 3 * (1 - xs / 4 * (1 - xs / 5 * (1 - xs / 6))))
    safe = torch.where(small, torch.ones_like(rate), rate)  # no 0/0 in the branch not taken
    return torch.where(small, length * series, -torch.expm1(-x) / safe)


def _endless_length(
    u0: Float[Tensor, "*n"], dz: Float[Tensor, "*n"], falloff: float
) -> Float[Tensor, "*n"]:
    """The same integral to infinity: (depth below the base + H exp(-u0/H)) / sin(elevation)."""
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
    """T = exp(-tau) from the origin of each ray to ray length `t`, in [0, 1]."""
    return torch.exp(-optical_depth(air, rays_o, rays_d, t))


def apply(
    air: Medium, colour: Float[Tensor, "*n 3"], transmitted: Float[Tensor, "*n"]
) -> Float[Tensor, "*n 3"]:
    """T L + (1 - T) c: what is left of the radiance `colour`, and the medium's own.

    Args:
        air: the medium.
        colour: linear radiance at the far end.
        transmitted: transmittance between there and the eye.
    """
    own = torch.tensor(air.colour, dtype=colour.dtype, device=colour.device)
    weight = transmitted[..., None]
    return weight * colour + (1 - weight) * own
