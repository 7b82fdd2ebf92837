"""The capture pipeline: from photos or a video to a scene folder with poses in metres."""

import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

from climatenerf.core.errors import UserError, excerpt
from climatenerf.core.listing import visible
from climatenerf.core.storage import explain, make_folder
from climatenerf.scene import Camera, Scene, read_scene, save_scene
from climatenerf.scene.alignment.georeference import (
    Georeference,
    apply_georeference,
    find_georeference,
    gps_finding,
)
from climatenerf.scene.alignment.known_length import apply_known_lengths, measure, read_marks
from climatenerf.scene.alignment.scale import (
    scale_findings,
    scale_from_depth_files,
    with_capture_flags,
    with_scale_evidence,
)
from climatenerf.scene.findings import without_repeats
from climatenerf.scene.images import read_header
from climatenerf.scene.read import MAX_CAMERA_HEIGHT
from climatenerf.scene.readers.colmap import read_colmap
from climatenerf.scene.scene import FILE_NAME, checked_world
from climatenerf.sfm.diagnose import Unposed, diagnose
from climatenerf.sfm.from_colmap import import_posed
from climatenerf.sfm.mark_page import write_mark_page
from climatenerf.sfm.photo_import import PhotoImport, import_photos
from climatenerf.sfm.photos import find_photos, is_video
from climatenerf.sfm.reconstruct import DATABASE, Model, require_pycolmap
from climatenerf.sfm.report import write_report
from climatenerf.sfm.scene_folder import (
    WORK,
    check_output,
    discard_scene,
    install_scene,
    start_scene,
    writing_scene,
)
from climatenerf.sfm.sidecars import Photo, import_sidecars
from climatenerf.sfm.worker import reconstruct_in_subprocess


@dataclass(frozen=True)
class CaptureSettings:
    """Inputs and options of a capture.

    Attributes:
        photos: folder of photos, or a video.
        out: scene folder.
        marks: file with the marks at the ends of known lengths.
        features: largest number of features per picture.
        from_colmap: folder of a COLMAP model with poses of the photos; None: compute the poses.
        sidecars: folders of labels, masks and depth files by kind.
        camera_height: height of the cameras above the ground, m; None: unknown.
        known_lengths: names and lengths, m.
        seed: random seed of structure from motion.
    """

    photos: Path
    out: Path
    marks: Path
    features: int = 4096
    from_colmap: Path | None = None
    sidecars: Mapping[str, Path] = field(default_factory=dict)
    camera_height: float | None = None
    known_lengths: tuple[tuple[str, float], ...] = ()
    seed: int = 0

    @property
    def excluded(self) -> list[Path]:
        """Folders whose pictures are not photos."""
        return [self.out, *self.sidecars.values()]


@dataclass(frozen=True)
class Listener:
    """Callbacks for messages and progress.

    Attributes:
        note: called with a sentence of information.
        warn: called with a sentence about a problem.
        progress: called with (stage, finished fraction of the stage).
    """

    note: Callable[[str], None]
    warn: Callable[[str], None]
    progress: Callable[[str, float], None]


@dataclass(frozen=True)
class Captured:
    """Result of a capture.

    Attributes:
        scene: the scene, in metres.
        model: result of structure from motion.
        unposed: pictures without pose, with reason and remedy.
        user_files: the user's files that stay in the scene folder, relative to it.
        length_error: why known lengths could not be used; None if they could.
    """

    scene: Scene
    model: Model
    unposed: list[Unposed]
    user_files: list[str]
    length_error: UserError | None


