"""Consistency of the poses: outliers, duplicates, and no baseline."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from climatenerf.scene.checks.points import InsideFractions
from climatenerf.scene.findings import Finding, counted, examples
from climatenerf.scene.scene import Scene

OUTLIER = 30.0  # distance from the median position over the 80th percentile of all distances
CERTAIN_OUTLIER = 300.0  # the same, even if the photo's own points support its pose
MAX_OUTLIERS = 0.1  # fraction of the photos
MIN_BASELINE = 1e-3  # of the median distance from cameras to their points
MIN_LEFT = 3  # photos


def distance_ratios(positions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Return distances from the median position over the distance that 80 % do not exceed.

    In a small capture with few far cameras, these must not set the measure: it is that of the
    nearest 60 % if these are thirty times nearer.
    """
    distance = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    typical = float(np.quantile(distance, 0.8))
    near = float(np.quantile(distance, 0.6))
    if typical > OUTLIER * near:
        typical = near
    return distance / max(typical, 1e-9)  # all others at one position: 0 / 0


def outliers(
    positions: Float[np.ndarray, "n 3"], fractions: InsideFractions | None
) -> Bool[np.ndarray, " n"]:
    """Return which cameras are so far from the others that their poses are in doubt.

    A route of cameras reaches a few times the distance of four fifths of them; a failed
    registration reaches thousands. A far camera whose own points fall into its photo may be a real
    one, such as a second group far away, unless it is extremely far.

    Args:
        positions: Of the cameras.
        fractions: Of the sparse points inside the photos, if there are points.
    """
    ratio = distance_ratios(positions)
    far = ratio > OUTLIER
    if fractions is not None and fractions.recorded:
        supported = np.nan_to_num(fractions.by_view) >= 0.5
        far &= ~supported | (ratio > CERTAIN_OUTLIER)
    return far


def without_outliers(
    scene: Scene, fractions: InsideFractions | None
) -> tuple[Scene, list[Finding]]:
    """Return the scene without photos whose cameras are far off, and a finding about them.

    More than `MAX_OUTLIERS` of the photos are a second group rather than errors; they stay.
    """
    positions = np.stack([view.c2w[:3, 3] for view in scene.views])
    far = outliers(positions, fractions)
    if not far.any():
        return scene, []
    remaining = tuple(view for view, out in zip(scene.views, far, strict=True) if not out)
    names = [view.name for view, out in zip(scene.views, far, strict=True) if out]
    rest = positions[~far]
    extent = float(np.linalg.norm(rest - np.median(rest, axis=0), axis=1).max())
    distance = np.linalg.norm(positions[far] - np.median(rest, axis=0), axis=1)
    few = len(names) <= max(1, MAX_OUTLIERS * len(far)) and len(remaining) >= MIN_LEFT
    what = "they are left out" if few else "they are too many to be left out"
    message = (
        f"{counted(len(names), 'photo')} with cameras {distance.min():.3g} units from the others,"
        f" which span {extent:.3g} ({examples(names)}); {what}"
    )
    remedy = "compute their poses again to use them" if few else "remove them or correct the poses"
    finding = Finding("pose-outlier", message, remedy, file=str(scene.root))
    return (replace(scene, views=remaining) if few else scene), [finding]


def duplicate_findings(scene: Scene) -> list[Finding]:
    """Return a finding about photos with identical poses."""
    groups: dict[bytes, list[str]] = defaultdict(list)
    for view in scene.views:
        groups[np.round(view.c2w, 9).tobytes()].append(view.name)
    same = [names for names in groups.values() if len(names) > 1]
    if not same or len(groups) == 1:  # one pose for all: see `baseline_findings`
        return []
    count = sum(map(len, same))
    message = (
        f"{count} photos share their pose with another, in {counted(len(same), 'group')}"
        f" ({' = '.join(same[0][:3])})"
    )
    remedy = "correct the poses, unless these photos were taken from a tripod"
    return [Finding("pose-duplicate", message, remedy, file=str(scene.root))]


def baseline_findings(scene: Scene) -> list[Finding]:
    """Return a finding if all cameras are at one position, as after a rotation on a tripod."""
    positions = np.stack([view.c2w[:3, 3] for view in scene.views])
    baseline = float(np.linalg.norm(positions - np.median(positions, axis=0), axis=1).max())
    distance = 0.0
    if scene.points is not None and len(scene.points):
        middle = np.median(positions, axis=0)
        distance = float(np.median(np.linalg.norm(scene.points - middle, axis=1)))
    scale = max(distance, float(np.abs(positions).max()) * 1e-6)
    if baseline > MIN_BASELINE * scale or baseline > 1e-6 and not distance:
        return []
    if baseline == 0:
        message = "All cameras are at one position, so no depth can be found"
        remedy = "use photos from different positions"
    else:
        message = f"All cameras are within {baseline:.2g} units, so no depth can be found"
        if distance:
            message += f": the sparse points are {distance:.2g} units away"
        remedy = "check the units of poses and points, or use photos from different positions"
    return [Finding("pose-no-baseline", message, remedy, file=str(scene.root))]
