"""Do poses agree with the photos? Matches must meet in front of both cameras.

Corners (Harris & Stephens 1988) of neighbouring photos are matched by normalised patches. A match
must lie in the plane of the two cameras and the ray of its partner (Longuet-Higgins 1981), and both
rays must meet in front of the cameras. Wrong axes or intrinsics break that for all pairs alike.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from climatenerf.core.cameras import Camera
from climatenerf.scene.checks.conventions import CONVENTIONS, Pose, with_poses
from climatenerf.scene.findings import Finding, counted, examples
from climatenerf.scene.images import load_grey
from climatenerf.scene.scene import Scene, View

PAIRS = 6  # by pose, and as many by name: 24 photos at most
MAX_SUSPECTS = 3
SUSPECT_PAIRS = 3  # in place of `PAIRS` if there are suspects, which take three photos each
JUMP = 3.0  # of a suspect's pose, over the step of its neighbours and the median step
SIDE = 640  # pixels of the longer side in which photos are matched
CORNERS = 500
PATCH = 4  # samples to each side of a corner, two pixels apart
MIN_CORRELATION = 0.8
MIN_MARGIN = 0.04  # of the best correlation over the second best
MIN_MATCHES = 25  # of a pair
TOLERANCE = 1.0  # pixels from the epipolar line, of poses in the right convention
LOOSE_TOLERANCE = 4.0  # pixels, of imprecise poses such as those of a phone
AGREE = 0.7  # fraction of matches that agree; right poses have 0.9, wrong matches are the rest
BETTER = 0.2  # fraction that another convention must gain
DISAGREE = 0.4  # wrong poses have up to 0.6: neighbouring epipolar lines are nearly parallel
MIN_NEAR = 3  # pairs of neighbouring cameras from which an exchanged order is judged
FEW_EXACT = 0.35  # median fraction of their matches within `TOLERANCE`; right poses have 0.5
FEW_LOOSE = 0.3  # least fraction within `LOOSE_TOLERANCE`; right poses have 0.48
FOCAL_FACTORS = (0.25, 0.35, 0.5, 0.71, 1.41, 2.0, 2.83, 4.0)
MAX_ANGLE = 35.0  # degrees between the viewing directions of a pair

Match = tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"], float]
"""Directions of matched corners in the cameras' frames, and the radians of a pixel."""


@dataclass(frozen=True)
class Matching:
    """What the matches between neighbouring photos tell.

    Attributes:
        scene: The scene, in the axes in which matches agree with its poses.
        findings: What is odd.
        agreeing: Median fraction of the matches of a pair that agree with the poses; None if too
            few photos have matches.
        photos: Indices of the views whose pixels were read, without those whose poses are wrong.
    """

    scene: Scene
    findings: list[Finding]
    agreeing: float | None = None
    photos: tuple[int, ...] = ()


def matching_findings(scene: Scene) -> Matching:
    """Return what is odd about the poses, by matches between neighbouring photos.

    The pixels of 24 photos at most are read.

    Raises:
        UserError: A photo cannot be read.
    """
    odd_ones = suspects(scene.views)
    count = SUSPECT_PAIRS if odd_ones else PAIRS
    found = _matching(scene, count)
    names = {view.name for pair in neighbours(scene.views, count) for view in pair}
    read = {i for i, view in enumerate(scene.views) if view.name in names}
    if found.agreeing is None or found.agreeing < AGREE:
        return replace(found, photos=tuple(sorted(read)))
    read |= {j for i in odd_ones for j in (i - 1, i, i + 1)}
    wrong = [i for i in odd_ones if _contradicts(scene, i)]
    found = replace(found, photos=tuple(sorted(read.difference(wrong))))
    if not wrong:
        return found
    message = (
        f"The matches of {counted(len(wrong), 'photo')} contradict their poses, and those of the"
        f" photos before and after agree ({examples([scene.views[i].name for i in wrong])})"
    )
    remedy = "remove these photos or compute their poses again"
    finding = Finding("pose-disagrees", message, remedy, file=str(scene.root))
    return replace(found, findings=[*found.findings, finding])


