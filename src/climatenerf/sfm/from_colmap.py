"""Poses that COLMAP has found before: its model and the photos, as a scene folder."""

import math
import shutil
from pathlib import Path

from PIL import Image

from climatenerf.errors import UserError
from climatenerf.scene.colmap import largest_model, read_colmap
from climatenerf.sfm.diagnose import Lost
from climatenerf.sfm.exif import Exif, read_exif
from climatenerf.sfm.intake import FEWEST, PHOTO_SUFFIXES, Intake, Picture
from climatenerf.sfm.reconstruct import Model, Told
from climatenerf.storage import explain, make_folder


def take_posed(photos: Path, root: Path, out: Path, tell: Told) -> tuple[Intake, Model, list[Lost]]:
    """Copies photos and model as they are into `out/images` and `out/sparse/0`.

    Args:
        photos: the folder that the model's picture names are relative to.
        root: COLMAP's folder: a model, or with `sparse/0`.
        out: scene folder.
        tell: told (stage, share of it that is done).

    Returns:
        The pictures with poses, the model, and the photos that it has no pose for.

    Raises:
        UserError: no model, or its pictures are not among the photos.
    """
    if not photos.is_dir():
        raise UserError(f"{photos} is no folder; give the photos that {root} has poses for")
    model = largest_model(root)
    capture = read_colmap(model)
    names = [view.name for view in capture.views if (photos / view.name).is_file()]
    if len(names) < FEWEST:
        raise UserError(
            f"{photos} has {len(names)} of the {len(capture.views)} pictures that {model} has poses"
            f" for (such as {capture.views[0].name}); give the folder that COLMAP was given"
        )
    for folder in (out / "images", out / "sparse" / "0"):
        shutil.rmtree(folder, ignore_errors=True)
        make_folder(folder)
    try:
        for path in sorted(model.iterdir()):
            if path.stem in ("cameras", "images", "points3D") and path.is_file():
                shutil.copyfile(path, out / "sparse" / "0" / path.name)
        for index, name in enumerate(names):
            tell("photos", index / len(names))
            make_folder((out / "images" / name).parent)
            shutil.copyfile(photos / name, out / "images" / name)
    except OSError as error:
        raise explain(error, out) from error
    tell("photos", 1.0)
    pictures = tuple(_picture(photos, name) for name in names)
    lenses = {view.name: capture.cameras[view.camera] for view in capture.views}
    points = 0 if capture.points is None else len(capture.points)
    found = Model(out, lenses, tuple(names), (len(names),), None, points)
    return Intake(out / "images", pictures, {}, False), found, _left_out(photos, set(names))


def _picture(photos: Path, name: str) -> Picture:
    try:
        with Image.open(photos / name) as image:
            exif, size = read_exif(image), image.size
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        exif, size = Exif(), (0, 0)  # the scene's reader says what is wrong with it
    return Picture(name, name, *size, exif, math.nan, math.nan)


def _left_out(photos: Path, known: set[str]) -> list[Lost]:
    paths = sorted(p for p in photos.rglob("*") if p.suffix.lower() in PHOTO_SUFFIXES)
    names = [path.relative_to(photos).as_posix() for path in paths]
    reason, remedy = "the COLMAP model has no pose for it", "leave out --from-colmap to pose it"
    return [Lost(name, name, reason, remedy, ()) for name in names if name not in known]
