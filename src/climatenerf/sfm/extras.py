"""Labels, masks and depths that the user has for the photos, brought into the scene's pictures.

The scene's pictures are upright and without lens distortion, the photos are not: each file is
turned as its photo was, and looked up pixel by pixel through the photo's lens (nearest neighbours,
since a class or a depth between two others means nothing).
"""

import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from climatenerf.errors import UserError
from climatenerf.scene.cameras import Camera
from climatenerf.scene.images import read_depth, read_labels, read_mask
from climatenerf.scene.scene import Scene, View
from climatenerf.storage import atomic_path, make_folder

SUFFIXES = {"labels": (".png",), "masks": (".png",), "depth": (".npz", ".npy", ".png")}
READERS = {"labels": read_labels, "masks": read_mask, "depth": read_depth}
OUTSIDE = {"labels": 255, "masks": 0, "depth": np.nan}  # where the photo does not reach
FIELDS = {"labels": "label_path", "masks": "mask_path", "depth": "depth_path"}
SAME_SHAPE = 0.02  # relative difference of two pictures' width over height


def bring_along(
    scene: Scene,
    kind: str,
    folder: Path,
    sources: Mapping[str, str],
    lenses: Mapping[str, Camera],
    orientations: Mapping[str, int],
) -> Scene:
    """The scene with the user's files of one kind for its views.

    Args:
        scene: whose `root` the files are written into.
        kind: "labels", "masks" or "depth".
        folder: the user's files, named like the photos: `A/IMG_1.png` or `A/IMG_1.jpg.png`.
        sources: the photo of each view, as a path relative to the photos' folder.
        lenses: the camera of each view's photo as shown, before undistortion.
        orientations: EXIF orientation of each photo.

    Raises:
        UserError: no such folder, no file for any view, or a file that cannot be used.
    """
    if not folder.is_dir():
        raise UserError(f"--{kind} {folder} is no folder; give the folder of the files")
    found = {view.name: _find(folder, kind, sources[view.name], view.name) for view in scene.views}
    if not any(found.values()):
        wanted = Path(sources[scene.views[0].name]).with_suffix(SUFFIXES[kind][0])
        raise UserError(
            f"--{kind} {folder} holds nothing for any photo; name the files like {wanted}"
        )
    out = scene.root / kind
    shutil.rmtree(out, ignore_errors=True)
    make_folder(out)
    views = []
    for view in scene.views:
        path = found[view.name]
        if path is None:
            views.append(view)
            continue
        values = _as_shown(READERS[kind](path), lenses[view.name], orientations[view.name], path)
        values = _through_lens(values, lenses[view.name], scene.cameras[view.camera], OUTSIDE[kind])
        views.append(replace(view, **{FIELDS[kind]: _write(out, kind, view, values)}))
    missing = sum(path is None for path in found.values())
    told = (f"{missing} of {len(views)} pictures have no {kind}.",) if missing else ()
    return replace(scene, views=tuple(views), warnings=(*scene.warnings, *told))


def _find(folder: Path, kind: str, source: str, name: str) -> Path | None:
    for base in (Path(source), Path(source).name, Path(name)):
        for suffix in SUFFIXES[kind]:
            for candidate in (folder / base).with_suffix(suffix), folder / f"{base}{suffix}":
                if candidate.is_file():
                    return candidate
    return None


def _as_shown(values: np.ndarray, lens: Camera, orientation: int, path: Path) -> np.ndarray:
    """The file turned as its photo is shown, if only so it has the photo's shape."""
    shape = lens.width / lens.height
    if abs(values.shape[1] / values.shape[0] / shape - 1) < SAME_SHAPE:
        return values
    turned = {5: values.T, 6: np.rot90(values, -1), 7: np.rot90(values, 2).T, 8: np.rot90(values)}
    if orientation in turned and abs(values.shape[0] / values.shape[1] / shape - 1) < SAME_SHAPE:
        return turned[orientation]
    raise UserError(
        f"{path} has {values.shape[1]}x{values.shape[0]} pixels, another shape than its photo"
        f" ({lens.width}x{lens.height}); make it from the whole photo"
    )


def _through_lens(values: np.ndarray, lens: Camera, target: Camera, outside: float) -> np.ndarray:
    """Values at the target camera's pixels, looked up in a file for the other lens' picture."""
    scale = np.array([values.shape[1] / lens.width, values.shape[0] / lens.height])
    at = target.pixel_centres() if lens == target else lens.project(target.directions())
    inside = (at >= 0).all(-1) & (at[..., 0] < lens.width) & (at[..., 1] < lens.height)
    x, y = (np.where(inside[..., None], at, 0.0) * scale).astype(np.int64).T
    found = values[np.minimum(y, len(values) - 1), np.minimum(x, values.shape[1] - 1)].T
    return np.where(inside, found, np.array(outside).astype(values.dtype))


def _write(folder: Path, kind: str, view: View, values: np.ndarray) -> Path:
    path = (folder / view.name).with_suffix(".npz" if kind == "depth" else ".png")
    make_folder(path.parent)
    with atomic_path(path) as temporary:
        if kind == "depth":
            with temporary.open("wb") as file:
                np.savez_compressed(file, depth=values.astype(np.float32))
        else:
            values = np.where(values, np.uint8(255), np.uint8(0)) if kind == "masks" else values
            Image.fromarray(values).save(temporary, format="PNG")
    return path
