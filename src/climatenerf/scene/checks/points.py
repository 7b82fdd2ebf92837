"""Do poses and intrinsics agree with the sparse points? Points must fall into the photos.

Where a capture records which photos show a point, nearly every such point falls into its photo.
Otherwise a point falls into at least one photo. If few do, other conventions are tried: OpenGL's
axes in place of OpenCV's, inverted poses, points in another frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from climatenerf.core.cameras import Camera
from climatenerf.scene.checks.conventions import CONVENTIONS, with_poses
from climatenerf.scene.checks.intrinsics import SAME_SHAPE, scaled_by, size_ratio
from climatenerf.scene.findings import Finding, counted, examples
from climatenerf.scene.scene import Scene, View

MAX_POINTS = 1000  # points a view; more change a fraction by less than two hundredths
MAX_VIEWS = 48  # views of which other conventions are tried
MIN_POINTS = 8  # seen points from which a view is judged
FEW_SEEN = 0.5  # fraction of a photo's own points inside it below which its pose is in doubt
FEW_UNION = 0.5  # fraction of all points inside any photo; a laser scan may reach far beyond them
FEW_ALL = 0.05  # median fraction of all points inside a photo
BETTER = 0.3  # fraction that another convention must gain to be taken
SMALLER = 0.75  # of the middle: principal points of smaller photos; rarer crops reach it too
STILL_INSIDE = 0.95  # of the fraction of points, with intrinsics scaled to the photo


@dataclass(frozen=True)
class InsideFractions:
    """Fractions of the sparse points in front of the cameras and inside the photos, 0 to 1.

    Attributes:
        by_view: Of the view's own points where these are recorded, of all points otherwise; NaN
            for a view with fewer than `MIN_POINTS` points.
        union: Fraction of all points inside at least one photo.
        recorded: Whether the capture records which photos show a point.
    """

    by_view: Float[np.ndarray, " v"]
    union: float
    recorded: bool

    @property
    def median(self) -> float:
        """Median over the views; 0 if no view has points."""
        known = self.by_view[np.isfinite(self.by_view)]
        return float(np.median(known)) if len(known) else 0.0

    @property
    def agreement(self) -> float:
        """One number to compare conventions by."""
        return self.median if self.recorded else self.union

    @property
    def doubtful(self) -> bool:
        """Whether poses, intrinsics and points contradict each other."""
        if self.recorded:
            return self.median < FEW_SEEN
        return self.union < FEW_UNION and self.median < FEW_ALL


def inside_fractions(
    cameras: Sequence[Camera],
    views: Sequence[View],
    points: Float[np.ndarray, "n 3"],
) -> InsideFractions:
    """Measure how many points fall into the photos.

    Args:
        cameras: Intrinsics.
        views: Photos with poses.
        points: Sparse points in the frame of the poses.
    """
    recorded = any(view.seen is not None and len(view.seen) for view in views)
    common = points[_spread(len(points), MAX_POINTS)]
    inside_any = np.zeros(len(common), bool)
    fractions = np.full(len(views), np.nan)
    for i, view in enumerate(views):
        camera = cameras[view.camera]
        if recorded:
            seen = np.empty(0, np.int64) if view.seen is None else view.seen
            own = points[seen[_spread(len(seen), MAX_POINTS)]]
            if len(own) >= MIN_POINTS:
                fractions[i] = _inside(camera, view.c2w, own).mean()
        else:
            inside = _inside(camera, view.c2w, common)
            inside_any |= inside
            fractions[i] = inside.mean()
    union = float(np.nanmean(fractions)) if recorded and np.isfinite(fractions).any() else 0.0
    return InsideFractions(fractions, union if recorded else float(inside_any.mean()), recorded)


def _spread(count: int, limit: int) -> np.ndarray:
    """Return up to `limit` indices, evenly spread."""
    return np.arange(count) if count <= limit else np.arange(limit) * count // limit


def _inside(
    camera: Camera, c2w: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "n 3"]
) -> np.ndarray:
    local = (points - c2w[:3, 3]) @ c2w[:3, :3]
    with np.errstate(all="ignore"):  # points at infinity overflow, and count as outside
        pixel = camera.project(local)
    x, y = pixel[:, 0], pixel[:, 1]
    return (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)


@dataclass(frozen=True)
class Convention:
    """Another reading of a capture's numbers.

    Attributes:
        code: Code of the finding.
        message: What was wrong and is done about it.
        scene: The scene under this reading.
    """

    code: str
    message: str
    scene: Scene


def other_conventions(
    scene: Scene, point_transforms: Sequence[Float[np.ndarray, "4 4"]] = ()
) -> list[Convention]:
    """Return the readings that are tried if a capture contradicts itself."""
    assert scene.points is not None
    out = [
        Convention("pose-axes", f"The poses {what}; they are converted", with_poses(scene, change))
        for what, change in CONVENTIONS
    ]
    for transform in point_transforms:
        for matrix in (transform, np.linalg.inv(transform)):
            moved = scene.points @ matrix[:3, :3].T + matrix[:3, 3]
            message = "The sparse points lack the applied_transform of the poses; it is applied"
            out.append(Convention("points-frame", message, replace(scene, points=moved)))
    return out


def of_smaller_photos(scene: Scene) -> tuple[Scene, list[Finding]]:
    """Return the scene with intrinsics scaled up if they belong to smaller photos.

    A principal point at the same fraction of both sides, well above the middle, is that of a
    smaller photo or of a crop. It is that of a smaller photo if the points still fall into the
    photos with intrinsics that are scaled to put it into the middle.
    """
    assert scene.points is not None
    cameras = []
    for camera in scene.cameras:
        across, down = 2 * camera.cx / camera.width, 2 * camera.cy / camera.height
        small = 0 < max(across, down) < SMALLER and abs(across / down - 1) < SAME_SHAPE
        cameras.append(scaled_by(camera, size_ratio(across, down)) if small else camera)
    if tuple(cameras) == scene.cameras:
        return scene, []
    before = inside_fractions(scene.cameras, scene.views, scene.points).agreement
    after = inside_fractions(cameras, scene.views, scene.points).agreement
    if after < STILL_INSIDE * before:
        return scene, []
    old, new = next((a, b) for a, b in zip(scene.cameras, cameras, strict=True) if a != b)
    message = (
        f"The principal point ({old.cx:g}, {old.cy:g}) belongs to photos {old.cx / new.cx:.3g}"
        f" times the size of these {old.width}x{old.height}; the intrinsics are scaled"
    )
    remedy = "give w and h of the photos that were calibrated, or correct the intrinsics"
    finding = Finding("intrinsics-resolution", message, remedy)
    return replace(scene, cameras=tuple(cameras)), [finding]


def agreeing_convention(
    scene: Scene, point_transforms: Sequence[Float[np.ndarray, "4 4"]] = ()
) -> tuple[Scene, InsideFractions, list[Finding]]:
    """Return the scene in the convention in which its points fall into its photos.

    Args:
        scene: Scene with points.
        point_transforms: Transforms that the points may lack.

    Returns:
        The scene, the fractions of its points, and what is odd.
    """
    assert scene.points is not None
    scene, findings = of_smaller_photos(scene)
    assert scene.points is not None
    fractions = inside_fractions(scene.cameras, scene.views, scene.points)
    if not fractions.doubtful:
        return scene, fractions, findings
    chosen = _spread(len(scene.views), MAX_VIEWS)
    best, best_fractions = None, _fractions_of(scene, chosen)
    first = best_fractions.agreement
    for other in other_conventions(scene, point_transforms):
        found = _fractions_of(other.scene, chosen)
        if not found.doubtful and found.agreement > max(best_fractions.agreement, first + BETTER):
            best, best_fractions = other, found
    what = "its own sparse points" if fractions.recorded else "the sparse points"
    if best is not None:
        assert best.scene.points is not None
        finding = Finding(
            best.code,
            f"{best.message} (inside a photo are then {best_fractions.agreement:.0%} of {what},"
            f" {first:.1%} before)",
            "correct the file to keep it from being guessed",
        )
        found, cloud = best.scene, best.scene.points
        return found, inside_fractions(found.cameras, found.views, cloud), [*findings, finding]
    finding = Finding(
        "points-outside",
        f"Only {fractions.agreement:.1%} of {what} lie inside a photo and in front of its camera",
        "check that intrinsics, poses, points and photos belong together; a fit will be blurred",
    )
    return scene, fractions, [*findings, finding]


def _fractions_of(scene: Scene, chosen: np.ndarray) -> InsideFractions:
    assert scene.points is not None
    return inside_fractions(scene.cameras, [scene.views[i] for i in chosen], scene.points)


def view_findings(scene: Scene, fractions: InsideFractions) -> list[Finding]:
    """Return a finding about photos whose poses contradict their own points, unlike the others'."""
    if not fractions.recorded or fractions.doubtful:
        return []
    wrong = [
        view.name
        for view, fraction in zip(scene.views, fractions.by_view, strict=True)
        if fraction < FEW_SEEN  # False for NaN
    ]
    if not wrong:
        return []
    message = (
        f"Less than half of their own sparse points lie inside {counted(len(wrong), 'photo')}"
        f" ({examples(wrong)})"
    )
    remedy = "remove these photos or compute their poses again"
    return [Finding("pose-disagrees", message, remedy, file=str(scene.root))]
