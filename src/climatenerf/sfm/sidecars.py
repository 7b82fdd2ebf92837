"""Import the user's labels, masks and depths for photos as sidecars of the scene's pictures.

The scene's pictures are upright and undistorted, the photos are not. Each file is rotated like its
photo and resampled through the photo's lens. Sampling is nearest-neighbour, since classes and
depths must not be interpolated.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError
from climatenerf.core.storage import atomic_path, make_folder
from climatenerf.scene.findings import Finding
from climatenerf.scene.images import read_depth, read_labels, read_mask
from climatenerf.scene.scene import Scene, View

SUFFIXES = {"labels": (".png",), "masks": (".png",), "depth": (".npz", ".npy", ".png")}
READERS = {"labels": read_labels, "masks": read_mask, "depth": read_depth}
OUTSIDE = {"labels": 255, "masks": 0, "depth": np.nan}  # value outside the photo
FIELDS = {"labels": "label_path", "masks": "mask_path", "depth": "depth_path"}
SAME_SHAPE = 0.02  # largest relative difference of the aspect ratios of two equal shapes


@dataclass(frozen=True)
class Photo:
    """The photo behind a view.

    Attributes:
        source: path relative to the folder of photos.
        lens: camera of the photo, before undistortion.
        orientation: EXIF orientation, 1 to 8.
        as_displayed: True if `lens` describes the picture as displayed, False if as stored.
    """

    source: str
    lens: Camera
    orientation: int
    as_displayed: bool


def import_sidecars(scene: Scene, kind: str, folder: Path, photos: Mapping[str, Photo]) -> Scene:
    """Write the user's files of one kind into a scene's folder and return the scene with them.

    Args:
        scene: the scene; its `root` has no files of this kind yet.
        kind: "labels", "masks" or "depth".
        folder: the user's files, named like the photos: `A/IMG_1.png` or `A/IMG_1.jpg.png`.
        photos: the photo of each view, by the view's name.

    Raises:
        UserError: no file for any view, or a file that cannot be used.
    """
    found = {v.name: _find_file(folder, kind, photos[v.name].source, v.name) for v in scene.views}
    if not any(found.values()):
        wanted = Path(photos[scene.views[0].name].source).with_suffix(SUFFIXES[kind][0])
        raise UserError(
            f"--{kind} {folder} contains no file for any photo; name the files like {wanted}"
        )
    values = {name: READERS[kind](path) for name, path in found.items() if path is not None}
    as_stored, certain = _infer_stored(values, photos)
    views = []
    for view in scene.views:
        if view.name in values:
            photo = photos[view.name]
            sidecar = _to_lens_frame(values.pop(view.name), photo, as_stored, found[view.name])
            sidecar = _resample(sidecar, photo.lens, scene.cameras[view.camera], OUTSIDE[kind])
            view = replace(view, **{FIELDS[kind]: _write(scene.root / kind, kind, view, sidecar)})
        views.append(view)
    findings = list(scene.findings)
    missing = sum(path is None for path in found.values())
    if missing:
        message = f"{missing} of {len(views)} pictures have no {kind}"
        remedy = "name each file after its photo"
        findings.append(Finding("sidecar-partial", message, remedy, file=str(folder)))
    if not certain:
        findings.append(
            Finding(
                "sidecar-orientation",
                f"EXIF rotates some photos by 180 degrees or mirrors them. Their {kind} are assumed"
                " to match the photos as shown, not as stored",
                "check them",
                file=str(folder),
            )
        )
    return replace(scene, views=tuple(views), findings=tuple(findings))


def _infer_stored(
    values: Mapping[str, np.ndarray], photos: Mapping[str, Photo]
) -> tuple[bool, bool]:
    """Infer from shapes whether the files match the photos as stored; and whether that is certain.

    Only photos that EXIF rotates by 90 degrees show the difference in the shape of their file.
    """
    stored = displayed = 0
    for name, sidecar in values.items():
        photo = photos[name]
        if photo.orientation >= 5 and photo.lens.width != photo.lens.height:
            same = _same_shape(sidecar, photo.lens)
            stored += same != photo.as_displayed
            displayed += same == photo.as_displayed
    ambiguous = any(photos[name].orientation in (2, 3, 4) for name in values)
    return stored > displayed, bool(stored or displayed) or not ambiguous


def _same_shape(values: np.ndarray, lens: Camera) -> bool:
    stretch = values.shape[1] * lens.height / (values.shape[0] * lens.width)
    return abs(stretch - 1) < SAME_SHAPE


def _to_lens_frame(
    values: np.ndarray, photo: Photo, as_stored: bool, path: Path | None
) -> np.ndarray:
    """Rotate a file's values to the pixel axes of the photo's lens.

    Raises:
        UserError: the file has another aspect ratio than the photo.
    """
    quarter_turn = photo.orientation >= 5
    if quarter_turn and photo.lens.width != photo.lens.height:
        as_stored = _same_shape(values, photo.lens) != photo.as_displayed
    if as_stored and photo.as_displayed:
        values = orient(values, photo.orientation)
    elif not as_stored and not photo.as_displayed:
        values = orient(values, {6: 8, 8: 6}.get(photo.orientation, photo.orientation))
    if not _same_shape(values, photo.lens):
        raise UserError(
            f"{path} has {values.shape[1]}x{values.shape[0]} pixels, but its photo has another"
            f" aspect ratio ({photo.lens.width}x{photo.lens.height} pixels); make the file from the"
            " whole photo"
        )
    return values


def orient(values: np.ndarray, orientation: int) -> np.ndarray:
    """Return an array of stored pixels [h, w] as shown by the EXIF orientation."""
    operations = {
        2: np.fliplr, 3: lambda a: np.rot90(a, 2), 4: np.flipud, 5: np.transpose,
        6: lambda a: np.rot90(a, -1), 7: lambda a: np.rot90(a, 2).T, 8: np.rot90,
    }  # fmt: skip
    return operations[orientation](values) if orientation in operations else values


def _find_file(folder: Path, kind: str, source: str, name: str) -> Path | None:
    """Return the file of a view: named like its photo, with or without folders, or the view."""
    for base in (Path(source), Path(source).name, Path(name)):
        for suffix in SUFFIXES[kind]:
            for candidate in (folder / base).with_suffix(suffix), folder / f"{base}{suffix}":
                if candidate.is_file():
                    return candidate
    return None


def _resample(values: np.ndarray, lens: Camera, target: Camera, outside: float) -> np.ndarray:
    """Resample values [h, w] of the lens' picture at the target camera's pixels, nearest."""
    scale = np.array([values.shape[1] / lens.width, values.shape[0] / lens.height])
    pixel = target.pixel_centres() if lens == target else lens.project(target.directions())
    inside = (pixel >= 0).all(-1) & (pixel[..., 0] < lens.width) & (pixel[..., 1] < lens.height)
    x, y = (np.where(inside[..., None], pixel, 0.0) * scale).astype(np.int64).T
    sampled = values[np.minimum(y, len(values) - 1), np.minimum(x, values.shape[1] - 1)].T
    return np.where(inside, sampled, np.array(outside).astype(values.dtype))


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
