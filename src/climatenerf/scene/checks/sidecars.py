"""Do depths, masks and labels agree with the photos and the sparse points?"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from climatenerf.core.errors import UserError
from climatenerf.core.listing import is_passed_over
from climatenerf.scene.checks.labels import label_findings
from climatenerf.scene.checks.sampling import MIN_POINTS, projected, sample, unreadable
from climatenerf.scene.findings import Finding, counted, examples
from climatenerf.scene.image_files import PHOTO_SUFFIXES, open_image
from climatenerf.scene.images import SATURATED, check_sidecar, load_depth, load_mask
from climatenerf.scene.scene import Scene, View

MAX_DEPTH_SPREAD = 0.15  # of log depth over points; metric depth is mostly within a tenth
SIMILAR_FOLDERS = {
    "labels": ("label",),
    "masks": ("mask",),
    "depth": ("depths",),
}
"""Names of folders that other programs give to what is read from each folder."""
UNITS = {
    1.0: "metres",
    1000.0: "millimetres",
    100.0: "centimetres",
    39.37: "inches",
    3.281: "feet",
    0.001: "kilometres",
    256.0: "1/256 m, as in KITTI",
    5000.0: "1/5000 m, as in TUM RGB-D",
    10000.0: "tenths of a millimetre",
}
"""Names of the units of depth files, by their number in a metre."""
MIN_UNIT_RATIO = 2.0  # between depths and points; metres of a network are up to 1.5 times wrong
MIN_HIDDEN_POINTS = 0.8  # fraction of points hidden by masks that are inverted
MAX_DENSER = 2.0  # density of points on what masks show, over the mean; an object has more


def sidecar_findings(scene: Scene) -> list[Finding]:
    """Return what is odd about the pixels of depth, mask and label files.

    Args:
        scene: Scene aligned to the world frame.
    """
    found = [*depth_findings(scene), *mask_findings(scene), *label_findings(scene)]
    # Of a kind whose pixels could not be read, the headers tell nothing more.
    unread = {each.file for each in found if each.severity == "error"}
    return [*found, *(odd for odd in header_findings(scene) if odd.file not in unread)]


def header_findings(scene: Scene) -> list[Finding]:
    """Return which sidecars cannot be read or have another shape than their photo, by kind.

    Headers of all files are read.
    """
    findings = []
    for kind, paths in (
        ("label", [view.label_path for view in scene.views]),
        ("mask", [view.mask_path for view in scene.views]),
        ("depth", [view.depth_path for view in scene.views]),
    ):
        errors = []
        for view, path in zip(scene.views, paths, strict=True):
            try:
                if path is not None:
                    check_sidecar(path, scene.cameras[view.camera])
            except UserError as error:
                errors.append((error, path))
        if errors:
            odd = unreadable(*errors[0])
            if len(errors) > 1:
                count = counted(len(errors), f"{kind} file")
                odd = replace(odd, message=f"{count} cannot be used; {odd.message}")
            findings.append(odd)
    return findings


def depth_findings(scene: Scene) -> list[Finding]:
    """Return what is odd about the depth files: saturation, unit, kind of depth."""
    views = sample(scene.views, lambda view: view.depth_path)
    if not views:
        return []
    findings, saturated, empty = [], 0, 0
    logs: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for view in views:
        saturated += _saturated(view.depth_path)
        try:
            depth = load_depth(view, scene)
        except UserError as error:
            return [unreadable(error, view.depth_path)]
        assert depth is not None
        empty += not np.isfinite(depth).any()
        at = projected(scene, view)
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
    # The error of the scale is one standard deviation.
    if max(times, 1 / times) < max(MIN_UNIT_RATIO, (1 + scene.scale_error) ** 2):
        return
    path = next(view.depth_path for view in scene.views if view.depth_path is not None)
    in_a_metre = times / (scene.depth_scale if path.suffix == ".png" else 1.0)
    unit = min(UNITS, key=lambda number: abs(np.log(in_a_metre / number)))
    message = (
        f"The depth files are {times:.3g} times the depths of the sparse points in metres (scale"
        f" from {scene.scale_source}, +-{scene.scale_error:.0%}), as if one metre had"
        f" {in_a_metre:.4g} units of theirs (nearest: {UNITS[unit]})"
    )
    remedy = (
        "convert NPY and NPZ to metres, give the scale of PNG in transforms.json, or give the scale"
        " of the scene if that is wrong"
    )
    yield Finding("depth-unit", message, remedy)


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
    views = sample(scene.views, lambda view: view.mask_path)
    full, hidden_by_any = [], False
    hidden_points, denser = [], []  # denser: fraction of the points over that of the area shown
    for view in views:
        try:
            usable = load_mask(view, scene)
        except UserError as error:
            return [unreadable(error, view.mask_path)]
        assert usable is not None
        hidden_by_any |= not usable.all()
        if not usable.any():
            full.append(view.name)
            continue
        at = projected(scene, view)
        if len(at.z) >= MIN_POINTS:
            shown = float(usable[at.row, at.column].mean())
            hidden_points.append(1 - shown)
            denser.append(shown / float(usable.mean()))
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
    # Masks that show an object alone hide most points too, but show where they are dense.
    hidden = float(np.median(hidden_points)) if hidden_points else 0.0
    if hidden > MIN_HIDDEN_POINTS and np.median(denser) < MAX_DENSER:
        message = f"The masks hide {hidden:.0%} of the sparse points, as if they were inverted"
        remedy = "black hides a pixel; invert the masks"
        findings.append(Finding("mask-inverted", message, remedy, file=folder))
    return findings


def unused_findings(
    scene: Scene, posed: Sequence[View], reported: Collection[Path] = ()
) -> list[Finding]:
    """Return photos without pose, and sidecars of no photo, in the folders that views use.

    Args:
        scene: The scene.
        posed: All photos with poses, also those that are left out for another reason.
        reported: Files that another finding names.
    """
    files = [view.path for view in posed] + list(reported)
    files += [view.label_path for view in posed if view.label_path]
    files += [view.mask_path for view in posed if view.mask_path]
    files += [view.depth_path for view in posed if view.depth_path]
    used = {os.path.normpath(path) for path in files}
    findings = []
    left_out = []
    for folder in sorted({Path(os.path.normpath(view.path.parent)) for view in scene.views}):
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
        folder = Path(os.path.normpath(scene.root / kind))
        files = [path for path in _photos(folder, {*PHOTO_SUFFIXES, ".npy", ".npz"})]
        extra = [path.name for path in files if str(path) not in used]
        if not extra or len(extra) == len(files):  # none used: `sidecar-partial` reports that
            continue
        message = f"{counted(len(extra), 'file')} in {kind}/ for no photo with a pose"
        findings.append(
            Finding("sidecar-unused", f"{message} ({examples(extra)})", "", "note", str(folder))
        )
    return [*findings, *folder_findings(scene)]


def folder_findings(scene: Scene) -> list[Finding]:
    """Return folders that seem to hold sidecars but have a name that is not read."""
    used = {
        path.parent
        for view in scene.views
        for path in (view.path, view.label_path, view.mask_path, view.depth_path)
        if path is not None
    }
    findings = []
    for read, others in SIMILAR_FOLDERS.items():
        for name in others:
            folder = scene.root / name
            files = _photos(folder, {*PHOTO_SUFFIXES, ".npy", ".npz"})
            if files and folder not in used and not (scene.root / read).is_dir():
                message = f"{counted(len(files), 'file')} in {name}/, which is not read"
                remedy = f"name the folder {read} to use them"
                findings.append(Finding("sidecar-unused", message, remedy, "note", str(folder)))
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