def check_settings(settings: CaptureSettings) -> None:
    """Check the settings before any work is done.

    Raises:
        UserError: a value is out of range, a folder is missing, or a file of the user would be
            lost.
    """
    out = settings.out
    if not 64 <= settings.features <= 32768:
        raise UserError(
            f"--features must lie between 64 and 32768; got {excerpt(settings.features)}"
        )
    if not 0 <= settings.seed < 2**31:
        raise UserError(f"--seed must lie between 0 and 2147483647; got {excerpt(settings.seed)}")
    height = settings.camera_height
    if height is not None and not 0 < height <= MAX_CAMERA_HEIGHT:
        raise UserError(
            f"--camera-height must be above 0 and at most {MAX_CAMERA_HEIGHT:g} m; got {height:g} m"
        )
    if not settings.photos.exists():
        raise UserError(f"{settings.photos} does not exist; give a folder of photos or a video")
    for kind, folder in settings.sidecars.items():
        if not (folder.is_dir() and any(visible(folder.iterdir()))):
            raise UserError(
                f"--{kind} {folder} is missing or empty; give the folder with the {kind} files"
            )
    if out.is_symlink() and not out.exists():
        raise UserError(
            f"{out} is a link to {os.readlink(out)}, which does not exist; make that folder, or"
            " choose another with -o"
        )
    for path in (settings.photos, settings.from_colmap, *settings.sidecars.values()):
        if path is not None and path.resolve().is_relative_to(out.resolve()):
            raise UserError(f"{path} is inside {out}; choose another folder with -o")
    check_output(out, list(settings.sidecars))
    if settings.from_colmap is None:
        require_pycolmap()
        if not is_video(settings.photos):
            find_photos(settings.photos, settings.excluded)


def capture(settings: CaptureSettings, listener: Listener) -> Captured:
    """Make a scene folder from photos or a video.

    Args:
        settings: inputs and options; call `check_settings` first.
        listener: callbacks.

    Raises:
        UserError: the capture failed, or another one works in the folder. An earlier scene in the
            folder is unchanged.
    """
    fresh = not os.path.lexists(settings.out)
    with writing_scene(settings.out):
        return _capture(settings, listener, fresh)


def _capture(settings: CaptureSettings, listener: Listener, fresh: bool) -> Captured:
    """Make a scene in a locked folder; `fresh`: the folder did not exist before."""
    out = settings.out
    has_scene = (out / FILE_NAME).is_file()
    new = start_scene(out)
    try:
        find = poses_of_colmap if settings.from_colmap else poses_by_motion
        imported, model, unposed = find(settings, new, listener)
        with naming_photos(settings, new):
            scene = in_metres(settings, new, imported)
            scene = with_sidecars(settings, scene, imported, model, listener)
        length_error = None
        try:
            scene = with_known_lengths(scene, settings.known_lengths, settings.marks)
        except UserError as error:
            if has_scene:
                raise UserError(f"{error} (the scene in {out} is unchanged)") from error
            # Keep the poses: the user needs the page written below to make the marks.
            length_error = error
        findings = without_repeats((*scene.findings, *scale_findings(scene)))
        scene = replace(scene, findings=findings)
        save_scene(scene, new)
        write_mark_page(new / "mark.html", scene)
        write_report(new, scene, imported, model, unposed)
    except UserError:
        discard_scene(out, fresh)
        raise
    user_files = install_scene(out, new, list(settings.sidecars))
    return Captured(scene, model, unposed, user_files, length_error)


def with_known_lengths(scene: Scene, known: Sequence[tuple[str, float]], marks: Path) -> Scene:
    """Return the scene with the scale of known lengths; unchanged without any.

    Args:
        scene: the scene.
        known: name and length (m) of each marked length.
        marks: file with the marks.

    Raises:
        UserError: the marks are missing or unusable.
    """
    if not known:
        return scene
    marked = read_marks(marks)
    scaled = apply_known_lengths(scene, [measure(scene, marked, *each) for each in known])
    return checked_world(scaled, str(scene.root))


