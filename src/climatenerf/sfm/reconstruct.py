"""Poses by structure from motion: features, matches, incremental mapping, undistortion (COLMAP).

Each stage leaves its result in the work folder, so that a run that was stopped goes on. pycolmap
works in C++; how far it is, is read from its database meanwhile.
"""

import contextlib
import shutil
import sqlite3
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from climatenerf.errors import UserError
from climatenerf.sfm.intake import FEWEST, Intake, Picture
from climatenerf.storage import make_folder, read_json, write_json

EXHAUSTIVE_UP_TO = 120  # photos; beyond, and for video, neighbours in time and loops are compared
OVERLAP = 10  # neighbours in time to each side
ASSUMED_FOCAL = 1.2  # over the longer side, where EXIF says nothing
LEAST_TRIANGULATION = 4.0  # degrees between the first two photos, on the second try

Told = Callable[[str, float], None]


@dataclass(frozen=True)
class Model:
    """What structure from motion found.

    Attributes:
        folder: COLMAP model of the undistorted pictures (`sparse`), and the pictures (`images`).
        registered: names of the pictures that have poses.
        groups: number of pictures in each connected group found, largest first.
        reprojection_error: mean, pixels.
        points: number of sparse points.
    """

    folder: Path
    registered: tuple[str, ...]
    groups: tuple[int, ...]
    reprojection_error: float
    points: int


def load_pycolmap():
    """The module, or how to get it.

    Raises:
        UserError: it is not installed.
    """
    try:
        import pycolmap
    except ImportError as error:
        raise UserError('poses need pycolmap; run `pip install "climatenerf[capture]"`') from error
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    return pycolmap


def reconstruct(intake: Intake, work: Path, features: int, seed: int, tell: Told) -> Model:
    """Poses of as many pictures as possible; the largest connected group.

    Args:
        intake: the pictures.
        work: work folder, with what earlier runs left there.
        features: most features in a picture.
        seed: of all random choices.
        tell: told (stage, share of it that is done).

    Raises:
        UserError: no two pictures fit together, or all are taken from one spot.
    """
    pycolmap = load_pycolmap()
    database = work / "database.db"
    _forget_if_changed(intake, database, features)
    names = [picture.name for picture in intake.pictures]
    _import(pycolmap, intake, database)
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.sift.max_num_features = features
    _watched(
        lambda token: pycolmap.extract_features(
            database,
            intake.folder,
            names,
            extraction_options=extraction,
            cancellation_token=token,
        ),
        pycolmap,
        lambda: _count(database, "keypoints") / len(names),
        lambda share: tell("features", share),
    )
    _match(pycolmap, intake, database, seed, tell)
    models = _map(pycolmap, intake, database, work / "models", seed, tell)
    best = max(models, key=lambda m: m.num_reg_images())
    out = work / "undistorted"
    shutil.rmtree(out, ignore_errors=True)
    chosen = make_folder(work / "chosen")
    best.write(chosen)
    tell("undistort", 0.0)
    pycolmap.undistort_images(out, chosen, intake.folder, jpeg_quality=95, output_type="COLMAP")
    tell("undistort", 1.0)
    sizes = sorted((m.num_reg_images() for m in models), reverse=True)
    registered = sorted(best.image(i).name for i in best.reg_image_ids())
    error = float(best.compute_mean_reprojection_error())
    return Model(out, tuple(registered), tuple(sizes), error, best.num_points3D())


def _forget_if_changed(intake: Intake, database: Path, features: int) -> None:
    """Begins anew where a picture was replaced or taken away, or other features are wanted.

    Pictures that have come in are added to what is there.
    """
    record = database.with_name("database.json")
    stamps = {p.name: (intake.folder / p.name).stat().st_mtime_ns for p in intake.pictures}
    before = {}
    if record.is_file():
        with contextlib.suppress(UserError, ValueError):
            before = read_json(record)
    kept = all(stamps.get(name) == stamp for name, stamp in before.get("pictures", {}).items())
    if not (kept and before.get("features") == features):
        for path in database.parent.glob(f"{database.name}*"):
            path.unlink()
    write_json(record, {"features": features, "pictures": stamps})


def camera_groups(pictures: tuple[Picture, ...]) -> list[list[Picture]]:
    """Pictures that one camera and lens took in one size: they share intrinsics."""
    groups: dict[tuple, list[Picture]] = {}
    for picture in pictures:
        focal = None if picture.exif.focal is None else round(picture.exif.focal, 3)
        key = (picture.exif.camera, focal, picture.width, picture.height)
        groups.setdefault(key, []).append(picture)
    return list(groups.values())


