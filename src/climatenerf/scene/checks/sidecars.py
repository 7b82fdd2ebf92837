"""Do depths, masks and labels agree with the photos and the sparse points?"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from climatenerf.core.errors import UserError
from climatenerf.core.listing import is_passed_over
from climatenerf.scene.findings import Finding, counted, examples
from climatenerf.scene.image_files import PHOTO_SUFFIXES, open_image
from climatenerf.scene.images import SATURATED, load_depth, load_labels, load_mask
from climatenerf.scene.scene import Scene, View

MAX_FILES = 24  # of each kind whose pixels are read
MIN_POINTS = 20  # points of a view on known depths, usable pixels or labels
MAX_DEPTH_SPREAD = 0.15  # of log depth over points; metric depth is mostly within a tenth
UNIT_FACTORS = (1000.0, 100.0, 39.37, 3.281, 1 / 3.281, 1 / 39.37, 0.01, 0.001)
UNIT_TOLERANCE = 1.25  # of the scale; that of an assumed camera height is known to 30 %
MAX_SKY_POINTS = 0.5  # fraction of points on the sky; distant trees and wires make some
MIN_HIDDEN_POINTS = 0.8  # fraction of points hidden by masks that are inverted
SKY = 10  # Cityscapes train id


def sidecar_findings(scene: Scene) -> list[Finding]:
    """Return what is odd about the pixels of depth, mask and label files.

    Args:
        scene: Scene aligned to the world frame.
    """
    return [*depth_findings(scene), *mask_findings(scene), *label_findings(scene)]


def _sample(views: Sequence[View], path_of: Callable[[View], Path | None]) -> list[View]:
    """Return up to `MAX_FILES` views that have a file, evenly spread."""
    having = [view for view in views if path_of(view) is not None]
    if len(having) <= MAX_FILES:
        return having
    return [having[i * len(having) // MAX_FILES] for i in range(MAX_FILES)]


@dataclass(frozen=True)
class _Projected:
    """Sparse points of a view.

    Attributes:
        row: Pixel rows.
        column: Pixel columns.
        z: Z-depths, m.
        length: Distances from the camera, m.
    """

    row: np.ndarray
    column: np.ndarray
    z: np.ndarray
    length: np.ndarray


def _projected(scene: Scene, view: View) -> _Projected:
    """Return a view's own points where they are recorded, otherwise all that fall into it."""
    points = scene.points_world()
    if points is None:
        points = np.empty((0, 3))
    elif view.seen is not None and len(view.seen):
        points = points[view.seen]
    c2w = scene.c2w_world(view)
    camera = scene.cameras[view.camera]
    local = (points - c2w[:3, 3]) @ c2w[:3, :3]
    with np.errstate(all="ignore"):  # points at infinity overflow, and are left out
        x, y = camera.project(local).T
    inside = (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height) & (local[:, 2] > 0)
    local = local[inside]
    return _Projected(
        y[inside].astype(np.int64),
        x[inside].astype(np.int64),
        local[:, 2],
        np.linalg.norm(local, axis=1),
    )


def depth_findings(scene: Scene) -> list[Finding]:
    """Return what is odd about the depth files: saturation, unit, kind of depth."""
    views = _sample(scene.views, lambda view: view.depth_path)
    if not views:
        return []
    findings, saturated, empty = [], 0, 0
    logs: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for view in views:
        saturated += _saturated(view.depth_path)
        try:
            depth = load_depth(view, scene)
        except UserError as error:
            return [_unreadable(error, view.depth_path)]
        assert depth is not None
        empty += not np.isfinite(depth).any()
        at = _projected(scene, view)
        value = depth[at.row, at.column]
        known = np.isfinite(value)
        if known.sum() >= MIN_POINTS:
            logs.append((np.log(value[known]), np.log(at.z[known]), np.log(at.length[known])))
    folder = str(views[0].depth_path.parent) if views[0].depth_path else ""
    if empty:
        message = f"{empty} of {len(views)} depth files that were looked at hold no known depth"
        findings.append(Finding("depth-empty", message, "replace or remove them", file=folder))
    if saturated:
        message = (
            f"{saturated} of {len(views)} depth files that were looked at hold the largest value"
            f" of their format, {SATURATED}, which is taken as unknown"
        )
        findings.append(Finding("depth-saturated", message, "", "note", folder))
    return [*findings, *(replace(odd, file=folder) for odd in _kind_of_depth(scene, logs))]