def poses_by_motion(
    settings: CaptureSettings, new: Path, listener: Listener
) -> tuple[PhotoImport, Model, list[Unposed]]:
    """Import the pictures and find their poses by structure from motion.

    Args:
        settings: inputs and options.
        new: folder for the pictures and the model.
        listener: callbacks.

    Returns:
        The pictures, the model, and the pictures without pose.
    """
    work, flat, report = settings.out / WORK, new / "flat", listener.progress
    imported = import_photos(
        settings.photos, work, lambda n, count: report("pictures", n / count), settings.excluded
    )
    for note in imported.notes:
        listener.note(note)
    for name, reason in imported.unusable.items():
        listener.warn(f"{name} is skipped: {reason}")
    features, seed = settings.features, settings.seed
    model = reconstruct_in_subprocess(imported, work, flat, features, seed, report)
    if len(model.groups) > 1:
        listener.warn(
            f"the pictures form {len(model.groups)} unconnected groups"
            f" ({', '.join(map(str, model.groups))} pictures); the largest is kept"
        )
    try:
        make_folder(new / "sparse")
        os.replace(flat / "images", new / "images")
        os.replace(flat / "sparse", new / "sparse" / "0")
        shutil.rmtree(flat)
    except OSError as error:
        raise explain(error, new) from error
    return imported, model, diagnose(imported, model.registered, work / DATABASE)


def poses_of_colmap(
    settings: CaptureSettings, new: Path, listener: Listener
) -> tuple[PhotoImport, Model, list[Unposed]]:
    """Import photos with the poses of a COLMAP model; see `poses_by_motion`."""
    assert settings.from_colmap is not None
    root, excluded = settings.from_colmap, settings.excluded
    found = import_posed(settings.photos, root, new, excluded, listener.progress)
    for note in found[0].notes:
        listener.note(note)
    return found


def in_metres(settings: CaptureSettings, new: Path, imported: PhotoImport) -> Scene:
    """Read the posed pictures as a scene; align it with gravity and metres as far as known."""
    exif = {picture.name: picture.exif for picture in imported.pictures}
    # The model contains only views with poses, and their cameras.
    posed = read_colmap(new / "sparse" / "0")
    gravity = {}
    for view in posed.views:
        if view.name in exif:
            upright = is_upright(settings, view.path, posed.cameras[view.camera])
            down = exif[view.name].down_as_shown if upright else exif[view.name].down
            if down is not None:
                gravity[view.name] = down
    scene = read_scene(new, camera_height=settings.camera_height, gravity=gravity)
    scene = with_capture_flags(scene)
    positions = {name: each.gps for name, each in exif.items() if each.gps is not None}
    found = find_georeference(scene, positions)
    finding = gps_finding(found, {picture.name: picture.source for picture in imported.pictures})
    if finding is not None:
        finding = replace(finding, file=str(scene.root))
        scene = replace(scene, findings=(*scene.findings, finding))
    if not isinstance(found, Georeference):
        return scene
    return apply_georeference(scene, found, keep_scale=settings.camera_height is not None)


def is_upright(settings: CaptureSettings, path: Path, camera: Camera) -> bool:
    """Return True if a camera describes its photo as shown, False if as stored.

    Pictures that this program imports are upright. Cameras of a COLMAP model describe the photo as
    shown if they fit only after the EXIF rotation.
    """
    return settings.from_colmap is None or read_header(path).rotates_to_fit(camera)


def with_sidecars(
    settings: CaptureSettings,
    scene: Scene,
    imported: PhotoImport,
    model: Model,
    listener: Listener,
) -> Scene:
    """Return the scene with the user's labels, masks and depth files for its photos."""
    pictures = {picture.name: picture for picture in imported.pictures}
    photos = {
        view.name: Photo(
            pictures[view.name].source,
            model.lenses[view.name],
            pictures[view.name].exif.orientation,
            is_upright(settings, view.path, scene.cameras[view.camera]),
        )
        for view in scene.views
    }
    for kind, folder in settings.sidecars.items():
        scene = import_sidecars(scene, kind, folder, photos)
    if "depth" not in settings.sidecars:
        return scene
    scale = scale_from_depth_files(scene)
    if scale is None:
        listener.note("The depth files have no common scale; they do not set the scene's scale.")
        return scene
    return with_scale_evidence(scene, "depth files", *scale)


@contextmanager
def naming_photos(settings: CaptureSettings, new: Path) -> Iterator[None]:
    """Make errors name the user's photos instead of their copies in the scene folder."""
    try:
        yield
    except UserError as error:
        if settings.from_colmap is None:
            raise
        copies = str(new.absolute() / "images")
        raise UserError(str(error).replace(copies, str(settings.photos))) from error
