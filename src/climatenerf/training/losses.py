"""Losses of the paper (supplement, "Training Details"), each a pure function.

Their weights are in `fit.FitSettings`: the paper's, but for the distortion's (docs/decisions.md).
The paper's print "3^{-4}" is a mis-set 3e-4.
"""

import torch
from jaxtyping import Bool, Float, Int
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


def depth_loss(
    weights: Float[Tensor, "s"],
    left: Float[Tensor, "n"],
    t: Float[Tensor, "s"],
    depth: Float[Tensor, "n"],
    ray: Int[Tensor, "s"],
) -> Float[Tensor, ""]:
    """Mean distance of rays' matter from where it was measured, in `distance_measure`.

    The mean of |s - s_measured| over the weights, not the error of the mean: it gathers them at
    the point. Light left counts as matter at infinity. t and depth in field units.
    """
    goal = distance_measure(depth)
    off = weights * (distance_measure(t) - goal[ray]).abs()
    return (off.sum() + (left * (2.0 - goal)).sum()) / depth.shape[0]


def opacity_loss(transmittance: Float[Tensor, "n"]) -> Float[Tensor, ""]:
    """Mean of -o·log o of the rays' opacity o: rays see matter or sky, not half of each."""
    opacity = (1.0 - transmittance).clamp(1e-6, 1.0)  # log 0
    return -(opacity * opacity.log()).mean()


def solid_loss(transmittance: Float[Tensor, "n"], below: Bool[Tensor, "n"]) -> Float[Tensor, ""]:
    """Mean squared transmittance of the rays that point below the horizon.

    They end on something. Its expectation is that of a random colour behind them (variance 1/12
    over [0,1]; Müller et al. 2022 train so), without the noise: a sky that is free to learn
    paints the ground, and haze in front of it suffices.
    """
    return (transmittance.square() * below).mean()


def sky_loss(transmittance: Float[Tensor, "n"], is_sky: Float[Tensor, "n"]) -> Float[Tensor, ""]:
    """Mean opacity of rays labelled sky: the sky has no density."""
    return ((1.0 - transmittance) * is_sky).mean()
