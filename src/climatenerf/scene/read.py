"""Read a capture of any supported format: detect the format, check the images, align the world."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError
from climatenerf.core.listing import visible
from climatenerf.core.regular_files import check_regular, special_kind
from climatenerf.scene.alignment.scale import rescale_by_camera_height
from climatenerf.scene.alignment.world_frame import align_scene
from climatenerf.scene.checks.check import corrected
from climatenerf.scene.checks.intrinsics import corrected_camera
from climatenerf.scene.checks.sidecars import sidecar_findings, unused_findings
from climatenerf.scene.file_names import FileNames
from climatenerf.scene.findings import Finding, counted, without_repeats
from climatenerf.scene.image_files import PHOTO_SUFFIXES
from climatenerf.scene.images import Header, read_header
from climatenerf.scene.label_spaces import checked_label_space
from climatenerf.scene.readers.capture import Capture, checked_camera, checked_pose
from climatenerf.scene.readers.colmap import model_folders, read_colmap
from climatenerf.scene.readers.kitti360 import kitti360_root, parse_frames, read_kitti360
from climatenerf.scene.readers.mega_nerf import is_mega_nerf, read_mega_nerf
from climatenerf.scene.readers.tanks_temples import is_tanks_temples, read_tanks_temples
from climatenerf.scene.readers.transforms_json import (
    SPLIT_FILES,
    read_transforms,
    transforms_files,
)
from climatenerf.scene.scene import (
    FILE_NAME,
    Scene,
    View,
    checked_world,
    is_file,
    load_scene,
    with_split,
)

HOLDOUT_EVERY = 8
MIN_IMAGES = 3
MAX_CAMERA_HEIGHT = 1e5  # m: a satellite is no camera of a street
MAX_ROUND_TRIP = 0.5  # pixels: error of inverting the lens distortion that is worth a warning


def read_scene(
    path: Path | str,
    *,
    holdout: str | None = None,
    camera_height: float | None = None,
    metric_input: bool = False,
    gravity: Mapping[str, Sequence[float]] | None = None,
    frames: str | tuple[int, int] | None = None,
    label_space: str | None = None,
) -> Scene:
    """Read a capture of any supported format and align it to a metric, z-up world.

    Args:
        path: A folder (`scene.json`, `transforms.json`, COLMAP, Tanks and Temples, KITTI-360,
            Mega-NeRF) or a `.json` file.
        holdout: None for the capture's predefined split, or every 8th image by sorted name (first,
            ninth, ...) if it has none; "0" for none; or names separated by commas.
        camera_height: Height of the cameras above the ground, metres, which sets the scale.
        metric_input: The poses are in metres with z up already and are kept unchanged.
        gravity: Direction of gravity in camera axes, unit vector, by image name, where the
            camera's accelerometer recorded it.
        frames: First and last frame of a KITTI-360 drive, both included, as a pair or "1538:1601".
        label_space: Numbering of the ids in the label files, one of `LABEL_SPACES`; None for the
            numbering that the format prescribes.

    Returns:
        The scene. Its `findings` are what is odd about the capture. One of severity "error", such
        as a label file that cannot be read, is raised by whatever loads that file.

    Raises:
        UserError: The input cannot be used; the message names the cause and the remedy.
    """
    path = Path(path).absolute()
    if not path.exists():
        raise UserError(f"{path} does not exist; give the folder of a posed capture.")
    check_flags(camera_height, metric_input, frames, label_space)
    saved = None
    if (path / FILE_NAME).is_file() or path.name == FILE_NAME:
        saved = load_scene(path)
        capture = _capture_from_scene(saved, path)
    else:
        capture = _read_capture(path, None if frames is None else parse_frames(frames))
    if frames is not None and (saved is not None or capture.source != "kitti360"):
        raise UserError(
            f"--frames selects frames of a KITTI-360 drive, which {path} is not; omit it."
        )
    capture = _find_sidecars(_check_images(capture))
    scene = Scene(
        root=capture.root,
        source=capture.source,
        cameras=capture.cameras,
        views=capture.views,
        points=capture.points,
        findings=capture.findings,
        label_space=label_space or capture.label_space,
        depth_scale=capture.depth_scale,
    )
    scene = corrected(scene, capture.point_transforms)
    scene = replace(
        scene, views=_split(scene.views, capture.predefined_split, holdout, capture.root)
    )
    aligned = _aligned(scene, saved, camera_height, metric_input, capture.metric, gravity)
    aligned = checked_world(aligned, str(path))
    matching = [file for files in capture.ambiguous.values() for file in files]
    unused = unused_findings(aligned, capture.views, matching)
    odd = (*aligned.findings, *sidecar_findings(aligned), *unused)
    # What concerns no single file concerns the capture.
    odd = (each if each.file else replace(each, file=str(path)) for each in odd)
    return replace(aligned, findings=without_repeats(odd))


def check_flags(
    camera_height: float | None,
    metric_input: bool,
    frames: str | tuple[int, int] | None,
    label_space: str | None,
) -> None:
    """Check what `read_scene` is asked for, without a capture.

    Raises:
        UserError: A value is out of range or unknown, or two exclude each other.
    """
    if camera_height is not None and not 0 < camera_height <= MAX_CAMERA_HEIGHT:
        raise UserError(
            f"The camera height {camera_height:g} m must be above 0 and at most"
            f" {MAX_CAMERA_HEIGHT:g} m; correct it."
        )
    if camera_height is not None and metric_input:
        raise UserError("Give either the camera height or metric input, not both.")
    if frames is not None:
        parse_frames(frames)
    if label_space is not None:
        checked_label_space(label_space, "--label-space")


def _aligned(
    scene: Scene,
    saved: Scene | None,
    camera_height: float | None,
    metric_input: bool,
    metric_capture: bool,
    gravity: Mapping[str, Sequence[float]] | None,
) -> Scene:
    """Return the scene in the world frame: that of a saved scene, or a new one."""
    if saved is not None and not metric_input:
        # Keep the saved alignment: it may rest on GPS or gravity, which the images lack.
        aligned = replace(
            saved,
            cameras=scene.cameras,
            views=scene.views,
            points=scene.points,
            findings=_merged(saved.findings, scene.findings),
            label_space=scene.label_space,
        )
        if camera_height is None:
            return aligned
        if (rescaled := rescale_by_camera_height(aligned, camera_height)) is not None:
            return rescaled
    # An explicit camera height takes precedence over the scale of a metric format.
    metric_input |= metric_capture and camera_height is None
    return align_scene(
        scene, camera_height=camera_height, metric_input=metric_input, gravity=gravity
    )


def _merged(saved: tuple[Finding, ...], new: tuple[Finding, ...]) -> tuple[Finding, ...]:
    """Return saved findings, each code replaced by the new ones of the same code."""
    codes = {each.code for each in new}
    return without_repeats((*(each for each in saved if each.code not in codes), *new))


def _capture_from_scene(scene: Scene, path: Path) -> Capture:
    """Return a saved scene as a capture, with its cameras and poses checked."""
    cameras = tuple(checked_camera(c, str(path)) for c in scene.cameras)
    views = tuple(replace(v, c2w=checked_pose(v.c2w, v.name, str(path))) for v in scene.views)
    return Capture(
        scene.root,
        scene.source,
        cameras,
        views,
        scene.points,
        predefined_split=True,
        label_space=scene.label_space,
        depth_scale=scene.depth_scale,
    )


def _read_capture(path: Path, frames: tuple[int, int] | None) -> Capture:
    """Detect the format and read it; `scene.json` is handled before."""
    if path.is_file() and path.suffix.lower() != ".json":
        raise UserError(f"{path} is not a folder or a .json file; give the folder of a capture.")
    if transforms_files(path):
        return read_transforms(path)
    if path.is_dir() and model_folders(path):
        return read_colmap(path)
    if is_tanks_temples(path):
        return read_tanks_temples(path)
    if kitti360_root(path):
        return read_kitti360(path, frames)
    if is_mega_nerf(path):
        return read_mega_nerf(path)
    if path.is_dir():
        models = (
            f"{folder}{stem}.{suffix}"
            for folder in ("", "sparse/", "sparse/0/")
            for stem in ("cameras", "images")
            for suffix in ("bin", "txt")
        )
        for name in ("transforms.json", *SPLIT_FILES, *models):
            check_regular(path / name)
    if not any(p.is_dir() and _has_images(p) for p in (path, path / "images")):
        raise UserError(
            f"{path} contains neither images nor poses; give a folder with images/ and sparse/0/ "
            "(COLMAP), a transforms.json, or one of the data sets in docs/formats.md."
        )
    raise UserError(
        f"{path} contains images but no poses in a supported layout (scene.json, transforms.json, "
        "sparse/0/cameras.bin); run COLMAP on it first."
    )


def _has_images(folder: Path) -> bool:
    return any(p.suffix.lower() in PHOTO_SUFFIXES for p in visible(folder.iterdir()))


def _check_images(capture: Capture) -> Capture:
    """Leave out missing images, fit the cameras to the image sizes, and sort views by name."""
    findings = list(capture.findings)
    present = [v for v in capture.views if is_file(v.path)]
    absent = [v for v in capture.views if not is_file(v.path) and v.path not in capture.ambiguous]
    if len(present) < MIN_IMAGES:
        folder = capture.views[0].path.parent if capture.views else capture.root
        count = len(capture.ambiguous)
        several = f" ({counted(count, 'name')} with several matching files)" if count else ""
        raise UserError(
            f"Only {len(present)} of the {len(capture.views)} images with poses exist in {folder}; "
            f"at least {MIN_IMAGES} are needed, so restore them or correct the names{several}."
        )
    if absent:
        message = (
            f"{len(absent)} of the {len(capture.views)} images with poses are not on disk "
            f"(first: {absent[0].name}{_kind_note(absent[0].path)}); they are left out"
        )
        remedy = "restore them, or remove their poses"
        file = str(absent[0].path.parent)
        findings.append(Finding("photo-missing", message, remedy, file=file))
    present = sorted(_with_inner_names(present), key=lambda v: v.name)
    posed: set[str] = set()
    for view in present:
        if (file := os.path.normpath(view.path)) in posed:
            name = os.path.normpath(view.name)
            raise UserError(f"The image {name} has two poses; remove one of them.")
        posed.add(file)
    cameras: dict[Camera, int] = {}
    views: list[View] = []
    scaled: list[Path] = []
    transparent: list[Path] = []
    hdr: list[Path] = []
    for view in present:
        camera = capture.cameras[view.camera]
        header = read_header(view.path)
        fitted = _fit_camera(view, camera, header)
        scaled += [view.path] * (fitted != camera)
        transparent += [view.path] * header.alpha
        hdr += [view.path] * header.hdr
        views.append(replace(view, camera=cameras.setdefault(fitted, len(cameras))))
    if scaled:
        message = (
            f"{len(scaled)} images differ in size from their cameras but have the same shape;"
            " their intrinsics are scaled"
        )
        findings.append(Finding("photo-resized", message, "", "note", str(scaled[0])))
    if hdr:
        message = f"{len(hdr)} images are HDR (HLG or PQ) and are tone-mapped to sRGB"
        findings.append(Finding("photo-hdr", message, "", "note", str(hdr[0])))
    if transparent:
        message = f"{len(transparent)} images have an alpha channel, which is ignored"
        remedy = "use masks to exclude pixels"
        findings.append(Finding("photo-alpha", message, remedy, file=str(transparent[0])))
    for camera in cameras:
        error = _round_trip_error(corrected_camera(camera)[0])
        if error > MAX_ROUND_TRIP:
            message = (
                f"The lens distortion of a {camera.width}x{camera.height} camera cannot be "
                f"inverted everywhere (error {error:.1f} px near the border)"
            )
            remedy = "undistort the images if the border matters"
            findings.append(Finding("distortion-fold", message, remedy))
    return replace(capture, cameras=tuple(cameras), views=tuple(views), findings=tuple(findings))


def _kind_note(path: Path) -> str:
    kind = special_kind(path)
    return "" if kind is None else f", which is {kind} in place of a file"


def _with_inner_names(views: Sequence[View]) -> list[View]:
    """Return the views with names that lie below a folder, for photos outside the capture's.

    Names are also paths of labels and depths, so `../photos/a.jpg` and `/photos/a.jpg` become
    `a.jpg`: the path below the folder that all such photos are in.
    """
    outer = [v for v in views if Path(v.name).is_absolute() or ".." in Path(v.name).parts]
    if not outer:
        return list(views)
    common = os.path.commonpath([os.path.normpath(view.path.parent) for view in outer])
    inner = {v.name: Path(os.path.relpath(v.path, common)).as_posix() for v in outer}
    renamed = [replace(view, name=inner.get(view.name, view.name)) for view in views]
    return renamed if len({v.name for v in renamed}) == len(renamed) else list(views)


def _fit_camera(view: View, camera: Camera, header: Header) -> Camera:
    """Return the camera scaled to the size of the image on disk."""
    width, height = header.width, header.height
    if (width, height) == (camera.width, camera.height) or header.rotates_to_fit(camera):
        return camera
    sx, sy = width / camera.width, height / camera.height
    # Downscaling rounds each side to a whole pixel, by up to one in the smaller image.
    pixel = 1.0 / min(camera.width, camera.height, width, height)
    if abs(sx / sy - 1) > max(0.005, 1.5 * pixel):
        raise UserError(
            f"The image {view.path} has {width}x{height} pixels but its camera {camera.width}x"
            f"{camera.height}, another shape; use the images for which the poses were computed."
        )
    return camera.resized(width, height)


def _round_trip_error(camera: Camera) -> float:
    """Return the largest error, pixels, of pixel -> ray -> pixel on a coarse grid of the image."""
    x = np.linspace(0.5, camera.width - 0.5, 17)
    y = np.linspace(0.5, camera.height - 0.5, 17)
    pixels = np.stack(np.meshgrid(x, y), axis=-1)
    error = camera.project(camera.directions(pixels)) - pixels
    return float(np.nan_to_num(np.abs(error), nan=np.inf).max())


def _find_sidecars(capture: Capture) -> Capture:
    """Attach the files of `labels/`, `masks/` and `depth/` to their views.

    A sidecar is named `NAME.png` or `NAME.jpg.png`; depths may also be `.npz` or `.npy`. Incomplete
    folders give a warning.
    """
    labels, odd_labels = _sidecars(capture.root / "labels", capture.views)
    masks, odd_masks = _sidecars(capture.root / "masks", capture.views)
    suffixes = (".npz", ".npy", ".png")
    depths, odd_depths = _sidecars(capture.root / "depth", capture.views, suffixes)
    views = []
    for view, label, mask, depth in zip(capture.views, labels, masks, depths, strict=True):
        mask = view.mask_path or mask
        if mask is not None and not is_file(mask):
            raise UserError(f"The mask {mask} of {view.name} is missing; restore it.")
        label, depth = view.label_path or label, view.depth_path or depth
        views.append(replace(view, label_path=label, mask_path=mask, depth_path=depth))
    odd = (*odd_labels, *odd_masks, *odd_depths, *_sidecar_findings(capture.root, views))
    return replace(capture, views=tuple(views), findings=(*capture.findings, *odd))


def _sidecars(
    folder: Path, views: Sequence[View], suffixes: tuple[str, ...] = (".png",)
) -> tuple[list[Path | None], list[Finding]]:
    """Return the file of each view in a folder, and what is odd about their names."""
    if not folder.is_dir():
        return [None] * len(views), []
    names = [_sidecar_names(view, suffixes) for view in views]
    found = [next((p for n in each if is_file(p := folder / n)), None) for each in names]
    files, exact = FileNames(folder), set(found)
    for i, each in enumerate(names):
        # The file of another photo, whose name differs in case only, stays with that.
        if found[i] is None and (other := files.find_any(each)) is not None:
            if other in exact:
                files.respelled = {n: p for n, p in files.respelled.items() if p != other}
            else:
                found[i] = other
    return found, files.findings()


def _sidecar_names(view: View, suffixes: tuple[str, ...]) -> list[str]:
    name = Path(view.name)
    if name.is_absolute():
        return []
    stems = (name.with_suffix("").as_posix(), name.as_posix())
    return [f"{stem}{suffix}" for suffix in suffixes for stem in stems]


def _sidecar_findings(root: Path, views: Sequence[View]) -> list[Finding]:
    """Return a finding for each sidecar folder that does not cover all views."""
    out = []
    for name, paths, formats in (
        ("labels", [v.label_path for v in views], "PNG"),
        ("masks", [v.mask_path for v in views], "PNG"),
        ("depth", [v.depth_path for v in views], "NPZ, NPY or PNG"),
    ):
        count, folder = sum(path is not None for path in paths), root / name
        if count == len(views) or not folder.is_dir():
            continue
        suffixes = {*PHOTO_SUFFIXES, ".npz", ".npy"}
        if any(p.suffix.lower() in suffixes for p in visible(folder.rglob("*"), folder)):
            message = f"Only {count} of {len(views)} images have a file in {name}/"
            remedy = f"name each file after its image and store it as {formats}"
            out.append(Finding("sidecar-partial", message, remedy, file=str(folder)))
    return out


def _split(
    views: tuple[View, ...], predefined: bool, holdout: str | None, root: Path
) -> tuple[View, ...]:
    """Return the views with their split set; `holdout` as for `read_scene`."""
    if holdout is None and predefined and any(v.split == "train" for v in views):
        heldout = {v.name for v in views if v.split != "train"}
    elif holdout is None:
        heldout = {v.name for v in views[::HOLDOUT_EVERY]}
    elif holdout.strip() == "0":
        heldout = set()
    else:
        heldout = _match_names(views, [n.strip() for n in holdout.split(",") if n.strip()], root)
    remaining = len(views) - len(heldout)
    if remaining == 0:
        raise UserError("All images are held out, so none is left to fit; hold out fewer.")
    if remaining == 1:
        raise UserError("Only one image is left to fit, which gives no depth; hold out fewer.")
    return with_split(Scene(root, "", (), views), heldout).views


def _match_names(views: tuple[View, ...], names: list[str], root: Path) -> set[str]:
    """Return the names of the views given by full name, file name or stem."""
    found: set[str] = set()
    unknown = []
    for name in names:
        hits = {v.name for v in views if name in (v.name, Path(v.name).name, Path(v.name).stem)}
        found |= hits
        if not hits:
            unknown.append(name)
    if unknown or not names:
        listed = ", ".join(unknown) or "no name at all"
        raise UserError(
            f"--holdout names images that have no pose in {root}: {listed}; give names such as "
            f"{views[0].name}, or 0 for none."
        )
    return found
