"""Fresnel reflectance of water: exact, averaged over wave slopes, and over a hemisphere.

All reflectances are for unpolarised light, in [0, 1]. `cos` is the cosine between the ray and the
normal on the ray's side of the surface. A slope is dz/dx of the surface; its variance is given per
horizontal axis. Both are dimensionless.
"""

import functools

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

# Quadrature nodes over the slope distribution: 12 keep the error of the average below 1e-3 from
# the nadir to the horizon.
_NODES = 12
_SPREAD = 4.0  # half-width of the quadrature in standard deviations


def reflectance(
    cos: Float[Tensor, "*n"], ior: float, below: bool | Bool[Tensor, "*n"] = False
) -> Float[Tensor, "*n"]:
    """Return the exact unpolarised Fresnel reflectance (R_s + R_p)/2 of a flat dielectric.

    Args:
        cos: cosine of the angle of incidence, clamped to [0, 1].
        ior: refractive index of the water (air is 1).
        below: True for rays that arrive from inside the water; R = 1 beyond the critical angle.

    Returns:
        R, with finite gradients at normal incidence, at grazing and at the critical angle.
    """
    cos = cos.clamp(0, 1)
    if isinstance(below, bool):
        below = torch.full_like(cos, below, dtype=torch.bool)
    relative_ior = torch.where(below, torch.full_like(cos, 1 / ior), torch.full_like(cos, ior))
    cos2_t = 1 - (1 - cos**2) / relative_ior**2  # Snell
    # The floor keeps the gradient of the square root finite at the critical angle.
    cos_t = torch.sqrt(cos2_t.clamp(min=1e-12))
    r_s = (cos - relative_ior * cos_t) / (cos + relative_ior * cos_t)
    r_p = (relative_ior * cos - cos_t) / (relative_ior * cos + cos_t)
    return torch.where(cos2_t > 0, (r_s**2 + r_p**2) / 2, torch.ones_like(cos))


def slope_averaged(
    cos: Float[Tensor, "*n"],
    variance: Float[Tensor, "*n"],
    ior: float,
    below: bool | Bool[Tensor, "*n"] = False,
    cross_variance: Float[Tensor, "*n"] | None = None,
) -> tuple[Float[Tensor, "*n"], Float[Tensor, "*n"], Float[Tensor, "*n"]]:
    """Average reflectance and slope over the facets of a rough surface that face the viewer.

    Slopes are Gaussian. Each facet is weighted by its projected area; facets that face away have
    weight 0. At 85 deg and a slope deviation of 0.1 the reflectance is .40, against .58 for flat
    water. Facets tilted towards the viewer have a larger projected area, so rough water reflects
    directions of higher elevation.

    Args:
        cos: cosine between the ray and the *mean* normal, in [-1, 1]. Slightly negative values are
            valid: parts of a rough surface stay visible when its mean plane faces away.
        variance: slope variance along the plane of incidence, >= 0.
        ior: refractive index of the water.
        below: True where the viewer is under water.
        cross_variance: slope variance across that plane; None: the same as `variance`.

    Returns:
        Mean reflectance (`reflectance` itself where the variance is 0); mean slope towards the
        viewer, >= 0; and variance of the visible slopes about that mean, at most `variance`. Slope
        mean and variance are along the plane of incidence; across it visibility does not depend on
        the slope.
    """
    weight, mu, p = _visible_facets(cos, variance)
    q2 = variance if cross_variance is None else cross_variance
    local_cos = mu / torch.sqrt(1 + p**2 + q2[..., None])
    if not isinstance(below, bool):
        below = below[..., None].expand_as(local_cos)
    rough = variance > 0
    mean = (weight * reflectance(local_cos, ior, below)).sum(-1).clamp(max=1)  # rounding
    mean = torch.where(rough, mean, reflectance(cos, ior, _first(below)))
    tilt = -(weight * p).sum(-1)
    visible_variance = (weight * (p + tilt[..., None]) ** 2).sum(-1)
    tilt = torch.where(rough, tilt.clamp(min=0), 0 * tilt)
    return mean, tilt, torch.minimum(visible_variance, variance)


def _first(below: bool | Bool[Tensor, "*n m"]) -> bool | Bool[Tensor, "*n"]:
    return below if isinstance(below, bool) else below[..., 0]


def _visible_facets(
    cos: Float[Tensor, "*n"], variance: Float[Tensor, "*n"]
) -> tuple[Float[Tensor, "*n m"], Float[Tensor, "*n m"], Float[Tensor, "*n m"]]:
    """Return a quadrature over slopes p away from the viewer: weights (sum 1), mu, and p.

    The weight of a facet is its projected area mu = cos - p sin > 0 times the Gaussian of p. The
    Gauss-Legendre nodes cover only the visible part, so the cut at mu = 0 costs no accuracy.
    """
    nodes, node_weights = _legendre(cos.dtype, cos.device)
    cos = cos.clamp(-1, 1)[..., None]
    # Floors: at the nadir no slope is hidden (x/0), and flat water has no spread (0/0).
    sin = torch.sqrt((1 - cos**2).clamp(min=1e-12))
    deviation = torch.sqrt(variance.clamp(min=1e-14))[..., None]
    edge = cos / (sin * deviation)  # slope at which a facet turns away, in standard deviations
    top = edge.clamp(max=_SPREAD)
    # In the far tail the Gaussian falls off within 1/|x| of its edge.
    width = torch.maximum(top + _SPREAD, 2 * _SPREAD / top.abs().clamp(min=2))
    x = top - width * nodes
    peak = top.clamp(max=0)
    gaussian = torch.exp((-(x - peak) * (x + peak) / 2).clamp(max=0))
    # mu is the sum of its value at the upper end and of a term >= 0, so rounding cannot make it
    # negative where the visible part is cut.
    mu_at_top = torch.where(edge > _SPREAD, cos - _SPREAD * sin * deviation, 0 * cos)
    mu = mu_at_top + sin * deviation * width * nodes
    weight = node_weights * mu * gaussian
    # The floor is for flat water seen edge-on, where every weight underflows.
    return weight / weight.sum(-1, keepdim=True).clamp(min=1e-37), mu, x * deviation


@functools.lru_cache(maxsize=8)
def _legendre(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the Gauss-Legendre nodes and weights on [0, 1]."""
    x, w = np.polynomial.legendre.leggauss(_NODES)
    return (
        torch.as_tensor((x + 1) / 2, dtype=dtype, device=device),
        torch.as_tensor(w / 2, dtype=dtype, device=device),
    )


@functools.lru_cache(maxsize=16)
def diffuse_reflectances(ior: float) -> tuple[float, float]:
    """Return the reflectance of a flat surface for diffuse light from above (r_e) and below (r_i).

    r_e is the integral of R(cos) 2 cos over [0, 1]. Reciprocity gives (1 - r_e) = n^2 (1 - r_i)
    exactly; r_i is computed from it, so that a white furnace stays white. For water .0664, .4746.
    """
    x, w = np.polynomial.legendre.leggauss(64)
    cos = torch.as_tensor((x + 1) / 2, device="cpu")
    r_e = float((torch.as_tensor(w, device="cpu") * cos * reflectance(cos, ior)).sum())
    return r_e, 1 - (1 - r_e) / ior**2
