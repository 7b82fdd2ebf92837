"""Structure from motion with COLMAP: features, matches, incremental mapping, undistortion.

Each stage stores its result in the work folder, so that a repeated run resumes.
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

# Photos. Larger sets and videos match neighbours in time and loop closures only.
EXHAUSTIVE_UP_TO = 120
OVERLAP = 10  # neighbours in time on each side
EXTRACTION_BATCH = 6  # pictures per call of the feature extraction; progress is reported between
TILE = 16  # pictures per side of a block of pairs in one call of the matcher
ASSUMED_FOCAL = 1.2  # focal length over the longer side, without EXIF
MAX_RETRY_PAIRS = 10_000  # pairs of the second matching: about ten minutes
MAX_ATTEMPTS = 4  # runs of the mapper
MIN_AGREEMENT = 0.95  # ratio of the observations of two models that count as equally good
INITIAL_ANGLE = 16.0  # smallest triangulation angle of the first two photos, degrees
RETRY_ANGLE = 4.0  # the same if the first angle gives no model, degrees

DATABASE, CHOSEN, RESULT = "database.db", "chosen", "poses.json"  # in the work folder
NO_PYCOLMAP = 'computing poses needs pycolmap; run `pip install "climatenerf[capture]"`'
MIN_POINTS = 30  # sparse points of a model; poses from fewer are unreliable

Progress = Callable[[str, float], None]
"""Callback with (name of the stage, finished fraction of the stage, 0 to 1)."""


@dataclass(frozen=True)
class Model:
    """Result of structure from motion.

    Attributes:
        lenses: camera of each picture before undistortion, by name.
        registered: names of the pictures with poses.
        groups: number of pictures in each connected group, largest first.
        reprojection_error: mean over observations, pixels; None if unknown.
        points: number of sparse points.
    """

    lenses: dict[str, Camera]
    registered: tuple[str, ...]
    groups: tuple[int, ...]
    reprojection_error: float | None
    points: int


def load_pycolmap():
    """Import pycolmap and return the module.

    Raises:
        UserError: pycolmap is not installed.
    """
    try:
        import pycolmap
    except ImportError as error:
        raise UserError(NO_PYCOLMAP) from error
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value  # errors are raised as UserError
    return pycolmap


def require_pycolmap() -> None:
    """Check that pycolmap is installed, without importing it: the import replaces signal handlers.

    Raises:
        UserError: pycolmap is not installed.
    """
    if "pycolmap" in sys.modules and sys.modules["pycolmap"] is None:
        load_pycolmap()
    if importlib.util.find_spec("pycolmap") is None:
        raise UserError(NO_PYCOLMAP)


def reconstruct(
    imported: PhotoImport, work: Path, out: Path, features: int, seed: int, progress: Progress
) -> None:
    """Compute the poses of the largest connected group of pictures and undistort them.

    COLMAP may end the process (on a full disk) and ignores Ctrl-C; see `worker`. `read_result`
    returns the result.

    Args:
        imported: the pictures.
        work: work folder; results of earlier runs in it are reused.
        out: folder for the undistorted pictures (`images`) and their model (`sparse`).
        features: largest number of features per picture.
        seed: random seed.
        progress: progress callback.

    Raises:
        UserError: no pictures match, or all were taken from one position.
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
    names, pairs = match_pictures(pycolmap, imported, work, features, seed, progress)
    if is_pure_rotation(imported, database):
        raise UserError(
            "all pictures were taken from one spot: the camera only rotated, so there is no"
            " parallax; walk around the scene and take each photo a step further"
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


def match_pictures(
    pycolmap, imported: PhotoImport, work: Path, features: int, seed: int, progress: Progress
) -> tuple[list[str], list[tuple[int, int]]]:
    """Write features and verified matches to `DATABASE` in the work folder.

    Args:
        pycolmap: the module.
        imported: the pictures.
        work: work folder; results of earlier runs in it are reused.
        features: largest number of features per picture.
        seed: random seed.
        progress: progress callback.

    Returns:
        The names of the pictures in order of time, and the matched pairs of their indices.
    """
    database = work / DATABASE
    _reset_if_changed(imported, database, features)
    names = names_in_order(imported)
    _import(pycolmap, imported, database)
    _extract(pycolmap, imported, database, names, features, progress)
    pairs = image_pairs(len(names), imported.is_video)
    _match(pycolmap, database, names, pairs, seed, progress)
    return names, pairs


def names_in_order(imported: PhotoImport) -> list[str]:
    """Return the names of the pictures by time if all have one, else in alphabetical order."""
    pictures = imported.pictures
    if all(picture.exif.taken for picture in pictures):
        pictures = sorted(pictures, key=lambda picture: (picture.exif.taken, picture.name))
    return [picture.name for picture in pictures]


def _registered(model) -> set[str]:
    return {model.image(i).name for i in model.reg_image_ids()}


def group_sizes(models: list[set[str]]) -> list[int]:
    """Return the number of pictures of each model that no larger model contains, largest first.

    The mapper may register a picture in several models. Groups below `MIN_PHOTOS` are omitted.
    """
    counted: set[str] = set()
    sizes = []
    for names in sorted(models, key=len, reverse=True):
        if len(names - counted) >= MIN_PHOTOS:
            sizes.append(len(names - counted))
        counted |= names
    return sizes


def read_result(imported: PhotoImport, work: Path, features: int, seed: int) -> Model | None:
    """Return the result of an earlier run with the same pictures and settings; None if none."""
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
        return None  # missing or damaged: compute the poses again


def _inputs(imported: PhotoImport, features: int, seed: int) -> dict:
    return {"pictures": _stamps(imported), "features": features, "seed": seed}


def _stamps(imported: PhotoImport) -> dict[str, int]:
    """Return the modification time of each picture, ns: a changed photo gives a new picture."""
    return {p.name: (imported.folder / p.name).stat().st_mtime_ns for p in imported.pictures}


def _reset_if_changed(imported: PhotoImport, database: Path, features: int) -> None:
    """Delete the database if a picture was replaced or removed, or if `features` has changed.

    New pictures do not delete it; they are added.
    """
    record = database.with_name("database.json")
    stamps = _stamps(imported)
    valid = False
    with contextlib.suppress(UserError, ValueError, KeyError, AttributeError):
        before = read_json(record)
        valid = all(stamps.get(name) == stamp for name, stamp in before["pictures"].items())
        valid &= before["features"] == features
    if not valid:
        for path in [database, *database.parent.glob(f"{database.name}-*")]:
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(True)
    write_json(record, {"features": features, "pictures": stamps})


def camera_groups(pictures: tuple[Picture, ...]) -> list[list[Picture]]:
    """Group the pictures of one camera, lens and size: they share intrinsics."""
    groups: dict[tuple, list[Picture]] = {}
    for picture in pictures:
        focal = None if picture.exif.focal is None else round(picture.exif.focal, 3)
        key = (picture.exif.camera, focal, picture.width, picture.height)
        groups.setdefault(key, []).append(picture)
    return list(groups.values())


def _import(pycolmap, imported: PhotoImport, database: Path) -> None:
    present = set(_names(database))
    if not database.exists():
        pycolmap.Database.open(database).close()
    for group in camera_groups(imported.pictures):
        new = [picture.name for picture in group if picture.name not in present]
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
        batch = names[start : start + EXTRACTION_BATCH]
        pycolmap.extract_features(database, imported.folder, batch, extraction_options=options)
    progress("features", 1.0)


def image_pairs(n: int, is_video: bool) -> list[tuple[int, int]]:
    """Return the pairs of pictures to match: all pairs, or neighbours and loop closures.

    Neighbours are at most `OVERLAP` apart, or 16 or 32 apart. All pairs of every tenth picture
    close loops without a vocabulary tree, which would have to be downloaded.

    Args:
        n: number of pictures, in order of time.
        is_video: True to restrict the pairs whatever the number of pictures.
    """
    if n <= EXHAUSTIVE_UP_TO and not is_video:
        return [(i, j) for i in range(n) for j in range(i + 1, n)]
    steps = [*range(1, OVERLAP + 1), 16, 32]
    neighbours = {(i, i + step) for i in range(n) for step in steps if i + step < n}
    every_tenth = range(0, n, OVERLAP)
    return sorted(neighbours | {(i, j) for i in every_tenth for j in every_tenth if i < j})


def retry_pairs(posed: list[bool], done: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the unmatched pairs that contain a picture without pose, at most `MAX_RETRY_PAIRS`.

    Args:
        posed: whether each picture has a pose.
        done: pairs that were matched before.
    """
    matched = set(done)
    n = len(posed)
    candidates = ((i, j) for i in range(n) for j in range(i + 1, n) if not (posed[i] and posed[j]))
    pairs = [pair for pair in candidates if pair not in matched]
    return pairs[:: -(-len(pairs) // MAX_RETRY_PAIRS)] if pairs else []


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
    # Blocks of pairs, so that the features of a picture are read once for many pairs.
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
    """Run the incremental mapper with several seeds and return the models of the best run.

    A wrong match can deform a whole model, but rarely in every run. A deformed model explains fewer
    observations. So the run whose best model has most observations wins, as soon as a second run
    has nearly as many. If no run gives a model, a smaller triangulation angle is allowed.

    Raises:
        UserError: no run gives a model.
    """
    for min_angle in (INITIAL_ANGLE, RETRY_ANGLE):
        attempts: list[tuple[int, list]] = []
        for number in range(MAX_ATTEMPTS):
            start = seed + number
            found = _map_once(
                pycolmap, imported, database, folder, start, min_angle, progress, number
            )
            good = [
                m
                for m in found.values()
                if m.num_reg_images() >= MIN_PHOTOS and m.num_points3D() >= MIN_POINTS
            ]
            best = max((m.compute_num_observations() for m in good), default=0)
            attempts.append((best, good))
            ranked = sorted((count for count, _ in attempts), reverse=True)
            if len(ranked) > 1 and ranked[1] >= MIN_AGREEMENT * ranked[0]:
                break
        best, good = max(attempts, key=lambda attempt: attempt[0])
        if best:
            return good
    raise UserError(
        "no three of the pictures fit together: they overlap too little, are blurred, or were taken"
        " from nearly one position; walk around the scene and take each photo a step further, with"
        " two thirds of overlap"
    )


def _map_once(
    pycolmap,
    imported: PhotoImport,
    database: Path,
    folder: Path,
    seed: int,
    min_angle: float,
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
    options.mapper.init_min_tri_angle = min_angle
    # The fallback registers pictures that share few points with the rest, and some of them wrongly.
    options.structure_less_registration_fallback = False
    count, stage = 0, f"poses, attempt {number + 1}"

    def count_picture() -> None:
        nonlocal count
        count += 1
        progress(stage, min(0.99, count / len(imported.pictures)))

    found = pycolmap.incremental_mapping(
        database, imported.folder, folder, options, next_image_callback=count_picture
    )
    progress(stage, 1.0)
    return found


def _names(database: Path) -> list[str]:
    """Return the names of the pictures in the database; delete a damaged database."""
    if not database.is_file():
        return []
    try:
        with contextlib.closing(read_only(database)) as connection:
            return [row[0] for row in connection.execute("SELECT name FROM images")]
    except sqlite3.Error:
        database.unlink()  # incomplete: start again
        return []
