"""``climatenerf capture PHOTOS|VIDEO -o SCENE``: a posed scene from bare photos or a video."""

import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from climatenerf.cli import progress
from climatenerf.cli.fit import (
    check_known_lengths,
    frame_line,
    parse_known_lengths,
    with_known_lengths,
)
from climatenerf.core.errors import UserError
from climatenerf.core.storage import explain, make_folder
from climatenerf.scene import Camera, Scene, read_scene, save_scene
from climatenerf.scene.alignment.georeference import (
    Georeference,
    apply_georeference,
    find_georeference,
    gps_warning,
)
from climatenerf.scene.alignment.known_length import FILE_NAME as MARKS
from climatenerf.scene.alignment.scale import (
    scale_from_depth_files,
    scale_warnings,
    with_capture_flags,
    with_scale_evidence,
)
from climatenerf.scene.images import picture_header
from climatenerf.scene.readers.colmap import read_colmap
from climatenerf.scene.scene import FILE_NAME as SCENE
from climatenerf.sfm.scene_folder import (
    SIDECAR_KINDS,
    WORK,
    check_output,
    discard_scene,
    install_scene,
    start_scene,
)
from climatenerf.weather.units import OptionalLength


@dataclass(frozen=True)
class Capture:
    """Find the poses of photos or of a video's frames, and make a scene folder of them."""

    photos: tyro.conf.Positional[Path]
    """Folder of photos (JPEG, PNG, HEIC, ...), or a video."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Scene folder to make."""
    features: int = 4096
    """Most features looked for in a picture."""
    from_colmap: Path | None = None
    """Folder of a COLMAP model of these photos, to take the poses from."""
    labels: Path | None = None
    """Folder of class pictures (8-bit Cityscapes train ids), named like the photos."""
    masks: Path | None = None
    """Folder of masks (black is ignored), named like the photos."""
    depth: Path | None = None
    """Folder of z-depths (16-bit PNG in mm; NPY or NPZ in m), named like the photos."""
    camera_height: OptionalLength = None
    """Height of the cameras above the ground, which sets the scale."""
    known_length: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Lengths that set the scale, such as "DOOR=2.0 m", marked in pictures (see --marks)."""
    marks: Path | None = None
    """Where their ends are in the pictures; default: marks.toml in the scene folder."""
    seed: int = 0
    """Of all randomness."""


def run(options: Capture) -> int:
    """Takes pictures in, finds poses, levels the scene and says what came of it."""
    check(options)
    finished, fresh = (options.out / SCENE).is_file(), not os.path.lexists(options.out)
    new = start_scene(options.out)
    try:
        scene, model, lost, refused = make_scene(options, new, finished)
    except UserError:
        discard_scene(options.out, fresh)
        raise
    kept = install_scene(options.out, new, given_kinds(options))
    for kind in SIDECAR_KINDS:
        if mine := [path for path in kept if path.startswith(f"{kind}/")]:
            progress.say(f"Files of yours stay in {options.out / kind}: {listed(mine)}.")
    for warning in scene.warnings:
        progress.warn(warning)
    progress.say(frame_line(scene))
    for one in lost:
        progress.warn(f"{one.source} has no pose: {one.reason}; {one.remedy}")
    if refused is not None:
        raise UserError(
            f"{refused} (poses are kept in {options.out}, with the scale from"
            f" {scene.scale_source} and without this length)"
        )
    error = model.reprojection_error
    progress.result(
        f"{len(scene.views)} of {len(scene.views) + len(lost)} pictures have poses"
        f"{'' if error is None else f', reprojection error {error:.2f} px'},"
        f" {model.points} points; peak memory {peak_gigabytes():.1f} GB"
    )
    progress.result(f"report: {options.out / 'report.md'}")
    progress.result(f"scene: {options.out}")
    return 0


def make_scene(options: Capture, new: Path, finished: bool):
    """Makes the whole scene in a folder of its own.

    Args:
        options: of the verb.
        new: the folder.
        finished: whether there is a scene already, which is better than one without its length.

    Returns:
        The scene, the model, the pictures without pose, and why known lengths could not be used.

    Raises:
        UserError: there is no scene to be made of this.
    """
    from climatenerf.sfm.mark_page import write_mark_page
    from climatenerf.sfm.report import write_report

    find = poses_of_colmap if options.from_colmap else poses_by_motion
    intake, model, lost = find(options, new)
    with naming_photos(options, new):
        scene = with_files(options, in_metres(options, new, intake), intake, model)
    refused = None
    try:
        scene = with_known_lengths(scene, options.known_length, options.marks or marks_of(options))
    except UserError as error:
        if finished:
            raise UserError(f"{error} (the scene in {options.out} stays as it was)") from error
        refused = error  # the poses are worth keeping, and the page is needed to make marks
    told = dict.fromkeys((*scene.warnings, *scale_warnings(scene)))
    scene = replace(scene, warnings=tuple(told))
    save_scene(scene, new)
    write_mark_page(new / "mark.html", scene)
    write_report(new, scene, intake, model, lost)
    return scene, model, lost, refused


def listed(paths: list[str]) -> str:
    """How many there are and the first few."""
    return f"{len(paths)} ({', '.join(paths[:3])}{', ...' if len(paths) > 3 else ''})"


@contextmanager
def naming_photos(options: Capture, new: Path) -> Iterator[None]:
    """Lets errors name the user's photos where pictures are copies of them."""
    try:
        yield
    except UserError as error:
        if options.from_colmap is None:
            raise
        copies = str(new.absolute() / "images")
        raise UserError(str(error).replace(copies, str(options.photos))) from error