def suspects(views: Sequence[View]) -> list[int]:
    """Return indices of photos whose pose jumps away from both neighbours by name, most first.

    The neighbours are near each other: a way that turns off, or a second camera, is no jump.
    """
    if len(views) < 3:
        return []
    position = np.stack([view.c2w[:3, 3] for view in views])
    axes = np.stack([view.c2w[:3, :3].reshape(9) for view in views])
    score = np.zeros(len(views) - 2)
    for values in (position, axes):  # the distance of axes grows with the angle
        step = np.linalg.norm(np.diff(values, axis=0), axis=1)
        away = np.minimum(step[:-1], step[1:])
        across = np.linalg.norm(values[2:] - values[:-2], axis=1)
        usual = np.maximum(across, max(float(np.median(step)), 1e-9))
        score = np.maximum(score, away / usual)
    order = np.argsort(-score, kind="stable")[:MAX_SUSPECTS]
    return [int(i) + 1 for i in order if score[i] > JUMP]


def _contradicts(scene: Scene, i: int) -> bool:
    """Return whether a photo's matches with the two around it contradict its pose."""
    before, view, after = scene.views[i - 1 : i + 2]

    def agreeing(a: View, b: View) -> float | None:
        found = match(scene, a, b)
        if len(found[0]) < MIN_MATCHES:
            return None
        return agreeing_fraction(a.c2w, b.c2w, found, LOOSE_TOLERANCE)

    own = [agreeing(before, view), agreeing(view, after)]
    around = agreeing(before, after)
    wrong = all(value is not None and value < DISAGREE for value in own)
    return wrong and around is not None and around >= AGREE


def _matching(scene: Scene, count: int) -> Matching:
    """Match photos in `count` pairs by pose and by name."""
    pairs = neighbours(scene.views, count)
    matches = [match(scene, a, b) for a, b in pairs]
    usable = [i for i, (first, _, _) in enumerate(matches) if len(first) >= MIN_MATCHES]
    if len(usable) < 2:
        message = (
            "Neighbouring photos have too few matches to check the poses"
            f" ({counted(len(usable), 'pair')} of {len(pairs)} with {MIN_MATCHES} or more)"
        )
        remedy = "check that poses and photos belong together if photos overlap"
        return Matching(scene, [Finding("matches-few", message, remedy, "note", str(scene.root))])
    pairs, matches = [pairs[i] for i in usable], [matches[i] for i in usable]

    def agreement(change: Callable[[Pose], Pose], tolerance: float = TOLERANCE) -> float:
        fractions = [
            agreeing_fraction(change(a.c2w), change(b.c2w), found, tolerance)
            for (a, b), found in zip(pairs, matches, strict=True)
        ]
        return float(np.median(fractions))

    given = agreement(lambda pose: pose)
    if given >= AGREE:
        return Matching(scene, [], given)
    fractions = [agreement(change) for _, change in CONVENTIONS]
    best = int(np.argmax(fractions))
    if fractions[best] >= AGREE and fractions[best] > given + BETTER:
        what, change = CONVENTIONS[best]
        message = (
            f"The poses {what}; they are converted ({fractions[best]:.0%} of the matches between"
            f" neighbouring photos then agree with them, {given:.0%} before)"
        )
        finding = Finding("pose-axes", message, "correct the file to keep it from being guessed")
        return Matching(with_poses(scene, change), [finding], fractions[best])
    if (finding := _other_focal_length(scene, pairs, matches, given)) is not None:
        return Matching(scene, [finding], given)
    loose = agreement(lambda pose: pose, LOOSE_TOLERANCE)
    if loose >= DISAGREE:
        return Matching(scene, _near_pairs_finding(scene, pairs, matches, count), given)
    message = (
        f"Only {loose:.0%} of the matches between neighbouring photos agree with the poses"
        f" ({len(pairs)} pairs)"
    )
    remedy = "check that intrinsics, poses and photos belong together; a fit will be blurred"
    return Matching(scene, [Finding("matches-disagree", message, remedy)], given)


