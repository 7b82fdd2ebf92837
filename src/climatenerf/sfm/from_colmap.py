"""Poses that COLMAP has found before: its model and the photos, as a scene folder."""

import math
import shutil
from collections.abc import Collection
from pathlib import Path

from PIL import Image

from climatenerf.core.errors import UserError
from climatenerf.core.storage import explain, make_folder
from climatenerf.scene.readers.colmap import largest_model, read_colmap
from climatenerf.sfm.diagnose import Unposed
from climatenerf.sfm.exif import Exif, read_exif
from climatenerf.sfm.photo_import import PhotoImport, Picture
from climatenerf.sfm.photos import MIN_PHOTOS, photos_in
from climatenerf.sfm.reconstruct import Model, Progress


def import_posed(
    photos: Path, root: Path, out: Path, excluded: Collection[Path], progress: Progress
) -> tuple[PhotoImport, Model, list[Unposed]]:
    """Copies photos and model as they are into `out/images` and `out/sparse/0`.

    Args:
        photos: the folder that the model's picture names are relative to.
        root: COLMAP's folder: a model, or with `sparse/0`.
        out: folder to write into.
        excluded: folders whose pictures are no photos of the user's.
        progress: told (stage, share of it that is done).

    Returns:
        The pictures with poses, the model, and the photos that it has no pose for.

    Raises:
        UserError: no model, or its pictures are not among the photos.
    """
    if not photos.is_dir():
        raise UserError(f"{photos} is no folder; give the photos that {root} has poses for")
    model = largest_model(root)
    capture = read_colmap(model)
    for view in capture.views:
        if Path(view.name).is_absolute() or ".." in Path(view.name).parts:
            raise UserError(
                f"{model} names the picture {view.name}, which leads out of the photos' folder;"
                " run COLMAP with --image_path at the folder that holds them all"
            )
    names = [view.name for view in capture.views if (photos / view.name).is_file()]
    if len(names) < MIN_PHOTOS:
        raise UserError(
            f"{photos} has {len(names)} of the {len(capture.views)} pictures that {model} has poses"
            f" for (such as {capture.views[0].name}); give the folder that COLMAP was given"
        )
    make_folder(out / "sparse" / "0")
    try:
        for path in sorted(model.iterdir()):
            if path.stem in ("cameras", "images", "points3D") and path.is_file():
                shutil.copyfile(path, out / "sparse" / "0" / path.name)
        for index, name in enumerate(names):
            progress("photos", index / len(names))
            make_folder((out / "images" / name).parent)
            shutil.copyfile(photos / name, out / "images" / name)
    except OSError as error:
        raise explain(error, out) from error
    progress("photos", 1.0)
    pictures = tuple(_picture(photos, name) for name in names)
    lenses = {view.name: capture.cameras[view.camera] for view in capture.views}
    points = 0 if capture.points is None else len(capture.points)
    found = Model(lenses, tuple(names), (len(names),), None, points)
    known = {photos / name for name in names}
    reason, remedy = "the COLMAP model has no pose for it", "leave out --from-colmap to pose it"
    found_there = photos_in(photos, excluded)
    others = [path for path in found_there.files if path not in known]
    left = [path.relative_to(photos).as_posix() for path in others]
    unposed = [Unposed(name, name, reason, remedy, ()) for name in left]
    return PhotoImport(out / "images", pictures, {}, False, found_there.notes), found, unposed


def _picture(photos: Path, name: str) -> Picture:
    try:
        with Image.open(photos / name) as image:
            exif, size = read_exif(image), image.size
    except Exception:  # whatever is wrong with it, the scene's reader says it
        exif, size = Exif(), (0, 0)
    return Picture(name, name, *size, exif, math.nan, math.nan)
