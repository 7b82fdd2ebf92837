"""Formulas of the losses of the paper (supplement, "Training Details") and of further ones.

Each is a pure function; `objective.py` applies them and `settings.Losses` holds their weights.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from climatenerf.core.colour import encode_srgb
from climatenerf.ops import compositing

MAX_GROUND_ERROR = 0.05  # of `distance_measure`
CREASE = 0.03  # second difference from which a change of depth is an edge rather than noise
RESTING_MASK = 0.018  # value of a mask where nothing is wrong; at 0 it would learn no more


def colour_error(linear: Float[Tensor, "n 3"], target: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Return the squared error of display values; `linear`: radiance, `target`: display sRGB."""
    return (encode_srgb(linear) - target).square().mean(-1)


def distance_measure(t: Float[Tensor, "s"]) -> Float[Tensor, "s"]:
    """Return a bounded measure of a ray length in grid units: t up to 1, then 2 - 1/t.

    In plain t, two samples on a far background would outweigh everything near.
    """
    return torch.where(t <= 1.0, t, 2.0 - 1.0 / t.clamp_min(1.0))


def distortion_loss(
    weights: Float[Tensor, "s"],
    t: Float[Tensor, "s"],
    dt: Float[Tensor, "s"],
    offsets: Int[Tensor, "rays+1"],
) -> Float[Tensor, ""]:
    """Return the mean distortion of rays (mip-NeRF 360, Eq. 15): the spread of their weights.

    Args:
        weights: of the samples.
        t: ray length of each sample's middle, grid units.
        dt: extent of each sample, grid units.
        offsets: samples of ray r are offsets[r]:offsets[r + 1].
    """
    start, end = distance_measure(t - dt / 2), distance_measure(t + dt / 2)
    return compositing.distortion(weights, (start + end) / 2, end - start, offsets).mean()


def nearness(
    weights: Float[Tensor, "s"], t: Float[Tensor, "s"], offsets: Int[Tensor, "rays+1"]
) -> Float[Tensor, "rays"]:
    """Return how near the matter of each ray is: 2 for all at the camera, 0 for all at infinity.

    It is the sum of weights times the distance to infinity in `distance_measure`. Transmitted light
    counts as at infinity. Beyond one grid unit it is the expected inverse distance. As a loss it is
    an occlusion regularisation, as FreeNeRF's on the density near cameras (Yang, Pavone & Wang
    2023, Eq. 4).

    Args:
        weights: of the samples.
        t: ray length of each sample, grid units.
        offsets: samples of ray r are offsets[r]:offsets[r + 1].
    """
    beyond = (2.0 - distance_measure(t))[:, None]
    return compositing.accumulate(weights, beyond, offsets)[:, 0]


def sparse_depth_loss(
    weights: Float[Tensor, "s"],
    transmittance: Float[Tensor, "n"],
    t: Float[Tensor, "s"],
    depth: Float[Tensor, "n"],
    ray: Int[Tensor, "s"],
) -> Float[Tensor, ""]:
    """Return the mean distance of rays' matter from the measured one, in `distance_measure`.

    It is the mean of |s - s_measured| over the weights, not the error of the mean, so it gathers
    the weights at the point. Transmitted light counts as matter at infinity.

    Args:
        weights: of the samples.
        transmittance: of the rays.
        t: ray length of each sample, grid units.
        depth: measured ray length, grid units.
        ray: of each sample.
    """
    target = distance_measure(depth)
    error = weights * (distance_measure(t) - target[ray]).abs()
    return (error.sum() + (transmittance * (2.0 - target)).sum()) / depth.shape[0]


def ground_height_loss(
    weights: Float[Tensor, "k"], t: Float[Tensor, "k"], target: Float[Tensor, "k"], rays: int
) -> Float[Tensor, ""]:
    """Return the mean over rays of their matter's distance from the ground, in `distance_measure`.

    A sample's error is at most `MAX_GROUND_ERROR`: clutter is near the ground, and the rim of a
    tree in front of a far lawn must not outweigh its colours.

    Args:
        weights: of the samples.
        t: their ray lengths, grid units.
        target: ray lengths at which their rays meet the ground, grid units.
        rays: number of rays of the step.
    """
    error = (distance_measure(t) - distance_measure(target)).abs().clamp_max(MAX_GROUND_ERROR)
    return (weights * error).sum() / rays


def opacity_entropy_loss(transmittance: Float[Tensor, "n"]) -> Float[Tensor, ""]:
    """Return the mean of -o·log o over the rays' opacities o."""
    opacity = (1.0 - transmittance).clamp(1e-6, 1.0)  # log 0
    return -(opacity * opacity.log()).mean()


