"""One entry for all captures: find the format, check the pictures, split, level."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError
from climatenerf.scene.alignment.scale import rescale_by_camera_height
from climatenerf.scene.alignment.up import level
from climatenerf.scene.images import Header, picture_header
from climatenerf.scene.label_spaces import checked_label_space
from climatenerf.scene.readers.capture import Capture, checked_camera, checked_pose
from climatenerf.scene.readers.colmap import model_folders, read_colmap
from climatenerf.scene.readers.kitti360 import kitti360_root, parse_frames, read_kitti360
from climatenerf.scene.readers.mega_nerf import is_mega_nerf, read_mega_nerf
from climatenerf.scene.readers.tanks_temples import is_tanks_temples, read_tanks_temples
from climatenerf.scene.readers.transforms_json import read_transforms, transforms_files
from climatenerf.scene.scene import FILE_NAME, Scene, View, load_scene, with_split

HOLDOUT_EVERY = 8
MINIMUM_IMAGES = 3
_SUFFIXES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp"}


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
    """Read a capture of any supported format and level it.

    Args:
        path: A folder (own scene, `transforms.json`, COLMAP, Tanks and Temples, KITTI-360,
            Mega-NeRF) or a `.json` file.
        holdout: None for the capture's own split or else every 8th picture by sorted name
            (first, ninth, ...); "0" for none; or names separated by commas.
        camera_height: Height of the cameras above the ground, metres, which sets the scale.
        metric_input: The poses are in metres with z up already; they are kept as they are.
        gravity: Down in the camera's axes by picture name, where the cameras told.
        frames: First and last frame of a KITTI-360 drive, both included, as a pair or "1538:1601".
        label_space: What the numbers in the label files mean, one of `LABEL_SPACES`; None for what
            the capture says.

    Returns:
        The scene; `warnings` has what the user should know.

    Raises:
        UserError: Anything about the input that the user can mend, in one sentence.
    """
    path = Path(path).absolute()
    if not path.exists():
        raise UserError(f"{path} does not exist; give the folder of a posed capture.")
    if camera_height is not None and not (math.isfinite(camera_height) and camera_height > 0):
        raise UserError(f"The camera height {camera_height:g} m must be above 0; correct it.")
    if camera_height is not None and metric_input:
        raise UserError("Give either the camera height or metric input, not both.")
    if label_space is not None:
        checked_label_space(label_space, "--label-space")
    relevel = camera_height is not None or metric_input
    if (path / FILE_NAME).is_file() or path.name == FILE_NAME:
        scene = load_scene(path)
        where = str(path)
        cameras = tuple(checked_camera(c, where) for c in scene.cameras)
        poses = [checked_pose(v.c2w, v.name, where) for v in scene.views]
        views = tuple(replace(v, c2w=c) for v, c in zip(scene.views, poses, strict=True))
        capture = Capture(scene.root, scene.source, cameras, views, scene.points, own_split=True)
        space = label_space or scene.label_space
    else:
        scene, capture = None, _read_foreign(path, None if frames is None else parse_frames(frames))
        space = label_space or capture.label_space
    if frames is not None and (scene is not None or capture.source != "kitti360"):
        raise UserError(
            f"--frames picks frames of a KITTI-360 drive, which {path} is not; omit it."
        )
    capture = _check_images(capture)
    views = _find_extras(capture)
    capture = replace(capture, warnings=(*capture.warnings, *_unmatched(capture.root, views)))
    views = _split(views, capture.own_split, holdout, capture.root)
    kept = () if scene is None else tuple(dict.fromkeys((*scene.warnings, *capture.warnings)))
    if scene is not None and not relevel:
        return replace(
            scene, cameras=capture.cameras, views=views, warnings=kept, label_space=space
        )
    if scene is not None and camera_height is not None:
        # Up and place are known already, maybe from what the pictures no longer tell.
        changed = {"cameras": capture.cameras, "views": views, "label_space": space}
        known = replace(scene, warnings=kept, **changed)
        scaled = rescale_by_camera_height(known, camera_height)
        if scaled is not None:
            return scaled
    scene = Scene(
        root=capture.root,
        source=capture.source,
        cameras=capture.cameras,
        views=views,
        points=capture.points,
        warnings=capture.warnings,
        label_space=space,
    )
    # A height that the user gives is believed more than the data set.
    metric_input |= capture.metric and camera_height is None
    return level(scene, camera_height=camera_height, metric_input=metric_input, gravity=gravity)


def _read_foreign(path: Path, frames: tuple[int, int] | None) -> Capture:
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
    pictures = [p for p in (path, path / "images") if p.is_dir() and _has_pictures(p)]
    if not pictures:
        raise UserError(
            f"{path} holds no pictures and no poses; give a folder with images/ and sparse/0/ "
            "(COLMAP), a transforms.json, or one of the data sets in docs/formats.md."
        )
    raise UserError(
        f"{path} holds pictures but no poses in a known layout (scene.json, transforms.json, "
        "sparse/0/cameras.bin); run COLMAP on it first."
    )


def _holds_files(folder: Path) -> bool:
    return any(p.suffix.lower() in {*_SUFFIXES, ".npz", ".npy"} for p in folder.rglob("*"))


def _has_pictures(folder: Path) -> bool:
    return any(p.suffix.lower() in _SUFFIXES for p in folder.iterdir())


def _check_images(capture: Capture) -> Capture:
    """Leave out missing pictures, compare sizes with the cameras, sort by name."""
    warnings = list(capture.warnings)
    present = [v for v in capture.views if v.path.is_file()]
    missing = len(capture.views) - len(present)
    if len(present) < MINIMUM_IMAGES:
        where = capture.views[0].path.parent if capture.views else capture.root
        raise UserError(
            f"Only {len(present)} of the {len(capture.views)} pictures that the poses name are in "
            f"{where}; at least {MINIMUM_IMAGES} are needed, so restore them or correct the names."
        )
    if missing:
        first = next(v.name for v in capture.views if not v.path.is_file())
        warnings.append(
            f"{missing} of the {len(capture.views)} pictures that the poses name are not on disk "
            f"(first: {first}); they are left out."
        )
    present.sort(key=lambda v: v.name)
    for a, b in zip(present, present[1:], strict=False):
        if a.name == b.name:
            raise UserError(f"The poses name the picture {a.name} twice; remove one of them.")
    cameras: dict[Camera, int] = {}
    views, scaled, transparent = [], 0, 0
    for view in present:
        camera = capture.cameras[view.camera]
        header = picture_header(view.path)
        fitting = _fit_camera(view, camera, header)
        scaled += fitting != camera
        transparent += header.alpha
        views.append(replace(view, camera=cameras.setdefault(fitting, len(cameras))))
    if scaled:
        warnings.append(
            f"{scaled} pictures have another size than the poses say, with the same shape; their "
            "intrinsics are scaled."
        )
    if transparent:
        warnings.append(
            f"{transparent} pictures have an alpha channel, which is ignored; give masks for what "
            "is to be left out."
        )
    for camera in cameras:
        worst = _round_trip(camera)
        if worst > 0.5:
            warnings.append(
                f"The lens distortion of a {camera.width}x{camera.height} camera cannot be undone "
                f"everywhere (off by {worst:.1f} px near the border); undistort the pictures if "
                "the border matters."
            )
    return replace(capture, cameras=tuple(cameras), views=tuple(views), warnings=tuple(warnings))


def _fit_camera(view: View, camera: Camera, header: Header) -> Camera:
    """The camera scaled to the picture's real size."""
    width, height = header.width, header.height
    if (width, height) == (camera.width, camera.height) or header.rotates_to_fit(camera):
        return camera
    sx, sy = width / camera.width, height / camera.height
    # Down-scalers round each side to a whole pixel, by up to one in the smaller picture.
    slack = 1.0 / min(camera.width, camera.height, width, height)
    if abs(sx / sy - 1) > max(0.005, 1.5 * slack):
        raise UserError(
            f"The picture {view.path} has {width}x{height} pixels but its camera {camera.width}x"
            f"{camera.height}, another shape; use the pictures that were posed."
        )
    return camera.resized(width, height)


