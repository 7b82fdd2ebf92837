"""Scores of pictures that were edited: is the structure kept, do fixed colours flicker."""

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage

from climatenerf.core.srgb import LUMA
from climatenerf.evaluation.metrics import ssim

Display = Float[np.ndarray, "h w 3"]
EDGE_PERCENTILE = 99.0
LEVELS = 8  # of a colour channel: pixels within one cell of the cube have one colour
MIN_PIXELS = 30  # of a colour in each of two frames


def edge_ssim(edited: Display, clean: Display) -> float:
    """Return the structural similarity of the edges of two display pictures.

    Edges are Sobel magnitudes of luma, divided by their own 99th percentile and cut off at 1, so
    that a lower contrast alone costs little.

    Args:
        edited: the picture with weather, [0, 1].
        clean: the picture without, same shape.

    Returns:
        1 for equal edges; near 0 for unrelated ones.
    """
    return ssim(_edges(edited), _edges(clean))


def _edges(picture: Display) -> Float[np.ndarray, "h w 1"]:
    luma = picture @ np.array(LUMA)
    across, down = (ndimage.sobel(luma, axis=axis, mode="nearest") for axis in (0, 1))
    magnitude = np.hypot(across, down)
    # 1e-6: a picture of one colour has no edges, 0/0.
    return np.minimum(magnitude / max(np.percentile(magnitude, EDGE_PERCENTILE), 1e-6), 1)[
        ..., None
    ]


def flicker(edited: tuple[Display, Display], clean: tuple[Display, Display]) -> float:
    """Return by how much fixed colours change their luma between two edited frames.

    The pixels of a frame are grouped by their clean colour. The mean luma of a group in the edited
    frame must change as its clean mean does, unless the edit differs from frame to frame.

    Args:
        edited: two neighbouring frames with weather, display values in [0, 1].
        clean: the same frames without.

    Returns:
        Mean absolute change, display value, over the pixels of all colours that both frames have;
        NaN if they have none in common. 0 without an edit, and for one function of colour as far
        as the pixels of a group have one colour.
    """
    groups = [_groups(picture) for picture in clean]
    size = LEVELS**3
    counts = [np.bincount(group, minlength=size) for group in groups]
    changes = [
        _means(after, group, count) - _means(before, group, count)
        for after, before, group, count in zip(edited, clean, groups, counts, strict=True)
    ]
    weight = np.minimum(*counts)
    common = weight >= MIN_PIXELS
    if not common.any():
        return float("nan")
    return float(np.average(np.abs(changes[1] - changes[0])[common], weights=weight[common]))


def _groups(picture: Display) -> Int[np.ndarray, "n"]:
    level = np.minimum((picture * LEVELS).astype(np.int64), LEVELS - 1).reshape(-1, 3)
    return level @ np.array([LEVELS**2, LEVELS, 1])


def _means(
    picture: Display, group: Int[np.ndarray, "n"], count: Int[np.ndarray, "g"]
) -> Float[np.ndarray, "g"]:
    luma = (picture @ np.array(LUMA)).ravel()
    # 1: a colour that no pixel has, 0/0.
    return np.bincount(group, luma, minlength=len(count)) / np.maximum(count, 1)