def _import(pycolmap, intake: Intake, database: Path) -> None:
    known = set(_names(database))
    if not database.exists():
        pycolmap.Database.open(database).close()
    for group in camera_groups(intake.pictures):
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
        pycolmap.import_images(database, intake.folder, pycolmap.CameraMode.SINGLE, new, options)


def _match(pycolmap, intake: Intake, database: Path, seed: int, tell: Told) -> None:
    n = len(intake.pictures)
    pycolmap.set_random_seed(seed)
    if n <= EXHAUSTIVE_UP_TO and not intake.is_video:
        expected = n * (n - 1) / 2

        def work(token) -> None:
            pycolmap.match_exhaustive(database, cancellation_token=token)

    else:
        pairing = pycolmap.SequentialPairingOptions()
        pairing.overlap = OVERLAP
        expected = n * (OVERLAP + 5)

        def work(token) -> None:
            pycolmap.match_sequential(database, pairing_options=pairing, cancellation_token=token)
            _match_loops(pycolmap, database, token)

    _watched(
        work,
        pycolmap,
        lambda: _count(database, "two_view_geometries") / expected,
        lambda share: tell("matches", share),
    )


def _match_loops(pycolmap, database: Path, token) -> None:
    """Every tenth picture against every tenth: closes loops without a vocabulary to download."""
    names = sorted(_names(database))
    some = names[:: max(1, OVERLAP)]
    pairs = database.with_name("loops.txt")
    lines = [f"{a} {b}" for i, a in enumerate(some) for b in some[i + 2 :]]
    if lines:
        pairs.write_text("\n".join(lines) + "\n")
        options = pycolmap.ImportedPairingOptions()
        options.match_list_path = pairs
        pycolmap.match_image_pairs(database, pairing_options=options, cancellation_token=token)


def _map(pycolmap, intake: Intake, database: Path, folder: Path, seed: int, tell: Told) -> list:
    """Incremental mapping; a second try accepts a smaller baseline."""
    for least_angle in (16.0, LEAST_TRIANGULATION):
        found = _map_once(pycolmap, intake, database, folder, seed, least_angle, tell)
        good = [m for m in found.values() if m.num_reg_images() >= FEWEST]
        if good:
            return good
    raise UserError(
        "no three of the pictures fit together: they show too little in common, are blurred, or"
        " were all taken from one spot; walk around the place and take each photo a step further,"
        " with two thirds of the view in common"
    )


def _map_once(
    pycolmap,
    intake: Intake,
    database: Path,
    folder: Path,
    seed: int,
    least_angle: float,
    tell: Told,
) -> dict:
    pycolmap.set_random_seed(seed)
    shutil.rmtree(folder, ignore_errors=True)
    make_folder(folder)
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = seed
    options.mapper.random_seed = seed
    options.min_model_size = FEWEST
    options.mapper.init_min_tri_angle = least_angle
    # It places pictures that share hardly a point with the rest, and places some of them wrongly.
    options.structure_less_registration_fallback = False
    placed = 0
    found: dict = {}

    def one_more() -> None:
        nonlocal placed
        placed += 1

    def work(token) -> None:
        models = pycolmap.incremental_mapping(
            database,
            intake.folder,
            folder,
            options,
            next_image_callback=one_more,
            cancellation_token=token,
        )
        found.update(models)

    _watched(
        work,
        pycolmap,
        lambda: placed / len(intake.pictures),
        lambda share: tell("poses", share),
    )
    return found


def _watched(
    work: Callable, pycolmap, share: Callable[[], float], tell: Callable[[float], None]
) -> None:
    """Runs work in a thread and tells how far it is; Ctrl-C cancels it cleanly."""
    token = pycolmap.CancellationToken()
    failure: list[BaseException] = []

    def run() -> None:
        try:
            work(token)
        except BaseException as error:
            failure.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        while thread.is_alive():
            thread.join(0.5)
            with contextlib.suppress(sqlite3.Error):
                tell(min(0.999, share()))
    except KeyboardInterrupt:
        token.cancel()
        thread.join()
        raise
    if failure:
        raise failure[0]
    tell(1.0)


def _count(database: Path, table: str) -> int:
    with contextlib.closing(_open(database)) as connection:
        return connection.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0]


def _names(database: Path) -> list[str]:
    if not database.is_file():
        return []
    try:
        with contextlib.closing(_open(database)) as connection:
            return [row[0] for row in connection.execute("SELECT name FROM images")]
    except sqlite3.Error:
        database.unlink()  # half written: begun anew
        return []


def _open(database: Path) -> sqlite3.Connection:
    return sqlite3.connect(f"file:{database}?mode=ro", uri=True, timeout=1.0)