def _kind_of_depth(
    scene: Scene, logs: list[tuple[np.ndarray, np.ndarray, np.ndarray]]
) -> Iterator[Finding]:
    """Yield what the logarithms of file depth, z-depth and ray length show."""
    if len(logs) < min(3, len(scene.views)):
        return
    ratio = [float(np.median(value - z)) for value, z, _ in logs]
    spread = float(np.median([_spread(value - z) for value, z, _ in logs]))
    along_ray = float(np.median([_spread(value - length) for value, _, length in logs]))
    inverse = float(np.median([_spread(value + z) for value, z, _ in logs]))
    oblique = float(np.median([_spread(length - z) for _, z, length in logs]))
    if spread > MAX_DEPTH_SPREAD and inverse < 0.5 * spread:
        message = "The depth files hold inverse depths: they are larger where points are nearer"
        remedy = "put them into depth_relative/ as NPZ, or convert them to metres"
        yield Finding("depth-inverse", message, remedy)
        return
    if along_ray < 0.5 * spread and oblique > 0.01:
        message = "The depth files hold lengths along the rays instead of depths along the axis"
        remedy = "multiply them by the cosine of each pixel's angle from the axis"
        yield Finding("depth-ray-length", message, remedy)
    elif spread > MAX_DEPTH_SPREAD:
        message = (
            f"The depth files differ from the sparse points by {np.expm1(spread):.0%} within a"
            " photo"
        )
        remedy = "check that they belong to these photos, or leave them out with --mono-depth none"
        yield Finding("depth-disagrees", message, remedy)
        return
    times = float(np.exp(np.median(ratio)))
    # A wrong scale of the scene differs less than two units of length do.
    tolerance = UNIT_TOLERANCE if scene.scale_error < 0.1 else 2.0
    for factor in UNIT_FACTORS:
        if max(times / factor, factor / times) < tolerance and abs(np.log(factor)) > 3:
            message = (
                f"The depth files are {times:.4g} times the depths in metres"
                f" (scale from {scene.scale_source}), as if in another unit"
            )
            remedy = "convert NPY and NPZ to metres; give the scale of PNG in transforms.json"
            yield Finding("depth-unit", message, remedy)
            return


def _spread(values: Float[np.ndarray, " n"]) -> float:
    return float(np.median(np.abs(values - np.median(values))))


def _saturated(path: Path | None) -> bool:
    if path is None or path.suffix.lower() != ".png":
        return False
    try:
        with open_image(path) as image:
            extrema = image.getextrema()
    except (OSError, ValueError, SyntaxError, EOFError, UserError):
        return False  # reading it reports the error
    return isinstance(extrema[-1], int | float) and extrema[-1] == SATURATED


def mask_findings(scene: Scene) -> list[Finding]:
    """Return which masks hide all of their photo, none of it, or what points were found on."""
    views = _sample(scene.views, lambda view: view.mask_path)
    full, hidden_by_any, hidden_points = [], False, []
    for view in views:
        try:
            usable = load_mask(view, scene)
        except UserError as error:
            return [_unreadable(error, view.mask_path)]
        assert usable is not None
        hidden_by_any |= not usable.all()
        if not usable.any():
            full.append(view.name)
            continue
        at = _projected(scene, view) if view.seen is not None else None
        if at is not None and len(at.z) >= MIN_POINTS:
            hidden_points.append(1 - float(usable[at.row, at.column].mean()))
    findings, folder = [], str(views[0].mask_path.parent) if views and views[0].mask_path else ""
    if full:
        message = (
            f"The masks of {len(full)} of {len(views)} photos that were looked at hide all of them"
            f" ({examples(full)})"
        )
        remedy = "correct them: black hides a pixel, any other value shows it"
        every = len(full) == len(views)
        severity = "error" if every and len(views) == len(scene.views) else "warning"
        findings.append(Finding("mask-hides-all", message, remedy, severity, folder))
    elif views and not hidden_by_any:
        message = f"None of {len(views)} masks that were looked at hides anything"
        remedy = "check that pixels to hide are black (0)"
        findings.append(Finding("mask-hides-nothing", message, remedy, "note", folder))
    if hidden_points and np.median(hidden_points) > MIN_HIDDEN_POINTS:
        message = (
            f"The masks hide {np.median(hidden_points):.0%} of the points that the poses were"
            " found with, as if they were inverted"
        )
        remedy = "black hides a pixel; invert the masks"
        findings.append(Finding("mask-inverted", message, remedy, file=folder))
    return findings


