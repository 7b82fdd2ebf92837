"""``climatenerf capture PHOTOS|VIDEO -o SCENE``: a posed scene from bare photos or a video."""

import shutil
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from climatenerf.cli import progress
from climatenerf.cli.fit import frame_line, with_known_lengths
from climatenerf.errors import UserError
from climatenerf.scene import Scene, read_scene, save_scene
from climatenerf.scene.georeference import apply_georeference, find_georeference
from climatenerf.scene.scale import by_depth, scale_warnings, with_witness
from climatenerf.storage import explain, make_folder
from climatenerf.weather.units import OptionalLength

WORK = "work"  # folder in the scene: may be deleted when all is well


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
    known_length: tuple[str, ...] = ()
    """Lengths that set the scale, such as "DOOR=2.0 m", marked in pictures (see --marks)."""
    marks: Path | None = None
    """Where their ends are in the pictures; default: marks.toml in the scene folder."""
    seed: int = 0
    """Of all randomness."""


def run(options: Capture) -> int:
    """Takes pictures in, finds poses, levels the scene and says what came of it."""
    check(options)
    from climatenerf.sfm.mark_page import write_mark_page
    from climatenerf.sfm.report import write_report

    find = poses_of_colmap if options.from_colmap else poses_by_motion
    intake, model, lost = find(options)
    scene = in_metres(options, intake)
    try:
        scene = with_known_lengths(scene, options.known_length, options.marks)
    finally:
        # The poses are worth keeping, and the page is needed to make marks.
        save_scene(scene, options.out)
        write_mark_page(options.out / "mark.html", scene)
    scene = with_files(options, scene, intake, model)
    told = dict.fromkeys((*scene.warnings, *scale_warnings(scene)))
    scene = replace(scene, warnings=tuple(told))
    save_scene(scene, options.out)
    for warning in scene.warnings:
        progress.warn(warning)
    progress.say(frame_line(scene))
    for one in lost:
        progress.warn(f"{one.source} has no pose: {one.reason}; {one.remedy}")
    report, _ = write_report(options.out, scene, intake, model, lost)
    error = model.reprojection_error
    progress.result(
        f"{len(scene.views)} of {len(scene.views) + len(lost)} pictures have poses"
        f"{'' if error is None else f', reprojection error {error:.2f} px'},"
        f" {model.points} points; peak memory {peak_gigabytes():.1f} GB"
    )
    progress.result(f"report: {report}")
    progress.result(f"scene: {options.out}")
    return 0


def check(options: Capture) -> None:
    """What can be known to be wrong before anything is done.

    Raises:
        UserError: a flag out of its range, a folder that is absent, or a scene in the way.
    """
    if not 64 <= options.features <= 32768:
        raise UserError(f"--features must lie between 64 and 32768; got {options.features}")
    for kind in ("labels", "masks", "depth"):
        folder = getattr(options, kind)
        if folder is not None and not folder.is_dir():
            raise UserError(f"--{kind} {folder} is no folder; give the folder of the files")
    if not options.photos.exists():
        raise UserError(f"{options.photos} does not exist; give a folder of photos or a video")
    if options.out.resolve() == options.photos.resolve():
        raise UserError(f"{options.out} holds the photos; choose another folder with -o")
    if not (options.out / WORK).is_dir():
        # Not made by an earlier run: what is there is the user's.
        for name, what in (("scene.json", "a scene"), ("images", "images"), ("sparse", "sparse")):
            if (options.out / name).exists():
                raise UserError(
                    f"{options.out} already holds {what}; choose another folder with -o"
                )
    make_folder(options.out / WORK)