def _near_pairs_finding(
    scene: Scene, pairs: Sequence[tuple[View, View]], matches: Sequence[Match], count: int
) -> list[Finding]:
    """Return a finding if photos whose cameras are neighbours match elsewhere.

    Along a way, epipolar lines of wrong poses are much like those of right ones, so most matches
    agree loosely. In an exchanged order some pair disagrees wholly. Pairs by name prove nothing:
    photos in no order need not overlap, and what matches is then wrong.
    """
    near = {(a.name, b.name) for a, b in near_by_pose(scene.views, count)}
    exact, loose = [], []
    for (a, b), found in zip(pairs, matches, strict=True):
        if (a.name, b.name) in near:
            exact.append(agreeing_fraction(a.c2w, b.c2w, found))
            loose.append(agreeing_fraction(a.c2w, b.c2w, found, LOOSE_TOLERANCE))
    if len(exact) < MIN_NEAR or np.median(exact) >= FEW_EXACT or min(loose) >= FEW_LOOSE:
        return []
    message = (
        f"Only {np.median(exact):.0%} of the matches between photos with neighbouring cameras agree"
        f" with the poses to a pixel, and as few as {min(loose):.0%} of a pair roughly"
    )
    remedy = "check that intrinsics, poses and photos belong together; a fit will be blurred"
    return [Finding("matches-disagree", message, remedy)]


def _other_focal_length(
    scene: Scene, pairs: Sequence[tuple[View, View]], matches: Sequence[Match], given: float
) -> Finding | None:
    """Return a finding if matches agree much better with other focal lengths."""

    def agreement(factor: float) -> float:
        scaled = [tuple(each / (factor, factor, 1.0) for each in found[:2]) for found in matches]
        fractions = [
            agreeing_fraction(
                a.c2w,
                b.c2w,
                (*(each / np.linalg.norm(each, axis=1, keepdims=True) for each in rays), pixel),
            )
            for (a, b), rays, (*_, pixel) in zip(pairs, scaled, matches, strict=True)
        ]
        return float(np.median(fractions))

    fractions = {factor: agreement(factor) for factor in FOCAL_FACTORS}
    best = max(fractions, key=lambda factor: fractions[factor])
    if fractions[best] < AGREE or fractions[best] < given + BETTER:
        return None
    focal = scene.cameras[pairs[0][0].camera].fx
    message = (
        f"{fractions[best]:.0%} of the matches between neighbouring photos agree with a focal"
        f" length of about {best * focal:.0f} pixels, {given:.0%} with the given {focal:.0f}"
    )
    remedy = "check that the intrinsics belong to photos of this size"
    return Finding("focal-disagrees", message, remedy, file=str(scene.root))


def neighbours(views: Sequence[View], count: int = PAIRS) -> list[tuple[View, View]]:
    """Return pairs of photos that probably show the same: `count` by pose and by name at most.

    Wrong poses have wrong neighbours, but photos are mostly taken in the order of their names.
    """
    position = np.stack([view.c2w[:3, 3] for view in views])
    pairs = near_by_pose(views, count)
    named = {(a.name, b.name) for a, b in pairs}
    for i in np.unique(np.linspace(0, len(views) - 2, count).astype(int)):
        moved = np.linalg.norm(position[i] - position[i + 1]) > 0
        if moved and (views[i].name, views[i + 1].name) not in named:
            pairs.append((views[i], views[i + 1]))
    return pairs


