"""Poses by structure from motion: features, matches, incremental mapping, undistortion (COLMAP).

Each stage leaves its result in the work folder, so that a run that was stopped goes on.
"""

import contextlib
import importlib.util
import shutil
import sqlite3
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError
from climatenerf.core.storage import make_folder, read_json, write_json
from climatenerf.scene.readers.colmap import read_colmap
from climatenerf.sfm.diagnose import is_pure_rotation, read_only
from climatenerf.sfm.photo_import import PhotoImport, Picture
from climatenerf.sfm.photos import MIN_PHOTOS

EXHAUSTIVE_UP_TO = 120  # photos; beyond, and for video, neighbours in time and loops are compared
OVERLAP = 10  # neighbours in time to each side
EXTRACTION_BATCH = 6  # in one call for features: the bar moves in between
TILE = 16  # pictures against as many in one call for matches
ASSUMED_FOCAL = 1.2  # over the longer side, where EXIF says nothing
MAX_RETRY_PAIRS = 10_000  # of the second chance: ten minutes or so
MAX_ATTEMPTS = 4  # of the mapper at most
MIN_AGREEMENT = 0.95  # of the observations: two models that explain as much are sound
INITIAL_ANGLE = 16.0  # degrees between the first two photos
RETRY_ANGLE = 4.0  # degrees between the first two photos, on the second try

DATABASE, CHOSEN, RESULT = "database.db", "chosen", "poses.json"  # in the work folder
NO_PYCOLMAP = 'poses need pycolmap; run `pip install "climatenerf[capture]"`'
MIN_POINTS = 30  # of a model: with fewer its poses mean nothing

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Model:
    """What structure from motion found.

    Attributes:
        lenses: the camera of each picture as it was taken in, before undistortion.
        registered: names of the pictures that have poses.
        groups: number of pictures in each connected group found, largest first.
        reprojection_error: mean, pixels; None if it is not known.
        points: number of sparse points.
    """

    lenses: dict[str, Camera]
    registered: tuple[str, ...]
    groups: tuple[int, ...]
    reprojection_error: float | None
    points: int


def load_pycolmap():
    """The module, or how to get it.

    Raises:
        UserError: it is not installed.
    """
    try:
        import pycolmap
    except ImportError as error:
        raise UserError(NO_PYCOLMAP) from error
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value  # errors are told in our words
    return pycolmap


def require_pycolmap() -> None:
    """Says how to get the module if it is not there, without loading it: it catches signals.

    Raises:
        UserError: it is not installed.
    """
    if "pycolmap" in sys.modules and sys.modules["pycolmap"] is None:
        load_pycolmap()
    if importlib.util.find_spec("pycolmap") is None:
        raise UserError(NO_PYCOLMAP)


def reconstruct(
    imported: PhotoImport, work: Path, out: Path, features: int, seed: int, progress: Progress
) -> None:
    """Poses of as many pictures as possible, the largest connected group, and flat pictures.

    COLMAP may end the process (a full disk) and does not hear Ctrl-C: see `worker`. The result is
    for `read_result`.

    Args:
        imported: the pictures.
        work: work folder, with what earlier runs left there.
        out: folder to write undistorted pictures (`images`) and their model (`sparse`) into.
        features: most features in a picture.
        seed: of all random choices.
        progress: told (stage, share of it that is done).

    Raises:
        UserError: no two pictures fit together, or all are taken from one spot.
    """
    pycolmap = load_pycolmap()
    if read_result(imported, work, features, seed) is None:
        _find_poses(pycolmap, imported, work, features, seed, progress)
    progress("undistort", 0.0)
    model = work / CHOSEN
    pycolmap.undistort_images(out, model, imported.folder, jpeg_quality=95, output_type="COLMAP")
    progress("undistort", 1.0)


def _find_poses(
    pycolmap, imported: PhotoImport, work: Path, features: int, seed: int, progress: Progress
) -> None:
    database = work / DATABASE
    _reset_if_changed(imported, database, features)
    names = names_in_order(imported)
    _import(pycolmap, imported, database)
    _extract(pycolmap, imported, database, names, features, progress)
    pairs = image_pairs(len(names), imported.is_video)
    _match(pycolmap, database, names, pairs, seed, progress)
    if is_pure_rotation(imported, database):
        raise UserError(
            "all pictures were taken from one spot: they differ by turning the camera alone and"
            " hold no depth; walk around the place and take each photo a step further"
        )
    (work / RESULT).unlink(missing_ok=True)
    models = _map(pycolmap, imported, database, work / "models", seed, progress)
    best = max(models, key=lambda m: m.num_reg_images())
    more = retry_pairs([name in _registered(best) for name in names], pairs)
    if more:
        _match(pycolmap, database, names, more, seed, progress, "more matches")
        models = _map(pycolmap, imported, database, work / "models", seed, progress)
        best = max(models, key=lambda m: m.num_reg_images())
    shutil.rmtree(work / CHOSEN, ignore_errors=True)
    best.write(make_folder(work / CHOSEN))
    result = {
        "made_of": _inputs(imported, features, seed),
        "groups": group_sizes([_registered(model) for model in models]),
        "reprojection_error": float(best.compute_mean_reprojection_error()),
        "points": best.num_points3D(),
    }
    write_json(work / RESULT, result)