def label_findings(scene: Scene) -> list[Finding]:
    """Return whether labels have undefined ids, or show sky where there are points."""
    on_sky = []
    for view in _sample(scene.views, lambda view: view.label_path):
        try:
            labels = load_labels(view, scene)
        except UserError as error:
            code = "labels-foreign" if "does not define" in str(error) else "unreadable"
            return [_unreadable(error, view.label_path, code)]
        assert labels is not None
        if view.seen is None or not (labels == SKY).any():
            continue
        at = _projected(scene, view)
        if len(at.z) >= MIN_POINTS:
            on_sky.append(float((labels[at.row, at.column] == SKY).mean()))
    if not on_sky or np.median(on_sky) <= MAX_SKY_POINTS:
        return []
    message = (
        f"{np.median(on_sky):.0%} of the sparse points lie on what the labels call sky, as if the"
        " labels had another numbering"
    )
    remedy = "set --label-space, or leave labels out"
    return [Finding("labels-disagree", message, remedy, file=str(scene.root / "labels"))]


def _unreadable(error: UserError, path: Path | None, code: str = "unreadable") -> Finding:
    cause, _, remedy = str(error).removesuffix(".").rpartition("; ")
    return Finding(code, cause or remedy, remedy if cause else "", "error", str(path))


def unused_findings(
    scene: Scene, posed: Sequence[View], reported: Collection[Path] = ()
) -> list[Finding]:
    """Return photos without pose, and sidecars of no photo, in the folders that views use.

    Args:
        scene: The scene.
        posed: All photos with poses, also those that are left out for another reason.
        reported: Files that another finding names.
    """
    used = {str(view.path) for view in posed} | {str(path) for path in reported}
    for view in posed:
        used |= {str(p) for p in (view.label_path, view.mask_path, view.depth_path) if p}
    findings = []
    left_out = []
    for folder in sorted({view.path.parent for view in scene.views}):
        left_out += [path for path in _photos(folder) if str(path) not in used]
    if left_out:
        message = (
            f"{counted(len(left_out), 'photo')} without a pose, left out"
            f" ({examples([path.name for path in left_out])})"
        )
        findings.append(
            Finding("photo-without-pose", message, severity="note", file=str(left_out[0].parent))
        )
    for kind in ("labels", "masks", "depth"):
        folder = scene.root / kind
        files = [path for path in _photos(folder, {*PHOTO_SUFFIXES, ".npy", ".npz"})]
        extra = [path.name for path in files if str(path) not in used]
        if not extra or len(extra) == len(files):  # none used: `sidecar-partial` reports that
            continue
        message = f"{counted(len(extra), 'file')} in {kind}/ for no photo with a pose"
        findings.append(
            Finding("sidecar-unused", f"{message} ({examples(extra)})", "", "note", str(folder))
        )
    return findings


def _photos(folder: Path, suffixes: Collection[str] = PHOTO_SUFFIXES) -> list[Path]:
    try:
        with os.scandir(folder) as entries:
            names = sorted(entry.name for entry in entries if entry.is_file())
    except OSError:
        return []
    return [
        folder / name
        for name in names
        if Path(name).suffix.lower() in suffixes and not is_passed_over(name)
    ]
