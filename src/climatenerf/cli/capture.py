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
    if not 64 <= options.features <= 32768:
        raise UserError(f"--features must lie between 64 and 32768; got {options.features}")
    from climatenerf.sfm.diagnose import diagnose
    from climatenerf.sfm.intake import take_in
    from climatenerf.sfm.mark_page import write_mark_page
    from climatenerf.sfm.reconstruct import load_pycolmap, reconstruct
    from climatenerf.sfm.report import write_report

    load_pycolmap()  # its absence is to be known before anything is done
    work = options.out / WORK
    if (options.out / "scene.json").exists() and not work.is_dir():
        raise UserError(f"{options.out} already holds a scene; choose another folder with -o")
    with progress.Bar("pictures", 1.0) as bar:
        intake = take_in(options.photos, work, lambda done, total: bar.update(done / total))
    for name, reason in intake.unusable.items():
        progress.warn(f"{name} is left out: {reason}")
    model = reconstruct(intake, work, options.features, options.seed, Stages())
    lost = len(intake.pictures) - len(model.registered)
    if len(model.groups) > 1:
        progress.warn(
            f"the pictures fall into {len(model.groups)} groups that do not fit together"
            f" ({', '.join(map(str, model.groups))} pictures); the largest is kept"
        )
    for source, target in (("images", "images"), ("sparse", "sparse/0")):
        shutil.rmtree(options.out / target, ignore_errors=True)
        (options.out / target).parent.mkdir(parents=True, exist_ok=True)
        shutil.copytree(model.folder / source, options.out / target)
    (options.out / "scene.json").unlink(missing_ok=True)
    scene = read_scene(options.out, camera_height=options.camera_height)
    scene = located(scene, intake, options.camera_height is not None)
    try:
        scene = with_known_lengths(scene, options.known_length, options.marks)
    finally:
        # The poses are worth keeping, and the page is needed to make marks.
        save_scene(scene, options.out)
        write_mark_page(options.out / "mark.html", scene)
    for warning in scene.warnings:
        progress.warn(warning)
    progress.say(frame_line(scene))
    missing = diagnose(intake, model.registered, work / "database.db")
    for one in missing:
        progress.warn(f"{one.source} has no pose: {one.reason}; {one.remedy}")
    report, _ = write_report(options.out, scene, intake, model, missing)
    progress.result(
        f"{len(model.registered)} of {len(intake.pictures)} pictures have poses"
        f" ({lost} without), reprojection error {model.reprojection_error:.2f} px,"
        f" {model.points} points; peak memory {peak_gigabytes():.1f} GB"
    )
    progress.result(f"report: {report}")
    progress.result(f"scene: {options.out}")
    return 0


def located(scene: Scene, intake, scale_known: bool) -> Scene:
    """The scene with what GPS says of it, and a warning where GPS and the given scale disagree."""
    places = {p.name: p.exif.place for p in intake.pictures if p.exif.place is not None}
    found = find_georeference(scene, places)
    if found is None:
        return scene
    out = apply_georeference(scene, found, keep_scale=scale_known)
    apart = abs(found.scale - 1)
    if scale_known and apart > 2 * (found.scale_error + scene.scale_error):
        warning = (
            f"GPS makes the scene {found.scale:.2f} times as large as --camera-height does;"
            " check the height."
        )
        out = replace(out, warnings=(*out.warnings, warning))
    return out


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
    """Most memory that this process has held; 0 where the system does not tell."""
    try:
        import resource
    except ImportError:  # Windows
        return 0.0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1e9 if sys.platform == "darwin" else 1e6)