def _round_trip(camera: Camera) -> float:
    """Largest error, pixels, of pixel -> ray -> pixel over a coarse net that reaches the border."""
    x = np.linspace(0.5, camera.width - 0.5, 17)
    y = np.linspace(0.5, camera.height - 0.5, 17)
    pixels = np.stack(np.meshgrid(x, y), axis=-1)
    error = camera.project(camera.directions(pixels)) - pixels
    return float(np.nan_to_num(np.abs(error), nan=np.inf).max())


def _find_extras(capture: Capture) -> tuple[View, ...]:
    """Views with `labels/`, `masks/` and `depth/` files where they exist.

    They are called `NAME.png` or `NAME.jpg.png`; depths may be `.npz` and `.npy` too.
    """

    def find(folder: str, view: View, suffixes: tuple[str, ...] = (".png",)) -> Path | None:
        if Path(view.name).is_absolute():  # joined to a folder it would be the photo itself
            return None
        base = capture.root / folder / view.name
        for suffix in suffixes:
            for candidate in (base.with_suffix(suffix), Path(f"{base}{suffix}")):
                if candidate.is_file():
                    return candidate
        return None

    out = []
    for view in capture.views:
        label = view.label_path or find("labels", view)
        mask = view.mask_path or find("masks", view)
        depth = view.depth_path or find("depth", view, (".npz", ".npy", ".png"))
        if mask is not None and not mask.is_file():
            raise UserError(f"The mask {mask} of {view.name} is missing; restore it.")
        out.append(replace(view, label_path=label, mask_path=mask, depth_path=depth))
    return tuple(out)


