"""Scores of a place relit to another sky, against photos of the place under that sky.

Exposure is no part of the comparison: one gain for all views makes the median ratio of luma over
ground and walls 1.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from climatenerf.core.classes import BUILDING, GROUND, MERGED
from climatenerf.core.srgb import LUMA
from climatenerf.evaluation.reference import Truth

DARKEST = 1e-3  # radiance; ratios of darker pixels are noise
STEEP = 0.5  # |z| of a wall's normal
APART = 3  # pixels between the two sides of a shadow's edge
SHADOW = 2.0  # ratio of light over the edge of a shadow
ONE_PLANE = 0.05  # relative difference of ray lengths on one surface
FAR = 40.0  # m; further surfaces do not count


def relight_scores(
    pictures: Sequence[Float[np.ndarray, "h w 3"]],
    target: Sequence[Truth],
    photographed: Sequence[Truth],
) -> dict[str, float | dict[str, float]]:
    """Compare relit views with the truth under the target's sky.

    Args:
        pictures: relit views, linear radiance.
        target: the same views under the target's sky.
        photographed: the same views under the sky of the photos.

    Returns:
        `ground.median_error` and `walls.median_error`: median over pixels of the relative error,
        averaged over channels. `shadow_edge`: contrast that is left at the edges of the photos'
        shadows on the ground, over the contrast in the photos (both of log luma); None if the
        photos have no such edges.
    """
    found: dict[str, list[np.ndarray]] = {"ground": [], "walls": []}
    left, before = [], []
    for picture, true, photo in zip(pictures, target, photographed, strict=True):
        ratio = np.maximum(picture, DARKEST) / np.maximum(true.clean, DARKEST)
        ground, walls = _surfaces(true)
        found["ground"].append(ratio[ground])
        found["walls"].append(ratio[walls])
        change = np.log(_luma(photo.clean) / _luma(true.clean))
        rest = np.log(_luma(picture) / _luma(true.clean))
        for axis in (0, 1):
            step, kept, both = _edges(change, rest, true, ground, axis)
            before.append(np.abs(step[both]))
            left.append((kept * np.sign(step))[both])
    everything = np.concatenate([np.concatenate(each) for each in found.values()])
    gain = np.exp(np.median(np.log(everything @ LUMA)))
    scores: dict[str, float | dict[str, float]] = {}
    for name, ratios in found.items():
        error = np.abs(np.concatenate(ratios) / gain - 1).mean(-1)
        scores[name] = {"median_error": float(np.median(error)) if error.size else float("nan")}
    contrast = np.concatenate(before)
    scores["shadow_edge"] = (
        float(np.concatenate(left).mean() / contrast.mean()) if contrast.size else float("nan")
    )
    return scores


def _luma(rgb: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
    return np.maximum(rgb @ LUMA, DARKEST)


def _surfaces(truth: Truth) -> tuple[Bool[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Pixels of ground and of walls."""
    label = MERGED[truth.label]
    up = np.abs(truth.normal @ truth.c2w[2, :3])
    near = truth.depth < FAR
    return near & np.isin(label, GROUND) & (up > STEEP), near & (label == BUILDING) & (up < STEEP)


def _edges(
    change: Float[np.ndarray, "h w"],
    rest: Float[np.ndarray, "h w"],
    truth: Truth,
    ground: Bool[np.ndarray, "h w"],
    axis: int,
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Differences over `APART` pixels along an axis, and where they cross a shadow's edge."""

    def over(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if axis == 0:
            return values[APART:], values[:-APART]
        return values[:, APART:], values[:, :-APART]

    (a, b), (c, d), (e, f), (g, h) = (over(v) for v in (change, rest, truth.depth, ground))
    with np.errstate(invalid="ignore"):
        plane = np.abs(e - f) < ONE_PLANE * np.minimum(e, f)
    return a - b, c - d, g & h & plane & (np.abs(a - b) > np.log(SHADOW))
