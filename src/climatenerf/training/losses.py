"""Losses of the paper (supplement, "Training Details") and some more, each a pure function.

Their weights are in `settings.Losses`.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from climatenerf.core.colour import encode_srgb
from climatenerf.ops import compositing


def colour_error(linear: Float[Tensor, "n 3"], target: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Squared error of display values; `linear` is radiance, `target` display sRGB."""
    return (encode_srgb(linear) - target).square().mean(-1)


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
    return compositing.distortion(weights, (start + end) / 2, end - start, offsets).mean()


def sparse_depth_loss(
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


def ground_height_loss(
    weights: Float[Tensor, "k"], t: Float[Tensor, "k"], goal: Float[Tensor, "k"], rays: int
) -> Float[Tensor, ""]:
    """Mean over rays of their matter's distance from the ground at `goal`, as in `depth_loss`.

    At most `FAR` counts: lumps are near the ground, and the rim of a tree before a far lawn must
    not outweigh its colours.
    """
    off = (distance_measure(t) - distance_measure(goal)).abs().clamp_max(FAR)
    return (weights * off).sum() / rays


def opacity_entropy_loss(transmittance: Float[Tensor, "n"]) -> Float[Tensor, ""]:
    """Mean of -o·log o of the rays' opacity o: rays see matter or sky, not half of each."""
    opacity = (1.0 - transmittance).clamp(1e-6, 1.0)  # log 0
    return -(opacity * opacity.log()).mean()


def below_horizon_loss(
    transmittance: Float[Tensor, "n"], below: Bool[Tensor, "n"]
) -> Float[Tensor, ""]:
    """Mean squared transmittance of the rays that point below the horizon.

    They end on something. Its expectation is that of a random colour behind them (variance 1/12
    over [0,1]; Müller et al. 2022 train so), without the noise: a sky that is free to learn
    paints the ground, and haze in front of it suffices.
    """
    return (transmittance.square() * below).mean()


def sky_loss(weights: Float[Tensor, "k"], rays: int) -> Float[Tensor, ""]:
    """Mean over rays of the weights of matter that stands in the sky: the sky has no density."""
    return weights.sum() / rays


def far_sky_loss(distance: Float[Tensor, "n"], is_sky: Float[Tensor, "n"]) -> Float[Tensor, ""]:
    """The paper's form, exp(-distance) on sky rays: an opaque sky, far away.

    `distance` is the composited one, in grid units: 0 where nothing is.
    """
    return ((-distance).exp() * is_sky).mean()


def second_difference(z: Float[Tensor, "m 3"]) -> Float[Tensor, "m"]:
    """Relative second difference of 1/z over pixels in a line: middle, left, right.

    The inverse z-depth of a plane is affine in pixel coordinates, so planes bend by 0 however
    they are tilted.
    """
    middle, left, right = z.unbind(-1)
    return middle / left + middle / right - 2.0


def planarity_loss(z: Float[Tensor, "m 3"], counts: Float[Tensor, "m"]) -> Float[Tensor, ""]:
    """Mean of e² / (e² + `CREASE`²), e the bending (Geman & McClure): edges of depth go free."""
    squared = second_difference(z).square()
    return (counts * squared / (squared + CREASE**2)).mean()


def class_loss(
    logits: Float[Tensor, "n c"], target: Int[Tensor, "n"], known: Bool[Tensor, "n"]
) -> Float[Tensor, ""]:
    """Cross-entropy of composited logits where the class is known, a mean over all rays."""
    counted = torch.where(known, target, -1)
    # Each class in a row: a softmax over six numbers side by side takes five times as long.
    rows, goal = logits.T[None], counted[None]
    return F.cross_entropy(rows, goal, reduction="sum", ignore_index=-1) / logits.shape[0]


def normal_loss(
    weights: Float[Tensor, "s"],
    predicted: Float[Tensor, "s 3"],
    target: Float[Tensor, "s 3"],
    rays: int,
) -> Float[Tensor, ""]:
    """Mean over rays of the weighted squared distance of unit normals (Verbin et al. 2022)."""
    return (weights * (predicted - target).square().sum(-1)).sum() / rays


# M that costs least where nothing is amiss: at 0 it would learn no more. Such are M's first values.
FAINT = 0.018


def masked_colour_loss(
    error: Float[Tensor, "n"],
    unexplained: Float[Tensor, "n"],
    mask: Float[Tensor, "n"],
    price: Float[Tensor, "n"],
) -> Float[Tensor, ""]:
    """(1 - M)·error + price·(M - `FAINT` log M): see `transients.py`. Meant for its gradients.

    Colours learn from their error, as far as M lets them; M from the error that no pixel nearby
    explains, (1 - M)·unexplained. The value is the mean of both and of what M costs. The logarithm
    holds an M that nothing pulls at near `FAINT`: at 0 it would learn no more.
    """
    trusted = 1.0 - mask
    # 1e-6: of an M that is 0 in 32 bits, log 0 and in its gradient 0/0.
    paid = price * (mask - FAINT * mask.clamp_min(1e-6).log())
    return (trusted.detach() * error + trusted * unexplained.detach() + paid).mean()


FAR = 0.05  # of `distance_measure`
CREASE = 0.03  # bending that counts as an edge rather than as noise
