"""Import an existing COLMAP model and its photos into a scene folder."""

import math
import shutil
from collections.abc import Collection
from pathlib import Path

from climatenerf.core.errors import UserError
from climatenerf.core.storage import explain, make_folder
from climatenerf.scene.image_files import open_image
from climatenerf.scene.readers.colmap import largest_model, read_colmap
from climatenerf.sfm.diagnose import Unposed
from climatenerf.sfm.exif import Exif, read_exif
from climatenerf.sfm.photo_import import PhotoImport, Picture
from climatenerf.sfm.photos import MIN_PHOTOS, photos_in
from climatenerf.sfm.reconstruct import Model, Progress


def import_posed(
    photos: Path, root: Path, out: Path, excluded: Collection[Path], progress: Progress
) -> tuple[PhotoImport, Model, list[Unposed]]:
    """Copy the photos and the model unchanged into `out/images` and `out/sparse/0`.

    Args:
        photos: folder to which the picture names of the model are relative.
        root: a COLMAP model, or a folder with `sparse/0`.
        out: folder to write to.
        excluded: folders whose pictures are not photos of the user.
        progress: callback with (stage, finished fraction of the stage).

    Returns:
        The pictures with poses, the model, and the photos without pose.

    Raises:
        UserError: there is no model, or its pictures are not among the photos.
    """
    if not photos.is_dir():
        raise UserError(f"{photos} is not a folder; give the folder of the photos in {root}")
    model = largest_model(root)
    capture = read_colmap(model)
    for view in capture.views:
        if Path(view.name).is_absolute() or ".." in Path(view.name).parts:
            raise UserError(
                f"{model} names the picture {view.name}, which is outside the folder of photos;"
                " run COLMAP with an --image_path that contains all of them"
            )
    names = [view.name for view in capture.views if (photos / view.name).is_file()]
    if len(names) < MIN_PHOTOS:
        raise UserError(
            f"{photos} contains {len(names)} of the {len(capture.views)} pictures of {model}"
            f" (such as {capture.views[0].name}); give COLMAP's --image_path"
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
    reconstruction = Model(lenses, tuple(names), (len(names),), None, points)
    posed = {photos / name for name in names}
    reason, remedy = "it is not in the COLMAP model", "omit --from-colmap to compute its pose"
    present = photos_in(photos, excluded)
    others = [path for path in present.files if path not in posed]
    other_names = [path.relative_to(photos).as_posix() for path in others]
    unposed = [Unposed(name, name, reason, remedy, ()) for name in other_names]
    return PhotoImport(out / "images", pictures, {}, False, present.notes), reconstruction, unposed


def _picture(photos: Path, name: str) -> Picture:
    try:
        with open_image(photos / name) as image:
            exif, size = read_exif(image), image.size
    except Exception:  # the reader of the scene reports any damage
        exif, size = Exif(), (0, 0)
    return Picture(name, name, *size, exif, math.nan, math.nan)