def names_in_order(imported: PhotoImport) -> list[str]:
    """Names of the pictures in the order they were taken, where all know it, else by name."""
    pictures = imported.pictures
    if all(picture.exif.taken for picture in pictures):
        pictures = sorted(pictures, key=lambda picture: (picture.exif.taken, picture.name))
    return [picture.name for picture in pictures]


def _registered(model) -> set[str]:
    return {model.image(i).name for i in model.reg_image_ids()}


def group_sizes(models: list[set[str]]) -> list[int]:
    """Pictures in the largest model, then those that each further one has beyond the larger ones.

    The mapper tries again with pictures that it has placed; a group is what no larger one holds.
    """
    seen: set[str] = set()
    sizes = []
    for names in sorted(models, key=len, reverse=True):
        if len(names - seen) >= MIN_PHOTOS:
            sizes.append(len(names - seen))
        seen |= names
    return sizes


def read_result(imported: PhotoImport, work: Path, features: int, seed: int) -> Model | None:
    """What a run over the same pictures with the same settings has found; None if none has."""
    try:
        result = read_json(work / RESULT)
        if (
            result["made_of"] != _inputs(imported, features, seed)
            or not (work / DATABASE).is_file()
        ):
            return None
        posed = read_colmap(work / CHOSEN)
        return Model(
            lenses={view.name: posed.cameras[view.camera] for view in posed.views},
            registered=tuple(sorted(view.name for view in posed.views)),
            groups=tuple(int(count) for count in result["groups"]),
            reprojection_error=float(result["reprojection_error"]),
            points=int(result["points"]),
        )
    except (UserError, KeyError, TypeError, ValueError):
        return None  # none yet, or damaged: found anew


def _inputs(imported: PhotoImport, features: int, seed: int) -> dict:
    return {"pictures": _stamps(imported), "features": features, "seed": seed}


def _stamps(imported: PhotoImport) -> dict[str, int]:
    """When each picture was written: a changed photo makes a new one."""
    return {p.name: (imported.folder / p.name).stat().st_mtime_ns for p in imported.pictures}


def _reset_if_changed(imported: PhotoImport, database: Path, features: int) -> None:
    """Begins anew where a picture was replaced or taken away, or other features are wanted.

    Pictures that have come in are added to what is there.
    """
    record = database.with_name("database.json")
    stamps = _stamps(imported)
    kept = False
    with contextlib.suppress(UserError, ValueError, KeyError, AttributeError):
        before = read_json(record)
        kept = all(stamps.get(name) == stamp for name, stamp in before["pictures"].items())
        kept &= before["features"] == features
    if not kept:
        for path in [database, *database.parent.glob(f"{database.name}-*")]:
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(True)
    write_json(record, {"features": features, "pictures": stamps})


def camera_groups(pictures: tuple[Picture, ...]) -> list[list[Picture]]:
    """Pictures that one camera and lens took in one size: they share intrinsics."""
    groups: dict[tuple, list[Picture]] = {}
    for picture in pictures:
        focal = None if picture.exif.focal is None else round(picture.exif.focal, 3)
        key = (picture.exif.camera, focal, picture.width, picture.height)
        groups.setdefault(key, []).append(picture)
    return list(groups.values())


def _import(pycolmap, imported: PhotoImport, database: Path) -> None:
    known = set(_names(database))
    if not database.exists():
        pycolmap.Database.open(database).close()
    for group in camera_groups(imported.pictures):
        new = [picture.name for picture in group if picture.name not in known]
        if not new:
            continue
        options = pycolmap.ImageReaderOptions()
        options.camera_model = "SIMPLE_RADIAL"
        options.default_focal_length_factor = ASSUMED_FOCAL
        first = group[0]
        if first.exif.focal is not None:
            focal = first.exif.focal * max(first.width, first.height)
            options.camera_params = f"{focal:.3f},{first.width / 2},{first.height / 2},0"
        pycolmap.import_images(database, imported.folder, pycolmap.CameraMode.SINGLE, new, options)


def _extract(
    pycolmap,
    imported: PhotoImport,
    database: Path,
    names: list[str],
    features: int,
    progress: Progress,
) -> None:
    options = pycolmap.FeatureExtractionOptions()
    options.sift.max_num_features = features
    for start in range(0, len(names), EXTRACTION_BATCH):
        progress("features", start / len(names))
        some = names[start : start + EXTRACTION_BATCH]
        pycolmap.extract_features(database, imported.folder, some, extraction_options=options)
    progress("features", 1.0)


