"""Sparkle of snow: crystal faces that mirror the sun's disc to the eye.

A pixel shows a finite number of faces, few of which are tilted just so. As in the discrete
microfacet model of Jakob et al. (2014, "Discrete stochastic microfacet models"), a random number
belongs to each small piece of the surface and to each small range of the half vector. It decides
whether a face of that tilt lies there. So a sparkle stays where it is as long as the eye and the
sun do, and its mean over many pixels is that of a mirror in pieces.
"""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

FACE = 1e-6  # m2, area of a face
MIRRORED = 0.02  # of the light, by ice at steep incidence (Fresnel, n = 1.31)
SUN_RADIUS = 0.00465  # rad
SUN_SOLID_ANGLE = math.pi * SUN_RADIUS**2
TILTS = SUN_SOLID_ANGLE / 4  # sr of normals that mirror some of the sun's disc to the eye
WIDEST = 0.25  # m; beyond, sparkles are fainter than 2 % of the snow


def glints(
    x: Float[Tensor, "n 3"],
    d: Float[Tensor, "n 3"],
    width: Float[Tensor, "n"],
    sun: Float[Tensor, "3"],
    faces: float,
) -> Float[Tensor, "n"]:
    """Radiance of crystal faces over the irradiance of the sun across its rays, 1/sr.

    Args:
        x: positions on the surface, m.
        d: unit directions from the eye to these.
        width: of a pixel there, m.
        sun: unit vector towards the sun.
        faces: area of all faces over that of the snow, 0 to 1; their tilts are random.
    """
    narrowest = math.sqrt(FACE)  # a pixel that shows less of the surface shows a part of one face
    level = torch.log2(width.clamp(narrowest, WIDEST)).round()
    side = torch.exp2(level).clamp_min(narrowest)
    piece = torch.floor(x / side[:, None]).long()
    half = torch.nn.functional.normalize(sun - d, dim=-1)  # 0 where the eye looks into the sun
    # Equal areas of the sphere: z and azimuth.
    steps = 1 / math.sqrt(TILTS)
    azimuth = torch.atan2(half[:, 1], half[:, 0])
    tilt = torch.stack([(half[:, 2] * steps).floor(), (azimuth * steps).floor()], dim=-1).long()
    expected = faces / FACE * side.square() * TILTS / (2 * math.pi)
    number = torch.floor(expected + _uniform(torch.cat([piece, tilt, level.long()[:, None]], -1)))
    seen = FACE / side.square()
    return torch.where(width < WIDEST, number * seen * MIRRORED / SUN_SOLID_ANGLE, 0.0)


def _uniform(key: Int[Tensor, "n k"]) -> Float[Tensor, "n"]:
    """A random number in [0, 1) for each row of integers, by the finaliser of MurmurHash3."""
    mask = 0xFFFFFFFF
    mixed = torch.zeros_like(key[:, 0])
    for column in key.unbind(-1):
        mixed = ((mixed ^ (column & mask)) * 0x85EBCA6B + 0x9E3779B9) & mask
        mixed = ((mixed ^ (mixed >> 13)) * 0xC2B2AE35) & mask
        mixed = mixed ^ (mixed >> 16)
    return mixed.double().div(2.0**32).float().clamp_max(1 - 2**-24)
