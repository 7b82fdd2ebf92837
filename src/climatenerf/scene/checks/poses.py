"""Poses held against each other: outliers, duplicates, and no baseline."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from climatenerf.scene.checks.points import Shares
from climatenerf.scene.findings import Finding, examples
from climatenerf.scene.scene import Scene

OUTLIER = 30.0  # distance from the median position over the 80th percentile of all distances
CERTAIN_OUTLIER = 300.0  # the same, even if the photo's own points support its pose
MAX_OUTLIERS = 0.1  # fraction of the photos; more are a second group, not errors
MIN_BASELINE = 1e-3  # of the median distance from cameras to their points
MIN_LEFT = 3  # photos


def outliers(positions: Float[np.ndarray, "n 3"], shares: Shares | None) -> Bool[np.ndarray, " n"]:
    """Return which cameras are so far from the others that their poses are errors.

    A route of cameras reaches a few times the 80th percentile of its distances from the middle; a
    failed registration reaches thousands. A far camera whose own points fall into its photo may be
    a real one, such as a second group far away, unless it is extremely far.

    Args:
        positions: Of the cameras.
        shares: Of the sparse points inside the photos, if there are points.
    """
    distance = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    typical = float(np.quantile(distance, 0.8))
    if typical == 0:
        typical = 1e-9  # all others at one position
    ratio = distance / typical
    far = ratio > OUTLIER
    if shares is not None and shares.recorded:
        supported = np.nan_to_num(shares.by_view) >= 0.5
        far &= ~supported | (ratio > CERTAIN_OUTLIER)
    if far.mean() > MAX_OUTLIERS or (~far).sum() < MIN_LEFT:
        return np.zeros(len(positions), bool)
    return far


def without_outliers(scene: Scene, shares: Shares | None) -> tuple[Scene, list[Finding]]:
    """Return the scene without photos whose cameras are far off, and a finding about them."""
    positions = np.stack([view.c2w[:3, 3] for view in scene.views])
    far = outliers(positions, shares)
    if not far.any():
        return scene, []
    kept = tuple(view for view, out in zip(scene.views, far, strict=True) if not out)
    names = [view.name for view, out in zip(scene.views, far, strict=True) if out]
    rest = positions[~far]
    extent = float(np.linalg.norm(rest - np.median(rest, axis=0), axis=1).max())
    distance = np.linalg.norm(positions[far] - np.median(rest, axis=0), axis=1)
    message = (
        f"{len(names)} photos have cameras {distance.min():.3g} units from the others, which span"
        f" {extent:.3g} ({examples(names)}); they are left out"
    )
    finding = Finding("pose-outlier", message, "compute their poses again to use them")
    return replace(scene, views=kept), [finding]


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
        f"{count} photos share their pose with another ({' = '.join(same[0][:3])},"
        f" {len(same)} groups)"
    )
    remedy = "correct the poses, unless these photos were taken from a tripod"
    return [Finding("pose-duplicate", message, remedy)]


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
    message = (
        "All cameras are at one position, so no depth can be found"
        if baseline == 0
        else f"All cameras are within {baseline:.2g} units, so no depth can be found"
    )
    return [Finding("pose-no-baseline", message, "use photos from different positions")]
