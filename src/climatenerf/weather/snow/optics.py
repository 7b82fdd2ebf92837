"""Reflectance of snow: of deep snow by grain and soot, and of thin snow over what lies below.

Asymptotic radiative transfer (Kokhanovsky and Zege 2004) with the refractive index of Picard et al.
(2016). Colours are red, green and blue, represented by 610, 550 and 465 nm.
"""

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.weather.snow.parameters import Snow

ICE_DENSITY = 917.0  # kg/m3
FRESH_DENSITY, FRESH_GRAIN = 100.0, 1e-4  # kg/m3, of fresh dry snow; m, its grains
SETTLING = 0.55  # power of the grain: wet snow with grains of 1 mm has some 350 kg/m3
DENSITIES = (50.0, 500.0)  # kg/m3, of new snow and of old wet snow
ABSORPTION_ENHANCEMENT = 1.6  # B of the grains
ASYMMETRY = 0.845  # g of the grains
ICE_ABSORPTION = (
    4 * math.pi * np.array([6.9e-9, 2.6e-9, 0.74e-9]) / np.array([610e-9, 550e-9, 465e-9])
)
"""gamma of ice, 1/m."""
SOOT_ABSORPTION = 7060.0 * 550 / np.array([610.0, 550.0, 465.0])
"""Absorption cross-section of soot, m2/kg; inverse to the wavelength."""


def specific_surface(grain: float) -> float:
    """Surface of snow grains per mass, m2/kg, from their optical radius (m)."""
    return 3 / (ICE_DENSITY * grain)


def deep_reflectance(grain: float, soot: float) -> Float[np.ndarray, "3"]:
    """Reflectance of deep snow in diffuse light.

    Args:
        grain: optical radius of the grains, m.
        soot: mass of soot over that of snow.
    """
    absorbed = 2 * ABSORPTION_ENHANCEMENT * ICE_ABSORPTION / ICE_DENSITY + 2 * soot * (
        SOOT_ABSORPTION
    )  # m2/kg; over the specific surface it is the fraction of each scattering that is lost
    alpha = 16 / 3 * absorbed / specific_surface(grain) / (1 - ASYMMETRY)
    return np.exp(-np.sqrt(alpha))


def albedo_of(snow: Snow) -> Float[np.ndarray, "3"]:
    """Reflectance of deep snow: as asked, else by grain and soot."""
    if snow.albedo is not None:
        return np.full(3, snow.albedo)
    return deep_reflectance(snow.grain, 1e-9 * snow.soot)


def density(grain: float) -> float:
    """Return the density of snow in kg/m3: snow with coarse grains has settled.

    Args:
        grain: optical radius of the grains, m.
    """
    return float(np.clip(FRESH_DENSITY * (grain / FRESH_GRAIN) ** SETTLING, *DENSITIES))


def slab_reflectance(thickness: Float[Tensor, "*n"], grain: float) -> Float[Tensor, "*n"]:
    """Reflectance of a slab of snow that absorbs nothing; what it does not reflect it lets through.

    Two-stream approximation with the transport optical depth (1 - g) SSA SWE / 2.

    Args:
        thickness: m.
        grain: optical radius of the grains, m.
    """
    per_metre = (1 - ASYMMETRY) * specific_surface(grain) * density(grain) / 2
    scaled = 0.75 * per_metre * thickness.clamp_min(0)
    return scaled / (1 + scaled)


def over_ground(
    slab: Float[Tensor, "n 1"], deep: Float[Tensor, "3"], ground: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 3"]:
    """Reflectance of snow on ground, with all reflections between the two.

    Args:
        slab: reflectance of the slab without absorption.
        deep: reflectance of deep snow, which no slab exceeds.
        ground: reflectance of the ground, below 1.
    """
    reflected = torch.minimum(slab, deep)
    through = 1 - slab
    return reflected + through * through * ground / (1 - reflected * ground)
