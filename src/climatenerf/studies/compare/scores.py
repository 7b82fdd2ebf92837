"""Scores of a method's frames that need no weights and no user."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from climatenerf.evaluation.consistency import Frame, warp_difference, warp_error
from climatenerf.evaluation.edit_scores import edge_ssim, flicker
from climatenerf.evaluation.metrics import psnr, ssim
from climatenerf.studies.compare.material import Material
from climatenerf.studies.compare.pictures import Picture

FAR = 8  # frames between the two pictures of the longer warp error


@dataclass(frozen=True)
class MovieScores:
    """Scores of one method's movie of one effect; NaN where there is nothing to measure.

    Attributes:
        warp_next: warp error to the next frame, outside water; see `evaluation.consistency`.
        warp_far: the same to the frame `FAR` later.
        water_warp_next: RMS difference to the next frame within the water, along its surface,
            display value. A mirror image does not move with the surface, so a right reflection
            does not score 0.
        water_warp_far: the same to the frame `FAR` later.
        edge_ssim: similarity of edges with the clean frames.
        flicker: change of fixed colours from frame to frame, display value.
    """

    warp_next: float
    warp_far: float
    water_warp_next: float
    water_warp_far: float
    edge_ssim: float
    flicker: float


def movie_scores(
    material: Material, picture: Callable[[int], Picture], own_depth: bool
) -> MovieScores:
    """Score a movie.

    Args:
        material: what was edited.
        picture: reads an edited frame.
        own_depth: take the depth of our weather render, in which snow lies on the ground; for
            edits of the clean frames the clean depth is right.
    """
    count = len(material)
    every = range(count)
    display = [picture(i) / 255.0 for i in every]
    clean = [material.clean.picture(i) / 255.0 for i in every]
    water = [_water(material, i) for i in every]
    source = material.ours if own_depth else material.clean
    depths = [source.layer("depth", i) for i in every]
    path = material.clean.job.path

    def frame(i: int, depth: np.ndarray, excluded: np.ndarray) -> Frame:
        return Frame(display[i], depth, excluded, path.c2w[i], path.cameras[i])

    dry = [frame(i, depths[i], ndimage.binary_dilation(water[i])) for i in every]
    pairs = list(zip(clean, clean[1:], display, display[1:], strict=False))
    found = {"water_warp_next": float("nan"), "water_warp_far": float("nan")}
    if material.effect == "flood":
        wet = [frame(i, material.ours.layer("depth", i), ~water[i]) for i in every]
        found = {
            "water_warp_next": _warp(wet, 1, warp_difference),
            "water_warp_far": _warp(wet, FAR, warp_difference),
        }
    return MovieScores(
        warp_next=_warp(dry, 1, warp_error),
        warp_far=_warp(dry, FAR, warp_error),
        edge_ssim=_mean([edge_ssim(a, b) for a, b in zip(display, clean, strict=True)]),
        flicker=_mean([flicker((a, b), (c, d)) for c, d, a, b in pairs]),
        **found,
    )


def truth_scores(material: Material, picture: Callable[[int], Picture]) -> dict[str, float]:
    """Return the means of PSNR, dB, and SSIM against the true pictures of the material."""
    pairs = [(picture(i), true) for i, true in enumerate(material.true)]
    return {
        "psnr": _mean([psnr(a, b) for a, b in pairs]),
        "ssim": _mean([ssim(a, b) for a, b in pairs]),
    }


def _water(material: Material, index: int) -> np.ndarray:
    if material.effect != "flood":
        return np.zeros(material.size[::-1], bool)
    return material.mask(index) > 0.5


def _warp(frames: list[Frame], interval: int, score: Callable[[Frame, Frame], float]) -> float:
    pairs = zip(frames, frames[interval:], strict=False)
    return _mean([score(a, b) for a, b in pairs])


def _mean(values: list[float]) -> float:
    """Return the mean of the values that are not NaN."""
    known = [value for value in values if not np.isnan(value)]
    return float(np.mean(known)) if known else float("nan")