def poses_by_motion(options: Capture):
    """The pictures, their poses by structure from motion, and those without with the reason."""
    from climatenerf.sfm.diagnose import diagnose
    from climatenerf.sfm.intake import take_in
    from climatenerf.sfm.reconstruct import load_pycolmap
    from climatenerf.sfm.worker import reconstruct_apart

    load_pycolmap()  # its absence is to be known before anything is done
    work = options.out / WORK
    with progress.Bar("pictures", 1.0) as bar:
        intake = take_in(options.photos, work, lambda done, total: bar.update(done / total))
    for name, reason in intake.unusable.items():
        progress.warn(f"{name} is left out: {reason}")
    model = reconstruct_apart(intake, work, options.features, options.seed, Stages())
    if len(model.groups) > 1:
        progress.warn(
            f"the pictures fall into {len(model.groups)} groups that do not fit together"
            f" ({', '.join(map(str, model.groups))} pictures); the largest is kept"
        )
    for source, target in (("images", "images"), ("sparse", "sparse/0")):
        copy_files(model.folder / source, options.out / target)
    return intake, model, diagnose(intake, model.registered, work / "database.db")


def copy_files(source: Path, target: Path) -> None:
    """All files of a folder into another, whose former content goes.

    Raises:
        UserError: the disk is full, or the place cannot be written.
    """
    shutil.rmtree(target, ignore_errors=True)
    try:
        for path in sorted(source.iterdir()):
            if path.is_file():
                shutil.copyfile(path, make_folder(target) / path.name)
    except OSError as error:
        raise explain(error, target) from error


def poses_of_colmap(options: Capture):
    """The pictures, the poses that COLMAP found before, and the photos that it has none for."""
    from climatenerf.sfm.from_colmap import take_posed

    assert options.from_colmap is not None
    return take_posed(options.photos, options.from_colmap, options.out, Stages())


def in_metres(options: Capture, intake) -> Scene:
    """The scene level and in metres, by all that photos and flags tell."""
    # Poses of COLMAP's own model are of the pictures as stored, ours of those as shown.
    stored = options.from_colmap is not None
    gravity = {p.name: p.exif.down if stored else p.exif.down_as_shown for p in intake.pictures}
    (options.out / "scene.json").unlink(missing_ok=True)
    scene = read_scene(
        options.out,
        camera_height=options.camera_height,
        gravity={name: down for name, down in gravity.items() if down is not None},
    )
    places = {p.name: p.exif.place for p in intake.pictures if p.exif.place is not None}
    found = find_georeference(scene, places)
    if found is None:
        return scene
    return apply_georeference(scene, found, keep_scale=options.camera_height is not None)


def with_files(options: Capture, scene: Scene, intake, model) -> Scene:
    """The scene with the labels, masks and depths that the user has for the photos."""
    from climatenerf.sfm.extras import bring_along

    sources = {picture.name: picture.source for picture in intake.pictures}
    stored = options.from_colmap is not None
    turned = {p.name: 1 if stored else p.exif.orientation for p in intake.pictures}
    for kind in ("labels", "masks", "depth"):
        folder = getattr(options, kind)
        if folder is not None:
            scene = bring_along(scene, kind, folder, sources, model.lenses, turned)
    if options.depth is not None and (said := by_depth(scene)) is not None:
        scene = with_witness(scene, "depth files", *said)
    return scene


class Stages:
    """A progress bar for each stage as it is told of."""

    def __init__(self) -> None:
        self.bar: progress.Bar | None = None

    def __call__(self, stage: str, share: float) -> None:
        """Tells that `share` of a stage is done."""
        if self.bar is None or self.bar.title != stage:
            self.bar = progress.Bar(stage, 1.0)
            self.bar.__enter__()
        self.bar.update(share)
        if share >= 1:
            self.bar.__exit__(None, None, None)
            self.bar = None


def peak_gigabytes() -> float:
    """Most memory that this process or one that it began has held; 0 where nobody tells."""
    try:
        import resource
    except ImportError:  # Windows
        return 0.0
    processes = resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN
    peak = max(resource.getrusage(who).ru_maxrss for who in processes)
    return peak / (1e9 if sys.platform == "darwin" else 1e6)
