"""Recolouring of samples by class: pure functions of linear colours. No gradients.

T(c) = c + sum over classes k of p_k s_k w_k(c) (r_k(c) - c),
r_k(c) = max(0, Y(c) a_k + M_k c),

with probability p, strength s, luminance Y, palette colour a and matrix M. A season with
brightness kappa and palette a' has a = kappa a' and M c = kappa delta (c - Y(c) m) with the mean
colour m of the class, so that differences between leaves stay. The gate w depends on hue and
saturation alone. Hence T(g c) = g T(c) for any exposure g, and T(0) = 0: shadows stay shadows.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.core.colour import luma
from climatenerf.ops import dispatch

HUES = (68.0, 95.0, 160.0, 190.0)  # degrees in Oklab: yellow, first green; last green, cyan
SATURATIONS = (0.03, 0.09)  # chroma over lightness: grey, coloured

PATCHES, TEXELS = 16, 8  # along a side of the noise, and nodes along a patch
OCTAVES = ((0.35, 0.8), (0.12, 0.6))  # deviation of the smoothing in patches, and its part

# Oklab (Ottosson 2020): linear sRGB to cone responses, their cube roots to L, a, b.
CONES = (
    (0.4122214708, 0.5363325363, 0.0514459929),
    (0.2119034982, 0.6806995451, 0.1073969566),
    (0.0883024619, 0.2817188376, 0.6299787005),
)
OKLAB = (
    (0.2104542553, 0.7936177850, -0.0040720468),
    (1.9779984951, -2.4285922050, 0.4505937099),
    (0.0259040371, 0.7827717662, -0.8086757660),
)


@dataclass(frozen=True)
class ClassColours:
    """What a style does to the classes that it changes.

    Attributes:
        index: of each class among the logits.
        strength: fraction of the change that is made.
        gate: fraction of the change on what is not green.
        palette: linear colours a; shorter palettes repeat their last colour.
        count: number of colours of each palette.
        matrix: M.
    """

    index: Int[Tensor, "k"]
    strength: Float[Tensor, "k"]
    gate: Float[Tensor, "k"]
    palette: Float[Tensor, "k j 3"]
    count: Int[Tensor, "k"]
    matrix: Float[Tensor, "k 3 3"]


def recoloured_samples(
    colour: Float[Tensor, "s 3"],
    logits: Float[Tensor, "g c"],
    group: Int[Tensor, "s"],
    x: Float[Tensor, "s 3"],
    noise: Float[Tensor, "z y x"],
    patch: float,
    white: Float[Tensor, "3"],
    classes: ClassColours,
) -> Float[Tensor, "s 3"]:
    """Return T(c) of samples of a field.

    Args:
        colour: linear radiance, at least 0.
        logits: of the classes, one row for each group of samples.
        group: of each sample.
        x: positions, world m.
        noise: from `mottle`.
        patch: size of places that turn alike, m.
        white: light that the field is shown in over that of its photos, in which hue is judged.
        classes: what changes.
    """
    frame = torch.cat([white, white.new_tensor([1 / (patch * PATCHES)])])
    about = (classes.index, classes.count, classes.strength, classes.gate)
    tensors = colour, logits, group, x, noise, frame, *about, classes.palette, classes.matrix
    if dispatch.backend(*tensors) == "cpu":
        from climatenerf.ops.cpu import recolouring as kernel

        # Transposed as `colour` can be, it would reach the kernel as a copy.
        found = torch.empty_like(colour, memory_format=torch.contiguous_format)
        arrays = dispatch.kernel_arrays(*tensors, found)
        kernel.recolour(*arrays[:6], arrays[6:10], *arrays[10:])  # type: ignore
        return found
    photographed = colour / white
    share = logits.softmax(-1)[:, classes.index][group] * classes.strength
    share = share * torch.maximum(green(photographed)[:, None], classes.gate)
    place = mottled(noise, x, patch)
    parts = zip(classes.palette, classes.count.tolist(), strict=True)
    palette = torch.stack([palette_at(place, each[:count]) for each, count in parts], dim=1)
    return recoloured(photographed, share, palette, classes.matrix) * white


def recoloured(
    c: Float[Tensor, "n 3"],
    share: Float[Tensor, "n k"],
    palette: Float[Tensor, "n k 3"],
    matrix: Float[Tensor, "k 3 3"],
) -> Float[Tensor, "n 3"]:
    """Return T(c) of linear colours.

    Args:
        c: linear radiance, at least 0.
        share: p_k s_k w_k of each class; their sum is at most 1.
        palette: colour a_k of each class at this place.
        matrix: M_k of each class.
    """
    new = luma(c)[:, None, None] * palette + torch.einsum("kij,nj->nki", matrix, c)
    return c + (share[..., None] * (new.clamp_min(0) - c[:, None])).sum(1)


def green(c: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Return how green linear colours are, from 0 to 1; the same at every exposure."""
    lightness, a, b = _oklab(c).unbind(-1)
    hue = torch.rad2deg(torch.atan2(b, a)) % 360
    # 1e-6: black has no saturation, 0/0.
    saturation = torch.hypot(a, b) / lightness.clamp_min(1e-6)
    start, first, last, end = HUES
    inside = smoothstep(hue, start, first) * (1 - smoothstep(hue, last, end))
    return inside * smoothstep(saturation, *SATURATIONS)