def _unmatched(root: Path, views: tuple[View, ...]) -> list[str]:
    """Warns of folders whose files belong to some of the photos only, or to none."""
    out = []
    for folder, paths, kinds in (
        ("labels", [v.label_path for v in views], "PNG"),
        ("masks", [v.mask_path for v in views], "PNG"),
        ("depth", [v.depth_path for v in views], "NPZ, NPY or PNG"),
    ):
        own = sum(path is not None for path in paths)
        if own < len(views) and (root / folder).is_dir() and _holds_files(root / folder):
            out.append(
                f"{own} of {len(views)} pictures have {folder}, though there is a folder {folder}/;"
                f" a file that counts is called like its picture, and is {kinds}."
            )
    return out


def _split(
    views: tuple[View, ...], own_split: bool, holdout: str | None, root: Path
) -> tuple[View, ...]:
    if holdout is None and own_split and any(v.split == "train" for v in views):
        heldout = {v.name for v in views if v.split != "train"}
    elif holdout is None:
        heldout = {v.name for v in views[::HOLDOUT_EVERY]}
    elif holdout.strip() == "0":
        heldout = set()
    else:
        heldout = _named(views, [n.strip() for n in holdout.split(",") if n.strip()], root)
    left = len(views) - len(heldout)
    if left == 0:
        raise UserError("All pictures are held out, so none is left to fit; hold out fewer.")
    if left == 1:
        raise UserError("One picture alone, which tells no depth, is left to fit; hold out fewer.")
    return with_split(Scene(root, "", (), views), heldout).views


def _named(views: tuple[View, ...], names: list[str], root: Path) -> set[str]:
    """The views that the names mean: the full name, its last part, or that without extension."""
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
            f"--holdout names pictures that {root} has no pose for: {listed}; give names such as "
            f"{views[0].name}, or 0 for none."
        )
    return found
