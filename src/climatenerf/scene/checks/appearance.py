"""Correlation of photos around the points that their poses were found with.

A point that two photos show looks alike in both. A patch around its image in one photo, in the
plane through the point that is parallel to that photo, is projected into the other and correlated.
Right photos, poses and intrinsics reach a median of 0.78 and more in the captures tried. Lower ones
reveal files that were exchanged, and wrong focal lengths, without a search for matches
(`benchmarks/exchanged_photos.py`). Where no file records which photos show a point, the points that
no nearer one hides stand in (`visibility.py`); right captures then reach 0.67 and more.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from climatenerf.core.cameras import Camera
from climatenerf.scene.findings import Finding, examples
from climatenerf.scene.images import load_grey
from climatenerf.scene.scene import Scene, View

MAX_PHOTOS = 24  # whose pixels are read
SIDE = 640  # pixels of the longer side in which patches are compared
PATCH = 3  # samples to each side of a point
SPACING = 1.5  # pixels between samples
MAX_POINTS = 150  # of a pair
MIN_POINTS = 20  # of a pair, on patches inside both photos
PARTNERS = 2  # photos with which each is compared
MIN_MEDIAN = 0.6  # of a capture in which wrong photos can be identified
MAX_WRONG = 0.65  # of that median: correlation of a photo that shows something else
MAX_WRONG_VISIBLE = 0.3  # the same, where another surface may hide points that count as visible
DOUBTFUL = 0.8  # median below which other focal lengths are tried
BETTER = 0.1  # correlation that another focal length must gain
WRONG_CAPTURE = 0.4  # median below which photos, poses and intrinsics do not belong together
FOCAL_FACTORS = tuple(float(f) for f in np.geomspace(0.4, 2.5, 41))  # steps of 4.7 %
MIN_PAIRS = 3
MATCHES_AGREE = 0.7  # fraction from which poses and photos agree, so that the points are wrong


@dataclass(frozen=True)
class _Photo:
    """A reduced grey photo and its camera."""

    values: Float[np.ndarray, "h w"]
    camera: Camera


def appearance_findings(
    scene: Scene, among: Sequence[int] | None = None, matches: float | None = None
) -> list[Finding] | None:
    """Return which photos do not show their points; None if too few points are shared.

    Args:
        scene: Scene with points and, for some views, the rows of the points that they show.
        among: Indices of the views to compare if their points are visible ones instead of recorded
            ones; None for recorded points.
        matches: Fraction of matches between photos that agree with the poses, if it is known.

    Raises:
        UserError: A photo cannot be read.
    """
    if among is None:
        pairs = shared_pairs(scene.views)
    else:
        chosen = np.array(among)
        pairs = _unordered(_partners(scene.views, chosen, chosen, PARTNERS))
    photos = {i: _reduced(scene, scene.views[i]) for i in sorted({i for p in pairs for i in p})}
    found = {}
    for pair in pairs:
        if (value := _correlation(scene, photos, *pair)) is not None:
            found[pair] = value
    if len(found) < MIN_PAIRS:
        return None
    median = float(np.median(list(found.values())))
    if median < DOUBTFUL and (odd := _lens_finding(scene, photos, list(found), median)):
        return [odd]
    if median < WRONG_CAPTURE:
        wrong_points = among is not None and matches is not None and matches >= MATCHES_AGREE
        return [(_points_finding if wrong_points else _capture_finding)(scene, median)]
    if median < MIN_MEDIAN:
        return []
    best: dict[int, float] = defaultdict(lambda: -1.0)
    for pair, value in found.items():
        for i in pair:
            best[i] = max(best[i], value)
    limit = (MAX_WRONG if among is None else MAX_WRONG_VISIBLE) * median
    wrong = [scene.views[i] for i in sorted(best) if best[i] < limit]
    if not wrong:
        return []
    names = examples([view.name for view in wrong])
    message = (
        f"{len(wrong)} of {len(best)} compared photos do not match the others around shared points,"
        f" as if files were exchanged ({names})"
    )
    remedy = "give these files their right names, or remove them"
    return [Finding("photo-exchanged", message, remedy, file=str(wrong[0].path))]


def shared_pairs(views: Sequence[View]) -> list[tuple[int, int]]:
    """Return pairs of photos that show the same points, of `MAX_PHOTOS` photos at most.

    They are evenly spread photos if most of these share points, otherwise half as many, each with
    the photo that shares most points with it.
    """
    spread = np.unique(np.linspace(0, len(views) - 1, MAX_PHOTOS).astype(int))
    among = _partners(views, spread, spread, PARTNERS)
    if len({i for i, _ in among}) < 0.75 * len(spread):
        among = _partners(views, spread[::2], np.arange(len(views)), 1)
    return _unordered(among)


def _unordered(pairs: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    return sorted({(min(pair), max(pair)) for pair in pairs})


def _partners(
    views: Sequence[View], of: np.ndarray, others: np.ndarray, count: int
) -> list[tuple[int, int]]:
    """Return each photo with those of `others` that share most points with it, if these do."""
    rows = {int(i): views[i].seen for i in np.union1d(of, others)}
    size = 1 + max((int(r.max()) for r in rows.values() if r is not None and len(r)), default=0)
    shows, pairs = np.zeros(size, bool), []
    for i in of.tolist():
        own = rows[i]
        if own is None or len(own) < MIN_POINTS:
            continue
        shows[own] = True
        shared = np.array([0 if rows[j] is None else shows[rows[j]].sum() for j in others.tolist()])
        shows[own] = False
        shared[others == i] = 0
        order = np.argsort(-shared, kind="stable")[:count]
        pairs += [(i, int(others[j])) for j in order if shared[j] >= MIN_POINTS]
    return pairs


def _reduced(scene: Scene, view: View) -> _Photo:
    from scipy import ndimage  # here, since help and input errors should not wait for it

    values = load_grey(view, scene, SIDE).astype(np.float32)
    camera = scene.cameras[view.camera].resized(values.shape[1], values.shape[0])
    return _Photo(ndimage.gaussian_filter(values, 1.0), camera)


def _correlation(
    scene: Scene,
    photos: dict[int, _Photo],
    first: int,
    second: int,
    change: Callable[[Camera], Camera] = lambda camera: camera,
) -> float | None:
    """Return the median correlation of the patches that two photos share; None if these are few.

    Args:
        scene: The scene.
        photos: Pixels, by index of the view.
        first: Index of the view in whose pixels the patches are square.
        second: Index of the other view.
        change: Gives the intrinsics to compare with.
    """
    from scipy import ndimage

    assert scene.points is not None
    a, b = scene.views[first], scene.views[second]
    assert a.seen is not None and b.seen is not None
    rows = np.intersect1d(a.seen, b.seen)
    if len(rows) > MAX_POINTS:
        rows = rows[np.arange(MAX_POINTS) * len(rows) // MAX_POINTS]
    if len(rows) < MIN_POINTS:
        return None
    one, other = (replace(photos[i], camera=change(photos[i].camera)) for i in (first, second))
    local = (scene.points[rows] - a.c2w[:3, 3]) @ a.c2w[:3, :3]
    offset = SPACING * np.arange(-PATCH, PATCH + 1)
    across = np.stack(np.meshgrid(offset, offset), axis=-1).reshape(-1, 2)
    with np.errstate(all="ignore"):  # what is behind a camera or at infinity is left out
        pixel = one.camera.project(local)[:, None] + across
        rays = one.camera.directions(np.nan_to_num(pixel)).astype(np.float64)
        world = (rays / rays[..., 2:] * local[:, None, 2:]) @ a.c2w[:3, :3].T + a.c2w[:3, 3]
        moved = (world - b.c2w[:3, 3]) @ b.c2w[:3, :3]
        matching = other.camera.project(moved.reshape(-1, 3)).reshape(pixel.shape)
        good = (local[:, 2] > 0) & (moved[..., 2] > 0).all(axis=1)
        good &= _inside(pixel, one) & _inside(matching, other)
    if good.sum() < MIN_POINTS:
        return None
    patches = []
    for photo, at in ((one, pixel[good]), (other, matching[good])):
        values = ndimage.map_coordinates(
            photo.values, [at[..., 1] - 0.5, at[..., 0] - 0.5], order=1, mode="nearest"
        )
        patches.append(values - values.mean(axis=1, keepdims=True))
    norm = np.linalg.norm(patches[0], axis=1) * np.linalg.norm(patches[1], axis=1)
    # 1e-6: a patch without contrast divides 0 by 0.
    return float(np.median((patches[0] * patches[1]).sum(axis=1) / (norm + 1e-6)))


def _with_focal(camera: Camera, factor: float) -> Camera:
    return replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)


def _without_distortion(camera: Camera) -> Camera:
    return replace(camera, k1=0.0, k2=0.0, k3=0.0, k4=0.0, p1=0.0, p2=0.0)


def _inside(pixel: Float[np.ndarray, "n k 2"], photo: _Photo) -> np.ndarray:
    height, width = photo.values.shape
    return np.all((pixel > 1) & (pixel < (width - 1, height - 1)), axis=(1, 2))


def _lens_finding(
    scene: Scene, photos: dict[int, _Photo], pairs: Sequence[tuple[int, int]], given: float
) -> Finding | None:
    """Return a finding if the photos show their points with another lens.

    Tried are other focal lengths, and no distortion.
    """
    chosen = pairs[:: max(1, len(pairs) // 6)]

    def median_with(change: Callable[[Camera], Camera]) -> float:
        values = [_correlation(scene, photos, *pair, change) for pair in chosen]
        known = [value for value in values if value is not None]
        return float(np.median(known)) if len(known) >= MIN_PAIRS else -1.0

    medians = [median_with(lambda c, f=factor: _with_focal(c, f)) for factor in FOCAL_FACTORS]
    best = int(np.argmax(medians))
    camera = scene.cameras[scene.views[chosen[0][0]].camera]
    enough = max(MIN_MEDIAN, given + BETTER)
    if not camera.fisheye and _without_distortion(camera) != camera:
        straight = median_with(_without_distortion)
        if straight >= max(enough, medians[best]):
            message = (
                "The photos show their sparse points without the given lens distortion"
                f" (correlation {straight:.2f}), and not with it ({given:.2f})"
            )
            remedy = "check that the intrinsics belong to these photos"
            return Finding("distortion-disagrees", message, remedy, file=str(scene.root))
    if medians[best] < enough:
        return None
    message = (
        "The photos show their sparse points with a focal length of about"
        f" {FOCAL_FACTORS[best] * camera.fx:.0f} pixels, and not with the given {camera.fx:.0f}"
    )
    remedy = "check that the intrinsics belong to photos of this size"
    return Finding("focal-disagrees", message, remedy, file=str(scene.root))


def _capture_finding(scene: Scene, median: float) -> Finding:
    message = (
        "The photos do not look alike where they show the same sparse points (correlation"
        f" {median:.2f}), as if the files had other names when their poses were computed"
    )
    remedy = "check that photos, intrinsics and poses belong together"
    return Finding("photo-exchanged", message, remedy, file=str(scene.root))


def _points_finding(scene: Scene, median: float) -> Finding:
    message = (
        "The photos do not look alike where the sparse points lie in them (correlation"
        f" {median:.2f}), although matches between the photos agree with the poses"
    )
    remedy = "check that the points have the frame and the scale of the poses, or remove them"
    return Finding("points-disagree", message, remedy, file=str(scene.root))