def given_kinds(options: Capture) -> list[str]:
    """Which of labels, masks and depths the user gives a folder for."""
    return [kind for kind in SIDECAR_KINDS if getattr(options, kind) is not None]


def no_photos(options: Capture) -> list[Path]:
    """Folders whose pictures are not the photos to pose."""
    return [options.out, *(getattr(options, kind) for kind in given_kinds(options))]


def check(options: Capture) -> None:
    """What can be known to be wrong before anything is done.

    Raises:
        UserError: a flag out of its range, a folder that is absent, or files in the way.
    """
    from climatenerf.sfm.photos import find_photos, is_video
    from climatenerf.sfm.reconstruct import require_pycolmap

    check_lengths(options)
    if not 64 <= options.features <= 32768:
        raise UserError(f"--features must lie between 64 and 32768; got {options.features}")
    if not 0 <= options.seed < 2**31:
        raise UserError(f"--seed must lie between 0 and 2147483647; got {options.seed}")
    if options.camera_height is not None and not options.camera_height > 0:
        raise UserError(f"--camera-height must be above 0; got {options.camera_height:g} m")
    if not options.photos.exists():
        raise UserError(f"{options.photos} does not exist; give a folder of photos or a video")
    for kind in given_kinds(options):
        folder = getattr(options, kind)
        if not (folder.is_dir() and any(folder.iterdir())):
            raise UserError(f"--{kind} {folder} is no folder with files; give the folder of them")
    if options.out.is_symlink() and not options.out.exists():
        raise UserError(
            f"{options.out} is a link to {os.readlink(options.out)}, which does not exist; make"
            " that folder, or choose another with -o"
        )
    out = options.out.resolve()
    for name in ("photos", *SIDECAR_KINDS, "from_colmap"):
        path = getattr(options, name)
        if path is not None and path.resolve().is_relative_to(out):
            raise UserError(f"{path} lies in {options.out}; choose another folder with -o")
    check_output(options.out, given_kinds(options))
    if options.from_colmap is None:
        require_pycolmap()
        if not is_video(options.photos):
            find_photos(options.photos, no_photos(options))


def check_lengths(options: Capture) -> None:
    """What is wrong with known lengths and their marks, as far as it shows without a scene.

    Raises:
        UserError: lengths or marks that cannot be used.
    """
    for name, metres in parse_known_lengths(options.known_length):
        if not name:
            raise UserError(
                f'--known-length wants a name before the length, "DOOR={metres:g} m"; give the name'
                " that the marks have"
            )
    marks = options.marks or marks_of(options)
    if options.known_length and not (marks.exists() or (options.out / SCENE).exists()):
        raise UserError(
            f"{marks} does not exist, and marks are made in a scene's pictures: run this once"
            f" without --known-length, then open {options.out / 'mark.html'}"
        )
    check_known_lengths(options.known_length, options.marks, marks_of(options))


def marks_of(options: Capture) -> Path:
    """Where marks are looked for if nothing is said."""
    return options.out / MARKS


