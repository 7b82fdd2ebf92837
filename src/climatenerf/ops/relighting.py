"""Sunlight on samples: by shadow maps, and by what photos show. No gradients.

A shadow map (Williams 1978) is an orthographic picture from the sun. Here each texel has two
depths, where three quarters and one quarter of the light pass: behind the first half of it is left,
behind both nothing.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.ops import dispatch

MIN_RECEIVED = 1e-9  # irradiance, whose logarithm is taken
DARKEST_SENT = 3e-3  # radiosity; the tint of less is noise in a photo of eight bits


def visibility(
    depths: Float[Tensor, "m k k 2"],
    half: tuple[float, ...],
    bias: tuple[float, ...],
    at: Float[Tensor, "n 3"],
) -> Float[Tensor, "n"]:
    """Fraction of the sun's light at positions, bilinear between texels.

    Args:
        depths: of each map, the finest first; +inf where the light is not stopped.
        half: half sides of the maps, m.
        bias: depth by which a surface lies behind the light's last shelter, for each map, m.
        at: positions across the sun's rays, from the middle of the maps, and along them, m.

    Returns:
        [0, 1]; by the finest map around a position, 1 beyond all maps.
    """
    if dispatch.backend(depths, at) == "cpu":
        from climatenerf.ops.cpu import relighting as kernel

        found = torch.empty_like(at[:, 0])
        arrays = dispatch.kernel_arrays(depths, at, found)
        kernel.visibility(arrays[0], half, bias, *arrays[1:])
        return found
    side = depths.shape[1] - 1
    result = torch.ones_like(at[:, 0])
    todo = torch.ones_like(result, dtype=torch.bool)
    for one, reach, behind in zip(depths, half, bias, strict=True):
        place = (at[:, :2] + reach) / (2 * reach / side)
        inside = todo & ((place >= 0) & (place < side)).all(-1)
        rows = inside.nonzero()[:, 0]
        result[rows] = _bilinear(one, place[rows], at[rows, 2], behind)
        todo &= ~inside
    return result


def _bilinear(
    depths: Float[Tensor, "k k 2"],
    place: Float[Tensor, "n 2"],
    depth: Float[Tensor, "n"],
    bias: float,
) -> Float[Tensor, "n"]:
    corner = place.long()
    u, v = (place - corner).unbind(-1)
    total = torch.zeros_like(depth)
    for dv, wv in ((0, 1 - v), (1, v)):
        for du, wu in ((0, 1 - u), (1, u)):
            first, last = depths[corner[:, 1] + dv, corner[:, 0] + du].unbind(-1)
            stopped = sum(((depth - each) / bias - 1).clamp(0, 1) for each in (first, last))
            total = total + wu * wv * (1 - stopped / 2)
    return total


def interpolated(
    grids: Float[Tensor, "c nz ny nx"],
    origin: Float[Tensor, "3"],
    cell: float,
    x: Float[Tensor, "n 3"],
    kind: Int[Tensor, "n"],
) -> Float[Tensor, "n"]:
    """Values of the grid of each sample's kind, trilinear; its border's beyond it.

    Args:
        grids: values at nodes.
        origin: position of the first node, m.
        cell: distance of nodes, m.
        x: positions, m.
        kind: index of the grid.
    """
    if dispatch.backend(grids, x, kind) == "cpu":
        from climatenerf.ops.cpu import relighting as kernel

        found = torch.empty_like(x[:, 0])
        arrays = dispatch.kernel_arrays(grids, origin, x, kind, found)
        kernel.interpolated(arrays[0], arrays[1], cell, *arrays[2:])
        return found
    last = torch.tensor(grids.shape[:0:-1], device=x.device) - 1
    place = torch.minimum(((x - origin) / cell).clamp_min(0), last.to(x))
    corner = place.long()
    fraction = place - corner
    total = torch.zeros_like(x[:, 0])
    for k in range(8):
        step = torch.tensor([k & 1, k >> 1 & 1, k >> 2 & 1], device=x.device)
        weight = torch.where(step == 1, fraction, 1 - fraction).prod(-1)
        i, j, h = torch.minimum(corner + step, last).unbind(-1)
        total = total + weight * grids[kind, h, j, i]
    return total


def expected_fractions(
    choices: Float[Tensor, "k 4"],
    sent: Float[Tensor, "n 3"],
    shaded: Float[Tensor, "n 3"],
    sun: Float[Tensor, "n 3"],
    beam: Float[Tensor, "3"],
    albedo: Float[Tensor, "n 2"],
    spread: Float[Tensor, "n 2"],
    visibility: Float[Tensor, "n"],
) -> Float[Tensor, "n 2"]:
    """Expected fractions of the sun on samples, by Bayes' rule over a few choices.

    Light is given as its luma, red and blue: brightness and tint are compared, since sunlight is
    redder than the sky's.

    Args:
        choices: fraction of the sun on the sample's own slope, fraction on one that faces the sun,
            and the probability of both where geometry has shadow and sun.
        sent: radiosity of samples, pi times their radiance.
        shaded: irradiance without the sun.
        sun: what the whole sun adds on the sample's own slope.
        beam: what it adds on a slope that faces it.
        albedo: natural logarithm of albedo's luma and of its red over blue, the mean.
        spread: their standard deviation.
        visibility: of the sun by geometry, [0, 1].

    Returns:
        The first two columns of `choices`, weighted by what is probable.
    """
    tensors = choices, sent, shaded, sun, beam, albedo, spread, visibility
    if dispatch.backend(*tensors) == "cpu":
        from climatenerf.ops.cpu import relighting as kernel

        found = sent.new_empty(len(sent), 2)
        kernel.expected_fractions(*dispatch.kernel_arrays(*tensors, found))
        return found
    mine = brightness_and_tint(sent, DARKEST_SENT) - albedo
    total, expected = torch.zeros_like(visibility), sent.new_zeros(len(sent), 2)
    for own, facing, in_shadow, in_sun in choices.tolist():
        prior = in_shadow + (in_sun - in_shadow) * visibility
        received = brightness_and_tint(shaded + own * sun + facing * beam, MIN_RECEIVED)
        off = ((mine - received) / spread).square().sum(-1)
        # 60: exp(-30) is still a number in float32, so that no total is 0.
        likely = prior * torch.exp(-0.5 * off.clamp_max(60.0))
        total += likely
        expected += likely[:, None] * sent.new_tensor([own, facing])
    return expected / total[:, None]


def brightness_and_tint(light: Float[Tensor, "n 3"], least: float) -> Float[Tensor, "n 2"]:
    """Logarithms of luma, and of red over blue, from luma, red and blue; no less than `least`."""
    log = light.clamp_min(least).log()
    return torch.stack([log[:, 0], log[:, 1] - log[:, 2]], dim=-1)
