"""``climatenerf capture PHOTOS|VIDEO -o SCENE``: a posed scene from bare photos or a video."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from climatenerf.cli import progress
from climatenerf.cli.fit import check_known_lengths, frame_line, parse_known_lengths
from climatenerf.cli.flags import optional
from climatenerf.core.errors import UserError
from climatenerf.scene.alignment.known_length import FILE_NAME as MARKS
from climatenerf.scene.scene import FILE_NAME as SCENE
from climatenerf.sfm.scene_folder import SIDECAR_KINDS
from climatenerf.weather.units import OptionalLength


@dataclass(frozen=True)
class Capture:
    """Find the poses of photos or of a video's frames, and make a scene folder of them."""

    photos: tyro.conf.Positional[Path]
    """Folder of photos (JPEG, PNG, HEIC, ...), or a video."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Scene folder to make."""
    features: int = 4096
    """Maximum number of features per picture."""
    from_colmap: Annotated[Path | None, optional("PATH")] = None
    """Folder of a COLMAP model of these photos, to take the poses from."""
    labels: Annotated[Path | None, optional("PATH")] = None
    """Folder of class pictures (8-bit Cityscapes train ids), named like the photos."""
    masks: Annotated[Path | None, optional("PATH")] = None
    """Folder of masks (black pixels are ignored), named like the photos."""
    depth: Annotated[Path | None, optional("PATH")] = None
    """Folder of z-depths (16-bit PNG in mm; NPY or NPZ in m), named like the photos."""
    camera_height: OptionalLength = None
    """Height of the cameras above the ground, which sets the scale."""
    known_length: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Lengths that set the scale, such as "DOOR=2.0 m", marked in pictures (see --marks)."""
    marks: Annotated[Path | None, optional("PATH")] = None
    """File of the marks at which known lengths end. Default: marks.toml in the scene folder."""
    seed: int = 0
    """Random seed."""


def run(options: Capture) -> int:
    """Find the poses of the pictures, and print where the scene is and how good it is."""
    from climatenerf.sfm.pipeline import CaptureSettings, Listener, capture, check_settings

    check_lengths(options)
    folders = {kind: getattr(options, kind) for kind in SIDECAR_KINDS}
    settings = CaptureSettings(
        photos=options.photos,
        out=options.out,
        marks=options.marks or default_marks(options),
        features=options.features,
        from_colmap=options.from_colmap,
        sidecars={kind: folder for kind, folder in folders.items() if folder is not None},
        camera_height=options.camera_height,
        known_lengths=tuple(parse_known_lengths(options.known_length)),
        seed=options.seed,
    )
    check_settings(settings)
    with progress.StageBars() as bars:
        made = capture(settings, Listener(progress.say, progress.warn, bars))
    for kind in SIDECAR_KINDS:
        if files := [path for path in made.user_files if path.startswith(f"{kind}/")]:
            progress.say(f"Files of yours stay in {options.out / kind}: {listed(files)}.")
    progress.report_findings(made.scene.findings)
    progress.say(frame_line(made.scene))
    for picture in made.unposed:
        progress.warn(f"{picture.source} has no pose: {picture.reason}; {picture.remedy}")
    if made.length_error is not None:
        raise UserError(
            f"{made.length_error} (poses are kept in {options.out}, with the scale from"
            f" {made.scene.scale_source} and without this length)"
        )
    error, posed = made.model.reprojection_error, len(made.scene.views)
    progress.result(
        f"{posed} of {posed + len(made.unposed)} pictures have poses"
        f"{'' if error is None else f', reprojection error {error:.2f} px'},"
        f" {made.model.points} points; peak memory {peak_gigabytes():.1f} GB"
    )
    progress.result(f"report: {options.out / 'report.md'}")
    progress.result(f"scene: {options.out}")
    return 0


def listed(paths: list[str]) -> str:
    """Return the number of paths and the first three."""
    return f"{len(paths)} ({', '.join(paths[:3])}{', ...' if len(paths) > 3 else ''})"


def check_lengths(options: Capture) -> None:
    """Refuse known lengths or marks that cannot be used, as far as that shows without a scene.

    Raises:
        UserError: lengths or marks that cannot be used.
    """
    for name, metres in parse_known_lengths(options.known_length):
        if not name:
            raise UserError(
                f'--known-length needs a name before the length, "DOOR={metres:g} m"; give the name'
                " that the marks have"
            )
    marks = options.marks or default_marks(options)
    if options.known_length and not (marks.exists() or (options.out / SCENE).exists()):
        raise UserError(
            f"{marks} does not exist, and marks are made in a scene's pictures: run this once"
            f" without --known-length, then open {options.out / 'mark.html'}"
        )
    check_known_lengths(options.known_length, options.marks, default_marks(options))


def default_marks(options: Capture) -> Path:
    """Return the file of marks that is read if none is given."""
    return options.out / MARKS


def peak_gigabytes() -> float:
    """Return the peak memory of this process or a child process, GB; 0 where it is not measured."""
    try:
        import resource
    except ImportError:  # Windows
        return 0.0
    processes = resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN
    peak = max(resource.getrusage(who).ru_maxrss for who in processes)
    return peak / (1e9 if sys.platform == "darwin" else 1e6)
