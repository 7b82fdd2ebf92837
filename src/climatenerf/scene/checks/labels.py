"""Do labels agree with the sparse points, with each other, and with up?"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Bool, UInt8

from climatenerf.core.errors import UserError
from climatenerf.scene.checks.sampling import MIN_POINTS, Projected, projected, sample, unreadable
from climatenerf.scene.findings import Finding, examples
from climatenerf.scene.images import load_labels
from climatenerf.scene.label_spaces import UNKNOWN
from climatenerf.scene.scene import Scene, View

MAX_SKY_POINTS = 0.5  # fraction of points on the sky; distant trees and wires make some
SKY, FENCE = 10, 4  # Cityscapes train ids
GROUND = (0, 1, 9)  # road, sidewalk, terrain
MIN_AREA = 0.03  # fraction of a photo that sky and ground must take to be compared
SEVEN_SKY_AREA = 0.05  # least area of what is sky in the numbering `seven`
SEVEN_SKY_POINTS = 0.25  # points on it, over those of its area
MAX_POINTS = 1000  # of a view whose labels are compared between views
MIN_PAIRS = 500  # of labels of one point in two views
MIN_AGREEMENT = 0.5  # beyond chance; right labels of noisy networks have that at least
MAX_CHANCE = 0.9  # agreement by chance; above it labels tell nothing
LOW_AGREEMENT = 0.35  # beyond chance; lower where labels contradict each other
BETTER = 0.1  # agreement beyond chance that the labels of other photos must gain


def label_findings(scene: Scene) -> list[Finding]:
    """Return whether labels have undefined ids, or contradict the points, each other or up.

    Args:
        scene: Scene aligned to the world frame.
    """
    views = sample(scene.views, lambda view: view.label_path)
    if not views:
        return []
    every = []
    for view in views:
        try:
            labels = load_labels(view, scene)
        except UserError as error:
            code = "labels-foreign" if "does not define" in str(error) else "unreadable"
            return [unreadable(error, view.label_path, code)]
        assert labels is not None
        every.append(labels)
    folder = str(views[0].label_path.parent) if views[0].label_path else ""
    empty = [view.name for view, each in zip(views, every, strict=True) if (each == UNKNOWN).all()]
    if len(empty) > len(views) / 2:
        message = (
            f"The labels of {len(empty)} of {len(views)} photos that were looked at hold no known"
            f" class ({examples(empty)})"
        )
        remedy = "set --label-space, or replace them"
        return [Finding("labels-empty", message, remedy, file=folder)]
    points = [projected(scene, view) for view in views]
    for contradiction in _contradictions(scene, views, every, points):
        remedy = "set --label-space, correct the files, or leave labels out"
        return [Finding("labels-disagree", contradiction, remedy, file=folder)]
    return []


def _contradictions(
    scene: Scene,
    views: Sequence[View],
    every: Sequence[UInt8[np.ndarray, "h w"]],
    points: Sequence[Projected],
) -> Iterator[str]:
    """Yield sentences about what labels contradict, the most certain first."""
    known = [
        (labels, labels[at.row, at.column])
        for labels, at in zip(every, points, strict=True)
        if len(at.z) >= MIN_POINTS
    ]
    on_sky = [(on == SKY).mean() for labels, on in known if (labels == SKY).any()]
    if on_sky and np.median(on_sky) > MAX_SKY_POINTS:
        yield (
            f"{np.median(on_sky):.0%} of the sparse points lie on what the labels call sky, as if"
            " the labels had another numbering"
        )
    above = [
        value
        for view, labels in zip(views, every, strict=True)
        if (value := _sky_above_ground(scene, view, labels)) is not None
    ]
    if above and np.median(above) < 0:
        yield "The labels show the sky below the ground, as if they were upside down"
    if known and max(int(labels[labels != UNKNOWN].max()) for labels, _ in known) <= 6:
        area = float(np.mean([(labels == FENCE).mean() for labels, _ in known]))
        hit = float(np.mean([(on == FENCE).mean() for _, on in known]))
        if area > SEVEN_SKY_AREA and hit < SEVEN_SKY_POINTS * area:
            yield (
                f"The labels call {area:.0%} of the photos a fence, on which hardly any sparse"
                " point lies, as if they had the numbering seven, in which it is the sky"
            )
    agreement = _agreement_by_shift(every, points)
    if agreement and max(agreement) > max(agreement[0] + BETTER, MIN_AGREEMENT):
        yield "The labels of other photos agree better with each other at the sparse points"
    elif agreement and agreement[0] < LOW_AGREEMENT:
        yield (
            "The labels of one sparse point differ from photo to photo: they agree"
            f" {max(agreement[0], 0.0):.0%} of the way from chance to always"
        )


def _sky_above_ground(scene: Scene, view: View, labels: UInt8[np.ndarray, "h w"]) -> float | None:
    """Return how far the sky is above the ground in a photo; None if one of them is small.

    The unit is the sine of the elevation.
    """
    sky, ground = labels == SKY, np.isin(labels, GROUND)
    if min(sky.mean(), ground.mean()) < MIN_AREA:
        return None
    up = scene.c2w_world(view)[2, :3]

    def elevation(where: Bool[np.ndarray, "h w"]) -> float:
        row, column = (each.mean() + 0.5 for each in np.nonzero(where))
        middle = np.array([column, row])
        return float(scene.cameras[view.camera].directions(middle) @ up)

    return elevation(sky) - elevation(ground)


def _agreement_by_shift(
    every: Sequence[UInt8[np.ndarray, "h w"]], points: Sequence[Projected]
) -> list[float]:
    """Return how well labels of one point agree between photos, for every cyclic shift of files.

    0 is what chance gives, and 1 agreement everywhere. The first value is that of the given order.
    Labels of a point in two photos mostly agree, but how much depends on what made them: so the
    given order is compared with the shifted ones. Empty if too few points are in several photos.
    """
    if len({labels.shape for labels in every}) != 1:
        return []
    most = max(len(each.z) for each in points)
    step = max(1, -(-most // MAX_POINTS))
    at = [_every(each, step) for each in points]
    order = np.random.default_rng(0).permutation(sum(len(each[0]) for each in at))
    point = np.concatenate([each[0] for each in at])[order]
    by_point = np.argsort(point, kind="stable")
    pair = point[by_point][1:] == point[by_point][:-1]
    if pair.sum() < MIN_PAIRS:
        return []
    agreement = []
    for shift in range(len(every)):
        moved = [every[(i + shift) % len(every)] for i in range(len(every))]
        found = np.concatenate(
            [labels[row, column] for labels, (_, row, column) in zip(moved, at, strict=True)]
        )[order][by_point]
        known = pair & (found[1:] != UNKNOWN) & (found[:-1] != UNKNOWN)
        if known.sum() < MIN_PAIRS:  # labels of few things alone tell nothing
            return []
        same = float((found[1:] == found[:-1])[known].mean())
        chance = float(((np.bincount(found[1:][known]) / known.sum()) ** 2).sum())
        if chance > MAX_CHANCE:  # nearly all of one class: they agree anyway
            return []
        agreement.append((same - chance) / (1 - chance))
    return agreement


def _every(at: Projected, step: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return every `step`-th point of the scene: row in the scene's, pixel row, pixel column."""
    chosen = at.point % step == 0
    return at.point[chosen], at.row[chosen], at.column[chosen]