def near_by_pose(views: Sequence[View], count: int = PAIRS) -> list[tuple[View, View]]:
    """Return up to `count` pairs of photos with similar poses."""
    position = np.stack([view.c2w[:3, 3] for view in views])
    axis = np.stack([view.c2w[:3, 2] for view in views])
    pairs = []
    for i in np.unique(np.linspace(0, len(views) - 1, 2 * count).astype(int)):
        distance = np.linalg.norm(position - position[i], axis=1)
        similar = axis @ axis[i] > np.cos(np.radians(MAX_ANGLE))
        near = np.where(similar & (distance > 0), distance, np.inf)
        order = np.argsort(near)
        # The second nearest: between the nearest ones of a video there is hardly a baseline.
        j = int(order[1] if len(order) > 1 and np.isfinite(near[order[1]]) else order[0])
        if np.isfinite(near[j]):
            pairs.append((views[i], views[j]))
    return pairs[:: max(1, -(-len(pairs) // count))]


def match(scene: Scene, a: View, b: View) -> Match:
    """Match the corners of two photos.

    Raises:
        UserError: A photo cannot be read.
    """
    (first, around_first, camera), (second, around_second, other) = (
        _described(scene, view) for view in (a, b)
    )
    if not len(first) or not len(second):
        return np.empty((0, 3)), np.empty((0, 3)), 0.0
    correlation = around_first @ around_second.T
    best = correlation.argmax(axis=1)
    value = correlation[np.arange(len(first)), best]
    mutual = correlation.argmax(axis=0)[best] == np.arange(len(first))
    correlation[np.arange(len(first)), best] = -1
    distinct = value - correlation.max(axis=1) > MIN_MARGIN
    good = mutual & distinct & (value > MIN_CORRELATION)
    pixel = 1 / min(camera.fx, other.fx)
    return (
        camera.directions(first[good]).astype(np.float64),
        other.directions(second[best[good]]).astype(np.float64),
        pixel,
    )


def _described(
    scene: Scene, view: View
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n d"], Camera]:
    """Return corners (x, y) of a reduced photo, their normalised patches, and its camera."""
    from scipy import ndimage  # here, since help and input errors should not wait for it

    values = load_grey(view, scene, SIDE).astype(np.float32)
    camera = scene.cameras[view.camera].resized(values.shape[1], values.shape[0])
    smooth = ndimage.gaussian_filter(values, 1.0)
    dy, dx = np.gradient(smooth)
    xx, yy, xy = (ndimage.gaussian_filter(v, 1.5) for v in (dx * dx, dy * dy, dx * dy))
    strength = xx * yy - xy * xy - 0.05 * (xx + yy) ** 2
    margin = 2 * PATCH + 2
    peak = strength == ndimage.maximum_filter(strength, 7)
    peak[:margin], peak[-margin:], peak[:, :margin], peak[:, -margin:] = False, False, False, False
    row, column = np.nonzero(peak & (strength > 1e-3 * strength.max(initial=0.0)))
    strongest = np.argsort(-strength[row, column])[:CORNERS]
    row, column = row[strongest], column[strongest]
    offset = 2 * np.arange(-PATCH, PATCH + 1)
    rows = row[:, None, None] + offset[:, None]
    patches = smooth[rows, column[:, None, None] + offset].reshape(len(row), (2 * PATCH + 1) ** 2)
    patches = patches - patches.mean(axis=1, keepdims=True)
    # 1e-6: a patch without contrast divides 0 by 0.
    patches /= np.linalg.norm(patches, axis=1, keepdims=True) + 1e-6
    return np.stack([column + 0.5, row + 0.5], axis=-1), patches, camera


def agreeing_fraction(
    first: Float[np.ndarray, "4 4"],
    second: Float[np.ndarray, "4 4"],
    found: Match,
    tolerance: float = TOLERANCE,
) -> float:
    """Return the fraction of matches on their epipolar lines and in front of both cameras.

    Inverted poses of cameras with equal orientation have the same epipolar lines, since only the
    baseline changes its sign, but their rays meet behind them. Nearly parallel rays count as in
    front.

    Args:
        first: Camera-to-input pose of the first photo.
        second: That of the second.
        found: Their matches.
        tolerance: Distance from the epipolar line, pixels.
    """
    a, b, pixel = found
    a, b = a @ first[:3, :3].T, b @ second[:3, :3].T
    baseline = second[:3, 3] - first[:3, 3]
    normal = np.cross(baseline, a)
    length = np.linalg.norm(normal, axis=1)
    sine = np.abs(np.einsum("mi,mi->m", b, normal))
    # A ray along the baseline has no plane; it counts as on it.
    on_line = sine <= np.sin(tolerance * pixel) * length
    across = np.cross(a, b)
    parallel = np.linalg.norm(across, axis=1) < tolerance * pixel
    # Signs of the lengths along both rays at which these are nearest to each other.
    along_first = np.einsum("mi,mi->m", np.cross(baseline, b), across)
    along_second = np.einsum("mi,mi->m", normal, across)
    in_front = parallel | ((along_first > 0) & (along_second > 0))
    return float((on_line & in_front).mean())