def poses_by_motion(options: Capture, new: Path):
    """The pictures, their poses by structure from motion, and those without with the reason."""
    from climatenerf.sfm.diagnose import diagnose
    from climatenerf.sfm.photo_import import import_photos
    from climatenerf.sfm.reconstruct import DATABASE
    from climatenerf.sfm.worker import reconstruct_in_subprocess

    work = options.out / WORK
    with progress.Bar("pictures", 1.0) as bar:
        besides = no_photos(options)
        intake = import_photos(options.photos, work, lambda n, all: bar.update(n / all), besides)
    for note in intake.notes:
        progress.say(note)
    for name, reason in intake.unusable.items():
        progress.warn(f"{name} is left out: {reason}")
    flat = new / "flat"
    with progress.StageBars() as report:
        model = reconstruct_in_subprocess(
            intake, work, flat, options.features, options.seed, report
        )
    if len(model.groups) > 1:
        progress.warn(
            f"the pictures fall into {len(model.groups)} groups that do not fit together"
            f" ({', '.join(map(str, model.groups))} pictures); the largest is kept"
        )
    try:
        make_folder(new / "sparse")
        os.replace(flat / "images", new / "images")
        os.replace(flat / "sparse", new / "sparse" / "0")
        shutil.rmtree(flat)
    except OSError as error:
        raise explain(error, new) from error
    return intake, model, diagnose(intake, model.registered, work / DATABASE)


def poses_of_colmap(options: Capture, new: Path):
    """The pictures, the poses that COLMAP found before, and the photos that it has none for."""
    from climatenerf.sfm.from_colmap import import_posed

    assert options.from_colmap is not None
    with progress.StageBars() as report:
        found = import_posed(options.photos, options.from_colmap, new, no_photos(options), report)
    for note in found[0].notes:
        progress.say(note)
    return found


def in_metres(options: Capture, new: Path, intake) -> Scene:
    """The scene level and in metres, by all that photos and flags tell."""
    known = {picture.name: picture.exif for picture in intake.pictures}
    # Only views with poses are in the model; which pixels they are of is known after reading.
    posed = read_colmap(new / "sparse" / "0")
    gravity = {}
    for view in posed.views:
        if view.name in known:
            shown = as_shown(options, view.path, posed.cameras[view.camera])
            down = known[view.name].down_as_shown if shown else known[view.name].down
            if down is not None:
                gravity[view.name] = down
    scene = read_scene(new, camera_height=options.camera_height, gravity=gravity)
    scene = with_capture_flags(scene)
    places = {name: exif.gps for name, exif in known.items() if exif.gps is not None}
    found = find_georeference(scene, places)
    note = gps_warning(found, {picture.name: picture.source for picture in intake.pictures})
    if note is not None:
        scene = replace(scene, warnings=(*scene.warnings, note))
    if not isinstance(found, Georeference):
        return scene
    return apply_georeference(scene, found, keep_scale=options.camera_height is not None)


def as_shown(options: Capture, path: Path, camera: Camera) -> bool:
    """Whether a camera is that of its photo as shown: ours always, COLMAP's if only so it fits."""
    return options.from_colmap is None or picture_header(path).rotates_to_fit(camera)


def with_files(options: Capture, scene: Scene, intake, model) -> Scene:
    """The scene with the labels, masks and depths that the user has for the photos."""
    from climatenerf.sfm.sidecars import Photo, import_sidecars

    known = {picture.name: picture for picture in intake.pictures}
    photos = {
        view.name: Photo(
            known[view.name].source,
            model.lenses[view.name],
            known[view.name].exif.orientation,
            as_shown(options, view.path, scene.cameras[view.camera]),
        )
        for view in scene.views
    }
    for kind in given_kinds(options):
        scene = import_sidecars(scene, kind, getattr(options, kind), photos)
    if options.depth is None:
        return scene
    said = scale_from_depth_files(scene)
    if said is None:
        progress.say("The depth files have no one scale; they say nothing of the scene's size.")
        return scene
    return with_scale_evidence(scene, "depth files", *said)


def peak_gigabytes() -> float:
    """Most memory that this process or one that it began has held; 0 where nobody tells."""
    try:
        import resource
    except ImportError:  # Windows
        return 0.0
    processes = resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN
    peak = max(resource.getrusage(who).ru_maxrss for who in processes)
    return peak / (1e9 if sys.platform == "darwin" else 1e6)
