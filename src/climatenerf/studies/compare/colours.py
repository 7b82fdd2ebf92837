"""Colour transfer for the stand-ins: linear maps of moments, and recolouring by class."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8

from climatenerf.core.classes import ROAD, SKY, TERRAIN, VEGETATION
from climatenerf.core.srgb import LUMA
from climatenerf.ops.recolouring import recoloured
from climatenerf.styling.colour_map import transport_map
from climatenerf.weather.season.palettes import kept_differences

EPSILON = 1e-5  # added to variances: a picture of one colour has none, and no inverse root
WHITENED = (ROAD, TERRAIN, VEGETATION, SKY)
"""Classes that the paper stylises for snow."""
STRENGTH, WHITE_LUMA, MAX_BRIGHTNESS = 0.9, 0.7, 20.0


@dataclass(frozen=True)
class Moments:
    """Mean and covariance of colours."""

    mean: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "3 3"]


def moments(pictures: Sequence[Float[np.ndarray, "h w 3"]]) -> Moments:
    """Return the moments of all pixels of some pictures."""
    pixels = np.concatenate([picture.reshape(-1, 3) for picture in pictures])
    return Moments(pixels.mean(0), np.cov(pixels.T, bias=True))


def transferred(
    picture: Float[np.ndarray, "h w 3"], source: Moments, target: Moments
) -> Float[np.ndarray, "h w 3"]:
    """Return a picture after the Monge-Kantorovich map between two Gaussians of colours.

    x' = mean_t + A (x - mean_s) with A from `styling.colour_map.transport_map` of the covariances
    (Pitié and Kokaram 2007).

    Args:
        picture: colours in any space.
        source: of the colours to be moved, in the same space.
        target: of the colours to be reached.
    """
    s, t = (each.covariance + EPSILON * np.eye(3) for each in (source, target))
    return target.mean + (picture - source.mean) @ transport_map(s, t)


def class_means(
    pictures: Sequence[Float[np.ndarray, "h w 3"]], labels: Sequence[UInt8[np.ndarray, "h w"]]
) -> Float[np.ndarray, "k 3"]:
    """Return the mean linear colour of each of `WHITENED` over some pictures; 0 if it is absent."""
    sums, counts = np.zeros((len(WHITENED), 3)), np.zeros(len(WHITENED))
    for picture, label in zip(pictures, labels, strict=True):
        for k, kind in enumerate(WHITENED):
            own = label == kind
            sums[k] += picture[own].sum(0)
            counts[k] += own.sum()
    return sums / np.maximum(counts, 1)[:, None]  # 1: an absent class, 0/0


def whitened(
    picture: Float[np.ndarray, "h w 3"],
    label: UInt8[np.ndarray, "h w"],
    means: Float[np.ndarray, "k 3"],
) -> Float[np.ndarray, "h w 3"]:
    """Return linear colours with road, terrain, vegetation and sky recoloured towards white.

    Each class gets a mean luminance of `WHITE_LUMA` by `ops.recolouring.recoloured` with a white
    palette. Geometry and texture stay, so it is paint and not snow.

    Args:
        picture: linear radiance.
        label: merged class of each pixel.
        means: of the classes in the whole movie, from `class_means`.
    """
    luma = means @ np.array(LUMA)
    # 1e-6: an absent or black class, 0/0. Such a class has no pixels that would change.
    brightness = np.minimum(WHITE_LUMA / np.maximum(luma, 1e-6), MAX_BRIGHTNESS)
    share = STRENGTH * np.stack([label.ravel() == kind for kind in WHITENED], axis=-1)
    white = np.ones((share.shape[0], 1, 3)) * brightness[:, None]
    # Absent and black classes have no colour, 0/0; they have no pixels that would change.
    kept = np.stack([kept_differences(mean if mean.any() else np.ones(3)) for mean in means])
    tensors = (
        torch.from_numpy(np.ascontiguousarray(each, dtype=np.float64))
        for each in (picture.reshape(-1, 3), share, white, brightness[:, None, None] * kept)
    )
    return recoloured(*tensors).numpy().reshape(picture.shape)