def below_horizon_loss(
    transmittance: Float[Tensor, "n"], below: Bool[Tensor, "n"]
) -> Float[Tensor, ""]:
    """Return the mean squared transmittance of the rays that point below the horizon.

    Such rays end on matter. The loss is the expectation of the error that a random colour behind
    them makes (variance 1/12 over [0,1]; Müller et al. 2022 train so), without its noise. A sky
    that is free to learn would paint the ground, with haze in front of it.
    """
    return (transmittance.square() * below).mean()


def sky_loss(weights: Float[Tensor, "k"], rays: int) -> Float[Tensor, ""]:
    """Return the mean over rays of the weights of samples in the sky, which has no density."""
    return weights.sum() / rays


def far_sky_loss(distance: Float[Tensor, "n"], is_sky: Float[Tensor, "n"]) -> Float[Tensor, ""]:
    """Return the paper's sky loss, the mean of exp(-distance) on sky rays: an opaque, far sky.

    `distance` is the composited one, in grid units; 0 on a ray without matter.
    """
    return ((-distance).exp() * is_sky).mean()


def second_difference(z: Float[Tensor, "m 3"]) -> Float[Tensor, "m"]:
    """Return the relative second difference of 1/z over pixels in a line: middle, left, right.

    The inverse z-depth of a plane is affine in pixel coordinates, so a plane gives 0 at
    any tilt.
    """
    middle, left, right = z.unbind(-1)
    return middle / left + middle / right - 2.0


def planarity_loss(z: Float[Tensor, "m 3"], counts: Float[Tensor, "m"]) -> Float[Tensor, ""]:
    """Return the mean of e² / (e² + `CREASE`²), e the second difference (Geman & McClure).

    Its gradient vanishes at edges of depth. `counts`: weight of each triple, [0,1].
    """
    squared = second_difference(z).square()
    return (counts * squared / (squared + CREASE**2)).mean()


def class_loss(
    logits: Float[Tensor, "n c"], target: Int[Tensor, "n"], known: Bool[Tensor, "n"]
) -> Float[Tensor, ""]:
    """Return the cross-entropy of composited logits where the class is known, over all rays."""
    counted = torch.where(known, target, -1)
    # One row a class: a softmax over six adjacent numbers takes five times as long.
    rows, goal = logits.T[None], counted[None]
    return F.cross_entropy(rows, goal, reduction="sum", ignore_index=-1) / logits.shape[0]


def normal_loss(
    weights: Float[Tensor, "s"],
    predicted: Float[Tensor, "s 3"],
    target: Float[Tensor, "s 3"],
    rays: int,
) -> Float[Tensor, ""]:
    """Return the weighted squared distance of unit normals a ray (Verbin et al. 2022)."""
    return (weights * (predicted - target).square().sum(-1)).sum() / rays


def masked_colour_loss(
    error: Float[Tensor, "n"],
    unexplained: Float[Tensor, "n"],
    mask: Float[Tensor, "n"],
    price: Float[Tensor, "n"],
) -> Float[Tensor, ""]:
    """Return (1 - M)·error + price·(M - `RESTING_MASK` log M), for its gradients.

    Colours learn from their error, weighted with 1 - M. M learns from the error that no
    neighbouring pixel explains, (1 - M)·unexplained. The value is the mean of both and of the price
    of M. The logarithm keeps an M without gradients near `RESTING_MASK`: at 0 it would learn no
    more. See `transients.py`.

    Args:
        error: squared colour error of each pixel.
        unexplained: the error that remains if the pixel may have a neighbour's colour.
        mask: M, (0,1).
        price: of masking each pixel, in squared display values.
    """
    unmasked = 1.0 - mask
    # 1e-6: if M underflows to 0, log 0 and in its gradient 0/0.
    cost = price * (mask - RESTING_MASK * mask.clamp_min(1e-6).log())
    return (unmasked.detach() * error + unmasked * unexplained.detach() + cost).mean()


class _ScaledGradient(torch.autograd.Function):
    @staticmethod
    def forward(ctx, value, factor):
        ctx.save_for_backward(factor)
        return value.view_as(value)

    @staticmethod
    def backward(ctx, grad):
        (factor,) = ctx.saved_tensors
        return grad * factor, None


def scale_gradient(value: Float[Tensor, "*n"], factor: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Return the value itself, with its gradient multiplied by a factor."""
    return _ScaledGradient.apply(value, factor)
