"""Labels, masks and depths that the user has for the photos, brought into the scene's pictures.

The scene's pictures are upright and without lens distortion, the photos are not: each file is
turned as its photo was, and looked up pixel by pixel through the photo's lens (nearest neighbours,
since a class or a depth between two others means nothing).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError
from climatenerf.core.storage import atomic_path, make_folder
from climatenerf.scene.images import read_depth, read_labels, read_mask
from climatenerf.scene.scene import Scene, View

SUFFIXES = {"labels": (".png",), "masks": (".png",), "depth": (".npz", ".npy", ".png")}
READERS = {"labels": read_labels, "masks": read_mask, "depth": read_depth}
OUTSIDE = {"labels": 255, "masks": 0, "depth": np.nan}  # where the photo does not reach
FIELDS = {"labels": "label_path", "masks": "mask_path", "depth": "depth_path"}
SAME_SHAPE = 0.02  # relative difference of two pictures' width over height


@dataclass(frozen=True)
class Photo:
    """The photo that a view comes from.

    Attributes:
        source: path relative to the photos' folder.
        lens: its camera, before undistortion.
        orientation: EXIF's tag, 1 to 8.
        shown: whether the lens is that of the picture as shown, not as stored.
    """

    source: str
    lens: Camera
    orientation: int
    shown: bool


def import_sidecars(scene: Scene, kind: str, folder: Path, photos: Mapping[str, Photo]) -> Scene:
    """The scene with the user's files of one kind for its views, written into its folder.

    Args:
        scene: whose `root` has none of this kind yet.
        kind: "labels", "masks" or "depth".
        folder: the user's files, named like the photos: `A/IMG_1.png` or `A/IMG_1.jpg.png`.
        photos: of each view, by its name.

    Raises:
        UserError: no file for any view, or a file that cannot be used.
    """
    found = {v.name: _find_file(folder, kind, photos[v.name].source, v.name) for v in scene.views}
    if not any(found.values()):
        wanted = Path(photos[scene.views[0].name].source).with_suffix(SUFFIXES[kind][0])
        raise UserError(
            f"--{kind} {folder} holds nothing for any photo; name the files like {wanted}"
        )
    values = {name: READERS[kind](path) for name, path in found.items() if path is not None}
    as_stored, sure = _infer_stored(values, photos)
    views = []
    for view in scene.views:
        if view.name in values:
            photo = photos[view.name]
            one = _to_lens_frame(values.pop(view.name), photo, as_stored, found[view.name])
            one = _resample(one, photo.lens, scene.cameras[view.camera], OUTSIDE[kind])
            view = replace(view, **{FIELDS[kind]: _write(scene.root / kind, kind, view, one)})
        views.append(view)
    warnings = list(scene.warnings)
    missing = sum(path is None for path in found.values())
    if missing:
        warnings.append(f"{missing} of {len(views)} pictures have no {kind}.")
    if not sure:
        warnings.append(
            f"Some photos are turned by half or mirrored by their EXIF; their {kind} are taken to"
            " be made of the photos as shown, not as stored: look at them."
        )
    return replace(scene, views=tuple(views), warnings=tuple(warnings))


def _infer_stored(
    values: Mapping[str, np.ndarray], photos: Mapping[str, Photo]
) -> tuple[bool, bool]:
    """Whether files are of photos as stored, told by the shapes of those on edge; and if surely."""
    stored = shown = 0
    for name, one in values.items():
        photo = photos[name]
        if photo.orientation >= 5 and photo.lens.width != photo.lens.height:
            same = _same_shape(one, photo.lens)
            stored += same != photo.shown
            shown += same == photo.shown
    unclear = any(photos[name].orientation in (2, 3, 4) for name in values)
    return stored > shown, bool(stored or shown) or not unclear


def _same_shape(values: np.ndarray, lens: Camera) -> bool:
    stretch = values.shape[1] * lens.height / (values.shape[0] * lens.width)
    return abs(stretch - 1) < SAME_SHAPE


def _to_lens_frame(
    values: np.ndarray, photo: Photo, as_stored: bool, path: Path | None
) -> np.ndarray:
    """The file in the frame of the photo's lens."""
    on_edge = photo.orientation >= 5
    if on_edge and photo.lens.width != photo.lens.height:
        as_stored = _same_shape(values, photo.lens) != photo.shown
    if as_stored and photo.shown:
        values = orient(values, photo.orientation)
    elif not as_stored and not photo.shown:
        values = orient(values, {6: 8, 8: 6}.get(photo.orientation, photo.orientation))
    if not _same_shape(values, photo.lens):
        raise UserError(
            f"{path} has {values.shape[1]}x{values.shape[0]} pixels, another shape than its photo"
            f" ({photo.lens.width}x{photo.lens.height}); make it from the whole photo"
        )
    return values


def orient(values: np.ndarray, orientation: int) -> np.ndarray:
    """An array of stored pixels as EXIF's tag wants it shown."""
    turns = {
        2: np.fliplr, 3: lambda a: np.rot90(a, 2), 4: np.flipud, 5: np.transpose,
        6: lambda a: np.rot90(a, -1), 7: lambda a: np.rot90(a, 2).T, 8: np.rot90,
    }  # fmt: skip
    return turns[orientation](values) if orientation in turns else values


def _find_file(folder: Path, kind: str, source: str, name: str) -> Path | None:
    for base in (Path(source), Path(source).name, Path(name)):
        for suffix in SUFFIXES[kind]:
            for candidate in (folder / base).with_suffix(suffix), folder / f"{base}{suffix}":
                if candidate.is_file():
                    return candidate
    return None


def _resample(values: np.ndarray, lens: Camera, target: Camera, outside: float) -> np.ndarray:
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