def image_pairs(n: int, is_video: bool) -> list[tuple[int, int]]:
    """Which pictures are compared: all with all, or in long sequences neighbours and loops.

    Neighbours are those up to `OVERLAP` apart, and 16, 32, ... apart; every tenth picture is
    compared with every tenth, which closes loops without a vocabulary to download.
    """
    if n <= EXHAUSTIVE_UP_TO and not is_video:
        return [(i, j) for i in range(n) for j in range(i + 1, n)]
    steps = [*range(1, OVERLAP + 1), 16, 32]
    near = {(i, i + step) for i in range(n) for step in steps if i + step < n}
    some = range(0, n, OVERLAP)
    return sorted(near | {(i, j) for i in some for j in some if i < j})


def retry_pairs(posed: list[bool], done: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Pictures without pose with all others, as far as they were not compared: a second chance."""
    known = set(done)
    n = len(posed)
    every = ((i, j) for i in range(n) for j in range(i + 1, n) if not (posed[i] and posed[j]))
    more = [pair for pair in every if pair not in known]
    return more[:: -(-len(more) // MAX_RETRY_PAIRS)] if more else []


def _match(
    pycolmap,
    database: Path,
    names: list[str],
    pairs: list[tuple[int, int]],
    seed: int,
    progress: Progress,
    stage: str = "matches",
) -> None:
    pycolmap.set_random_seed(seed)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    # Tile by tile, so that a picture's features are read once for many comparisons.
    tiles: dict[tuple[int, int], list[str]] = {}
    for i, j in pairs:
        key = (i // TILE, j // TILE)
        tiles.setdefault(key, []).append(f"{names[i]} {names[j]}")
    done = 0
    listing = database.with_name("pairs.txt")
    for key in sorted(tiles):
        progress(stage, done / len(pairs))
        listing.write_text("\n".join(tiles[key]) + "\n")
        options = pycolmap.ImportedPairingOptions()
        options.match_list_path = listing
        pycolmap.match_image_pairs(
            database, pairing_options=options, verification_options=verification
        )
        done += len(tiles[key])
    progress(stage, 1.0)


def _map(
    pycolmap, imported: PhotoImport, database: Path, folder: Path, seed: int, progress: Progress
) -> list:
    """Incremental mapping, several times: one wrong link bends a whole model, but not in each.

    A bent model explains fewer of the matches, so the one with most observations is taken as soon
    as another agrees with it. Where nothing comes out a smaller baseline is accepted.
    """
    for least_angle in (INITIAL_ANGLE, RETRY_ANGLE):
        tries: list[tuple[int, list]] = []
        for number in range(MAX_ATTEMPTS):
            start = seed + number
            found = _map_once(
                pycolmap, imported, database, folder, start, least_angle, progress, number
            )
            good = [
                m
                for m in found.values()
                if m.num_reg_images() >= MIN_PHOTOS and m.num_points3D() >= MIN_POINTS
            ]
            best = max((m.compute_num_observations() for m in good), default=0)
            tries.append((best, good))
            ranked = sorted((count for count, _ in tries), reverse=True)
            if len(ranked) > 1 and ranked[1] >= MIN_AGREEMENT * ranked[0]:
                break
        best, good = max(tries, key=lambda one: one[0])
        if best:
            return good
    raise UserError(
        "no three of the pictures fit together: they show too little in common, are blurred, or"
        " were taken from nearly one spot; walk around the place and take each photo a step"
        " further, with two thirds of the view in common"
    )


def _map_once(
    pycolmap,
    imported: PhotoImport,
    database: Path,
    folder: Path,
    seed: int,
    least_angle: float,
    progress: Progress,
    number: int,
) -> dict:
    pycolmap.set_random_seed(seed)
    shutil.rmtree(folder, ignore_errors=True)
    make_folder(folder)
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = seed
    options.mapper.random_seed = seed
    options.min_model_size = MIN_PHOTOS
    options.mapper.init_min_tri_angle = least_angle
    # It places pictures that share hardly a point with the rest, and places some of them wrongly.
    options.structure_less_registration_fallback = False
    placed, stage = 0, f"poses, try {number + 1}"

    def one_more() -> None:
        nonlocal placed
        placed += 1
        progress(stage, min(0.99, placed / len(imported.pictures)))

    found = pycolmap.incremental_mapping(
        database, imported.folder, folder, options, next_image_callback=one_more
    )
    progress(stage, 1.0)
    return found


def _names(database: Path) -> list[str]:
    if not database.is_file():
        return []
    try:
        with contextlib.closing(read_only(database)) as connection:
            return [row[0] for row in connection.execute("SELECT name FROM images")]
    except sqlite3.Error:
        database.unlink()  # half written: begun anew
        return []
