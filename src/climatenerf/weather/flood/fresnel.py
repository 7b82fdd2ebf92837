"""Fresnel reflectance of water: exact, averaged over slopes, and averaged over a hemisphere.

All reflectances are for unpolarised light, in [0, 1]. `cos` is the cosine between the ray and the
normal on the ray's own side. A slope is dz/dx of the surface, its variance is per horizontal axis.
"""

import functools

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

# Nodes over the slope distribution: 12 hold the average to 1e-3 from nadir to the horizon.
_NODES = 12
_SPREAD = 4.0  # standard deviations that the nodes span


def reflectance(
    cos: Float[Tensor, "*n"], ior: float, below: bool | Bool[Tensor, "*n"] = False
) -> Float[Tensor, "*n"]:
    """Exact unpolarised Fresnel reflectance (R_s + R_p)/2 of a flat dielectric.

    Args:
        cos: cosine of the angle of incidence, clamped to [0, 1].
        ior: refractive index of the water (air is 1).
        below: whether the ray comes from the water; then R = 1 beyond the critical angle.

    Returns:
        R, with finite gradients at normal incidence, at grazing and at the critical angle.
    """
    cos = cos.clamp(0, 1)
    if isinstance(below, bool):
        below = torch.full_like(cos, below, dtype=torch.bool)
    into = torch.where(below, torch.full_like(cos, 1 / ior), torch.full_like(cos, ior))
    cos2_t = 1 - (1 - cos**2) / into**2  # Snell
    # The floor keeps the gradient of the square root finite at the critical angle.
    cos_t = torch.sqrt(cos2_t.clamp(min=1e-12))
    r_s = (cos - into * cos_t) / (cos + into * cos_t)
    r_p = (into * cos - cos_t) / (into * cos + cos_t)
    return torch.where(cos2_t > 0, (r_s**2 + r_p**2) / 2, torch.ones_like(cos))


def slope_averaged(
    cos: Float[Tensor, "*n"],
    variance: Float[Tensor, "*n"],
    ior: float,
    below: bool | Bool[Tensor, "*n"] = False,
    cross_variance: Float[Tensor, "*n"] | None = None,
) -> tuple[Float[Tensor, "*n"], Float[Tensor, "*n"], Float[Tensor, "*n"]]:
    """Averages over the facets of a rough surface that the eye can see.

    Slopes are Gaussian; a facet counts by its area as seen, and facets that face away do not count.
    At 85 deg and a slope deviation of 0.1 the reflectance is .40 where flat water has .58. Facets
    that lean towards the eye look larger, so rough water mirrors what stands higher.

    Args:
        cos: cosine between the ray and the *mean* normal, in [-1, 1] (slightly negative is fine:
            a mean facet turned away still has visible parts when the variance is not 0).
        variance: slope variance along the plane of incidence, >= 0.
        ior: refractive index of the water.
        below: whether the eye is in the water.
        cross_variance: slope variance across that plane; None: the same.

    Returns:
        Mean reflectance (`reflectance` itself where the variance is 0); mean slope towards the eye,
        >= 0; and the variance of the seen slopes about it, at most `variance`. Means and variance
        are along the plane of incidence; across it all facets are seen alike.
    """
    weight, mu, p = _visible_facets(cos, variance)
    q2 = variance if cross_variance is None else cross_variance
    local = mu / torch.sqrt(1 + p**2 + q2[..., None])
    if not isinstance(below, bool):
        below = below[..., None].expand_as(local)
    rough = variance > 0
    mean = (weight * reflectance(local, ior, below)).sum(-1).clamp(max=1)  # rounding
    mean = torch.where(rough, mean, reflectance(cos, ior, _first(below)))
    tilt = -(weight * p).sum(-1)
    spread = (weight * (p + tilt[..., None]) ** 2).sum(-1)
    tilt = torch.where(rough, tilt.clamp(min=0), 0 * tilt)
    return mean, tilt, torch.minimum(spread, variance)


def _first(below: bool | Bool[Tensor, "*n m"]) -> bool | Bool[Tensor, "*n"]:
    return below if isinstance(below, bool) else below[..., 0]


def _visible_facets(
    cos: Float[Tensor, "*n"], variance: Float[Tensor, "*n"]
) -> tuple[Float[Tensor, "*n m"], Float[Tensor, "*n m"], Float[Tensor, "*n m"]]:
    """Quadrature over slopes p away from the eye: weights (sum 1), mu = cos - p sin, p.

    The weight of a facet is its projected area mu > 0 times the Gaussian of p. Gauss-Legendre over
    the visible part only, so that the cut at mu = 0 costs no accuracy.
    """
    nodes, node_weights = _legendre(cos.dtype, cos.device)
    cos = cos.clamp(-1, 1)[..., None]
    # Floors: at the nadir no slope is hidden (x/0), and flat water has no spread (0/0).
    sin = torch.sqrt((1 - cos**2).clamp(min=1e-12))
    deviation = torch.sqrt(variance.clamp(min=1e-14))[..., None]
    edge = cos / (sin * deviation)  # slope, in deviations, at which a facet turns away
    top = edge.clamp(max=_SPREAD)
    # In the far tail the Gaussian falls off within 1/|x| of its edge.
    width = torch.maximum(top + _SPREAD, 2 * _SPREAD / top.abs().clamp(min=2))
    x = top - width * nodes
    peak = top.clamp(max=0)
    gaussian = torch.exp((-(x - peak) * (x + peak) / 2).clamp(max=0))
    # What is left at the top node's end, plus what the node adds: exactly >= 0 where cut.
    rest = torch.where(edge > _SPREAD, cos - _SPREAD * sin * deviation, 0 * cos)
    mu = rest + sin * deviation * width * nodes
    weight = node_weights * mu * gaussian
    # The floor is for flat water seen edge on, where every weight underflows.
    return weight / weight.sum(-1, keepdim=True).clamp(min=1e-37), mu, x * deviation


@functools.lru_cache(maxsize=8)
def _legendre(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    x, w = np.polynomial.legendre.leggauss(_NODES)
    return (
        torch.as_tensor((x + 1) / 2, dtype=dtype, device=device),
        torch.as_tensor(w / 2, dtype=dtype, device=device),
    )


@functools.lru_cache(maxsize=16)
def diffuse_reflectances(ior: float) -> tuple[float, float]:
    """Reflectance of a flat surface for diffuse light from above (r_e) and from within (r_i).

    r_e is the integral of R(cos) 2 cos over [0, 1]; (1 - r_e) = n^2 (1 - r_i) holds exactly
    (reciprocity), and r_i is computed from it so that white stays white. For water .0664, .4746.
    """
    x, w = np.polynomial.legendre.leggauss(64)
    cos = torch.as_tensor((x + 1) / 2)
    r_e = float((torch.as_tensor(w) * cos * reflectance(cos, ior)).sum())
    return r_e, 1 - (1 - r_e) / ior**2
