"""Do poses agree with the photos? Matches must meet in front of both cameras.

Corners (Harris & Stephens 1988) of neighbouring photos are matched by normalised patches. A match
must lie in the plane of the two cameras and the ray of its partner (Longuet-Higgins 1981), and both
rays must meet in front of the cameras. Wrong axes or intrinsics break that for all pairs alike.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from climatenerf.core.cameras import Camera
from climatenerf.scene.checks.conventions import CONVENTIONS, Pose, with_poses
from climatenerf.scene.findings import Finding, counted
from climatenerf.scene.images import load_grey
from climatenerf.scene.scene import Scene, View

PAIRS = 6
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
FOCAL_FACTORS = (0.25, 0.35, 0.5, 0.71, 1.41, 2.0, 2.83, 4.0)
MAX_ANGLE = 35.0  # degrees between the viewing directions of a pair

Match = tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"], float]
"""Directions of matched corners in the cameras' frames, and the radians of a pixel."""


def matching_findings(scene: Scene) -> tuple[Scene, list[Finding]]:
    """Return the scene in the axes in which matches agree with its poses, and what is odd.

    Raises:
        UserError: A photo cannot be read.
    """
    pairs = neighbours(scene.views)
    matches = [match(scene, a, b) for a, b in pairs]
    usable = [i for i, (first, _, _) in enumerate(matches) if len(first) >= MIN_MATCHES]
    if len(usable) < 2:
        message = (
            "Neighbouring photos have too few matches to check the poses"
            f" ({counted(len(usable), 'pair')} of {len(pairs)} with {MIN_MATCHES} or more)"
        )
        remedy = "check that poses and photos belong together if photos overlap"
        return scene, [Finding("matches-few", message, remedy, "note", str(scene.root))]
    pairs, matches = [pairs[i] for i in usable], [matches[i] for i in usable]

    def agreement(change: Callable[[Pose], Pose], tolerance: float = TOLERANCE) -> float:
        fractions = [
            agreeing_fraction(change(a.c2w), change(b.c2w), found, tolerance)
            for (a, b), found in zip(pairs, matches, strict=True)
        ]
        return float(np.median(fractions))

    given = agreement(lambda pose: pose)
    if given >= AGREE:
        return scene, []
    fractions = [agreement(change) for _, change in CONVENTIONS]
    best = int(np.argmax(fractions))
    if fractions[best] >= AGREE and fractions[best] > given + BETTER:
        what, change = CONVENTIONS[best]
        message = (
            f"The poses {what}; they are converted ({fractions[best]:.0%} of the matches between"
            f" neighbouring photos then agree with them, {given:.0%} before)"
        )
        finding = Finding("pose-axes", message, "correct the file to keep it from being guessed")
        return with_poses(scene, change), [finding]
    if (finding := _other_focal_length(scene, pairs, matches, given)) is not None:
        return scene, [finding]
    given = agreement(lambda pose: pose, LOOSE_TOLERANCE)
    if given >= DISAGREE:
        return scene, []
    message = (
        f"Only {given:.0%} of the matches between neighbouring photos agree with the poses"
        f" ({len(pairs)} pairs)"
    )
    remedy = "check that intrinsics, poses and photos belong together; a fit will be blurred"
    return scene, [Finding("matches-disagree", message, remedy)]


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


def neighbours(views: Sequence[View]) -> list[tuple[View, View]]:
    """Return pairs of photos that probably show the same: up to `PAIRS` by pose, `PAIRS` by name.

    Wrong poses have wrong neighbours, but photos are mostly taken in the order of their names.
    """
    position = np.stack([view.c2w[:3, 3] for view in views])
    axis = np.stack([view.c2w[:3, 2] for view in views])
    pairs = []
    for i in np.unique(np.linspace(0, len(views) - 1, 2 * PAIRS).astype(int)):
        distance = np.linalg.norm(position - position[i], axis=1)
        similar = axis @ axis[i] > np.cos(np.radians(MAX_ANGLE))
        near = np.where(similar & (distance > 0), distance, np.inf)
        order = np.argsort(near)
        # The second nearest: between the nearest ones of a video there is hardly a baseline.
        j = int(order[1] if len(order) > 1 and np.isfinite(near[order[1]]) else order[0])
        if np.isfinite(near[j]):
            pairs.append((views[i], views[j]))
    pairs = pairs[:: max(1, -(-len(pairs) // PAIRS))]
    named = {(a.name, b.name) for a, b in pairs}
    for i in np.unique(np.linspace(0, len(views) - 2, PAIRS).astype(int)):
        moved = np.linalg.norm(position[i] - position[i + 1]) > 0
        if moved and (views[i].name, views[i + 1].name) not in named:
            pairs.append((views[i], views[i + 1]))
    return pairs


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
