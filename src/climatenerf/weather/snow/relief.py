"""Fine relief of a snow surface: bumps of centimetres to decimetres that tilt it towards the light.

Undisturbed snow deviates from a plane by millimetres, by more over longer distances (Manes et al.
2008, "Statistical properties of fresh snow roughness"; Manninen et al. 2012). The relief is a sum
of plane waves of equal slope, so that its height grows with the wavelength. What is finer than a
pixel is filtered out.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

SHORTEST, LONGEST = 0.1, 0.8  # m, of the waves
COUNT = 24
GOLDEN = (math.sqrt(5) - 1) / 2  # its multiples spread evenly
FLATTEST = 0.02  # sine of the angle between ray and surface below which a pixel is no longer
COVERED = 0.03  # m of snow from which the relief is full


def slopes(
    x: Float[Tensor, "n 3"],
    d: Float[Tensor, "n 3"],
    width: Float[Tensor, "n"],
    height: float,
) -> Float[Tensor, "n 2"]:
    """Slopes (dz/dx, dz/dy) of the relief.

    Args:
        x: positions on the surface, m.
        d: unit directions from the eye to these.
        width: of a pixel across the rays, m.
        height: standard deviation of the relief, m.
    """
    k = torch.arange(COUNT, dtype=x.dtype, device=x.device)
    length = SHORTEST * (LONGEST / SHORTEST) ** (k / (COUNT - 1))
    angle = 2 * math.pi * ((k * GOLDEN) % 1)
    number = (2 * math.pi / length)[:, None] * torch.stack([angle.cos(), angle.sin()], dim=-1)
    # Heights c l of wavelength l: half the sum of their squares is the variance.
    slope = 2 * math.pi * height * math.sqrt(2 / float(length.square().sum()))
    phase = x[:, :2] @ number.T + 2 * math.pi * ((k * math.sqrt(2)) % 1)
    flat = d[:, :2] / d[:, :2].norm(dim=-1, keepdim=True).clamp_min(1e-6)  # 0/0 straight down
    along = (flat @ number.T) / d[:, 2:].abs().clamp_min(FLATTEST)
    across = torch.stack([-flat[:, 1], flat[:, 0]], dim=-1) @ number.T
    # A Gaussian with the second moments of a square pixel.
    kept = torch.exp(-(along.square() + across.square()) * (width[:, None] ** 2 / 24))
    return slope * (kept * phase.cos()) @ torch.nn.functional.normalize(number, dim=-1)


def tilted(
    normal: Float[Tensor, "n 3"], slope: Float[Tensor, "n 2"], thickness: Float[Tensor, "n"]
) -> Float[Tensor, "n 3"]:
    """Unit normals of a surface with a relief upon it, which thin snow has less of.

    Args:
        normal: unit normals without it.
        slope: of the relief.
        thickness: of the snow, m.
    """
    part = (thickness / COVERED).clamp(0, 1)[:, None]
    bent = torch.cat([normal[:, :2] - part * slope, normal[:, 2:]], dim=-1)
    return torch.nn.functional.normalize(bent, dim=-1)
