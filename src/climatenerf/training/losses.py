"""Losses of the paper (supplement, "Training Details"), each a pure function.

Their weights are in `fit.FitSettings`: the paper's, but for the distortion's (docs/decisions.md).
The paper's print "3^{-4}" is a mis-set 3e-4.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.field.colour_space import encode_srgb
from climatenerf.ops import dispatch


def colour_loss(linear: Float[Tensor, "n 3"], target: Float[Tensor, "n 3"]) -> Float[Tensor, ""]:
    """Mean squared error of display values; `linear` is radiance, `target` display sRGB."""
    return (encode_srgb(linear) - target).square().mean()


def distance_measure(t: Float[Tensor, "s"]) -> Float[Tensor, "s"]:
    """Bounded measure of distance for the distortion loss: t up to 1, then 2 - 1/t.

    In plain t, two samples on a far background would outweigh everything near.
    """
    return torch.where(t <= 1.0, t, 2.0 - 1.0 / t.clamp_min(1.0))


def distortion_loss(
    weights: Float[Tensor, "s"],
    t: Float[Tensor, "s"],
    dt: Float[Tensor, "s"],
    offsets: Int[Tensor, "rays+1"],
) -> Float[Tensor, ""]:
    """Mean distortion (mip-NeRF 360, Eq. 15): weight along a ray gathers at one place.

    t and dt in field units.
    """
    start, end = distance_measure(t - dt / 2), distance_measure(t + dt / 2)
    return dispatch.distortion(weights, (start + end) / 2, end - start, offsets).mean()


def opacity_loss(transmittance: Float[Tensor, "n"]) -> Float[Tensor, ""]:
    """Mean of -o·log o of the rays' opacity o: rays see matter or sky, not half of each."""
    opacity = (1.0 - transmittance).clamp(1e-6, 1.0)  # log 0
    return -(opacity * opacity.log()).mean()


def sky_loss(transmittance: Float[Tensor, "n"], is_sky: Float[Tensor, "n"]) -> Float[Tensor, ""]:
    """Mean opacity of rays labelled sky: the sky has no density."""
    return ((1.0 - transmittance) * is_sky).mean()
