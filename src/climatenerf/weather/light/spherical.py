"""Irradiance of a normal from radiance, by spherical harmonics of degree 2.

Ramamoorthi and Hanrahan, "An efficient representation for irradiance environment maps" (2001): the
cosine keeps the degrees 0, 1 and 2 of radiance with the factors pi, 2 pi/3 and pi/4; what higher
degrees add is some 1 % for smooth skies. Nine coefficients for each channel.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.field.spherical_harmonics import spherical_harmonics

TERMS = 9
COSINE = torch.tensor(
    [math.pi] + 3 * [2 * math.pi / 3] + 5 * [math.pi / 4], dtype=torch.float32, device="cpu"
)
"""Factor of each coefficient: the clamped cosine's own expansion."""


def sphere_directions(count: int) -> Float[Tensor, "k 3"]:
    """Unit vectors, evenly spread over the sphere (Fibonacci's spiral), the highest first."""
    i = torch.arange(count, dtype=torch.float64, device="cpu") + 0.5
    z = 1 - 2 * i / count
    angle = i * (math.pi * (3 - math.sqrt(5)))
    flat = (1 - z * z).sqrt()
    return torch.stack([flat * angle.cos(), flat * angle.sin(), z], -1).float()


def project(
    directions: Float[Tensor, "k 3"], radiance: Float[Tensor, "*n k 3"]
) -> Float[Tensor, "*n 9 3"]:
    """Coefficients of the irradiance of normals, from radiance in evenly spread directions."""
    basis = spherical_harmonics(directions)[:, :TERMS] * COSINE.to(directions.device)
    solid_angle = 4 * math.pi / directions.shape[0]
    return torch.einsum("kt,...kc->...tc", solid_angle * basis, radiance)