def smoothstep(x: Float[Tensor, "*n"], low: float, high: float) -> Float[Tensor, "*n"]:
    """Return 0 below `low`, 1 above `high`, and a smooth cubic between."""
    u = ((x - low) / (high - low)).clamp(0, 1)
    return u * u * (3 - 2 * u)


def _oklab(c: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    cones = c @ c.new_tensor(CONES).T
    root = cones.clamp_min(0) ** (1 / 3)
    return root @ c.new_tensor(OKLAB).T


def palette_at(place: Float[Tensor, "n"], palette: Float[Tensor, "j 3"]) -> Float[Tensor, "n 3"]:
    """Return the palette's colours at places from 0 to 1; neighbours in it blend.

    Args:
        place: 0: the first colour; 1: the last.
        palette: linear colours.
    """
    count = palette.shape[0]
    at = place * (count - 1)
    low = at.floor().long().clamp(0, max(count - 2, 0))
    part = (at - low)[:, None]
    return palette[low] * (1 - part) + palette[(low + 1).clamp(max=count - 1)] * part


def mottle(seed: int) -> Float[Tensor, "z y x"]:
    """Return noise in [0, 1] on a periodic lattice, evenly spread: smooth patches, mottled.

    `PATCHES` patches of `TEXELS` nodes lie along each side; the first node of each axis is repeated
    at its end.

    Args:
        seed: another one puts the patches elsewhere.
    """
    side = PATCHES * TEXELS
    generator = torch.Generator(device="cpu").manual_seed(seed % 2**63)
    white = torch.fft.rfftn(torch.randn(side, side, side, generator=generator, device="cpu"))
    k = torch.fft.fftfreq(side, device="cpu") * 2 * torch.pi
    k2 = k[:, None, None] ** 2 + k[:, None] ** 2 + k[: side // 2 + 1] ** 2
    total = torch.zeros(side, side, side, device="cpu")
    for size, part in OCTAVES:
        smooth = torch.fft.irfftn(white * torch.exp(-k2 * (size * TEXELS) ** 2 / 2), s=[side] * 3)
        total += part * smooth / smooth.std()
    even = torch.special.ndtr(total / total.std())
    return torch.nn.functional.pad(even[None], (0, 1) * 3, mode="circular")[0]


def mottled(
    table: Float[Tensor, "z y x"], x: Float[Tensor, "n 3"], patch: float
) -> Float[Tensor, "n"]:
    """Return the noise of `mottle` at positions (world m), with patches of a size in m."""
    grid = 2 * torch.frac(torch.frac(x / (patch * PATCHES)) + 1) - 1
    grid = grid.clamp(-1, 1)[None, :, None, None]
    found = torch.nn.functional.grid_sample(table[None, None], grid, align_corners=True)
    return found.reshape(-1)
