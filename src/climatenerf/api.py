"""The public functions of the program: from photos to a fitted run, and from a run to movies.

    import climatenerf

    scene = climatenerf.open_scene("my-photos")
    run = climatenerf.fit(scene, "runs/mine", minutes=5)
    flood = climatenerf.Weather(flood=climatenerf.Flood(level=0.5))
    climatenerf.render_movie(run, "movies/flood", flood)

All values are SI (m, s, rad) and colours are display sRGB in [0, 1], unless a docstring gives
another unit. Wrong input raises `climatenerf.core.errors.UserError`, whose message is one sentence
with the remedy. The functions import torch when they are called, not before.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Float

from climatenerf.core.cameras import Camera
from climatenerf.core.errors import UserError
from climatenerf.core.input_limits import check_seed
from climatenerf.scene import Scene
from climatenerf.weather.description import KeyframedWeather, for_effects, read_weather
from climatenerf.weather.effect import Effect
from climatenerf.weather.registry import check_effects, installed_effects, layer_table
from climatenerf.weather.style import Style
from climatenerf.weather.weather import Weather

if TYPE_CHECKING:
    from climatenerf.field.hash_field import Field
    from climatenerf.output.frame_source import FrameSource
    from climatenerf.render.completed_ground import CompletedField

PathText = str | PathLike[str]
Progress = Callable[[str, float], None]
"""Called with what is being done and the fraction of it that is done, in [0, 1]."""


@dataclass(frozen=True)
class Run:
    """A fitted place.

    Attributes:
        folder: The run folder that `fit` made.
        field: The radiance field.
        scene: The capture, in world metres with z up.
        digest: Hash of the files that both were read from; None takes that of the folder's files.
        checkpoint: Identity of the field's checkpoint; "" for runs of earlier versions.
        style: New colours that `stylize` gave the run; None: those of the photos.
    """

    folder: Path
    field: "Field"
    scene: Scene
    digest: str | None = None
    checkpoint: str = ""
    style: Style | None = None

    def completed(self, progress: Progress | None = None) -> "Field | CompletedField":
        """Return the field with ground where no photo shows it.

        The terrain is read from the run folder, or made and saved there, which takes seconds. The
        field itself is returned if the photos show too little ground.

        Args:
            progress: called with "ground" and the fraction that is done.

        Raises:
            UserError: the saved terrain is damaged.
        """
        from climatenerf.render.completed_ground import CompletedField
        from climatenerf.render.run_terrain import terrain_of_run

        given = self.folder, self.field, self.scene, self.checkpoint
        terrain = terrain_of_run(*given, progress)
        return self.field if terrain is None else CompletedField(self.field, terrain)

    def camera(
        self, photo: str | None = None, size: tuple[int, int] | None = None
    ) -> tuple[Camera, Float[np.ndarray, "4 4"]]:
        """Return the camera and the pose from which a photo was taken.

        Args:
            photo: name of the photo, with or without suffix; None takes the most central one.
            size: width and height of the picture, pixels; None takes the photo's.

        Returns:
            Intrinsics (pixels) and the camera-to-world pose (world m, OpenCV axes).

        Raises:
            UserError: there is no such photo.
        """
        from climatenerf.paths.camera_path import still

        path = still(self.scene, photo, 1, size)
        return path.cameras[0], path.c2w[0]


def open_scene(
    folder: PathText,
    *,
    holdout: str | None = None,
    camera_height: float | None = None,
    metric_input: bool = False,
    frames: str | None = None,
    label_space: str | None = None,
) -> Scene:
    """Read a capture: photos with known poses.

    Args:
        folder: COLMAP model, transforms.json, scene folder, Tanks and Temples (NSVF), mip-NeRF 360,
            KITTI-360 or Mega-NeRF.
        holdout: names of the photos kept for measuring, with commas between, or "0" for none; None
            takes the capture's own split, else every 8th photo by name.
        camera_height: height of the cameras above the ground, m, which sets the scale.
        metric_input: whether the capture is in metres with z up already.
        frames: first and last frame of a KITTI-360 drive, such as "1538:1601".
        label_space: meaning of the numbers in label files; None takes what the capture states.

    Raises:
        UserError: the folder holds no capture, or a damaged one.
    """
    from climatenerf.scene import read_scene

    return read_scene(
        Path(folder),
        holdout=holdout,
        camera_height=camera_height,
        metric_input=metric_input,
        frames=frames,
        label_space=label_space,
    )


def fit(
    scene: Scene | PathText,
    folder: PathText,
    *,
    minutes: float | None = None,
    steps: int | None = None,
    downscale: int = 1,
    preset: Literal["cpu", "gpu", "paper"] | None = None,
    device: Literal["cpu", "cuda"] = "cpu",
    losses: Mapping[str, float] | None = None,
    samples_per_step: int | None = None,
    resume: bool = False,
    seed: int = 0,
    progress: Progress | None = None,
) -> Run:
    """Fit a radiance field to a capture, and leave a run folder.

    Args:
        scene: the capture, or its folder.
        folder: run folder to make, or to resume.
        minutes: stop after this time; None means 5, or no limit if `steps` is given.
        steps: stop after this many steps.
        downscale: factor by which the photos are reduced in width and height.
        preset: size of the field; None takes "gpu" on "cuda" and "cpu" elsewhere.
        device: where to compute.
        losses: weights by name that replace the preset's; 0 switches a loss off.
        samples_per_step: field samples per step; None takes the preset's.
        resume: continue the run in the folder.
        seed: random seed.
        progress: called after each step with "fit", and while measuring with "held-out photos".

    Raises:
        UserError: a value is out of range, the folder holds a run (without `resume`) or none (with
            it), or the photos cannot be fitted.
    """
    target = _folder(folder)
    from climatenerf.core.device import resolve_device
    from climatenerf.training.run import fit_scene
    from climatenerf.training.settings import Losses, settings_of

    check_seed(seed)
    unknown = set(losses or {}) - {name for name in Losses.__dataclass_fields__}
    if unknown:
        raise UserError(f"there is no loss {min(unknown)!r}; see `climatenerf fit --help`")
    settings = settings_of(preset or ("gpu" if device == "cuda" else "cpu"), device)
    settings = replace(
        settings,
        losses=replace(settings.losses, **(losses or {})),
        samples_per_step=samples_per_step or settings.samples_per_step,
        minutes=5.0 if minutes is None and steps is None else minutes,
        steps=steps,
        seed=seed,
    )
    scene = scene if isinstance(scene, Scene) else open_scene(scene)
    report = progress or (lambda what, fraction: None)
    fit_scene(
        scene,
        target,
        settings,
        downscale,
        resume,
        lambda state: report("fit", state.progress),
        lambda done, total: report("held-out photos", done / total),
        resolve_device(device),
    )
    return load_run(folder, device=device)


def load_run(folder: PathText, *, device: Literal["cpu", "cuda"] = "cpu") -> Run:
    """Read a run folder that `fit` made, or is making: then its latest checkpoint.

    Args:
        folder: the run folder.
        device: where the field computes, and what is rendered of it.

    Raises:
        UserError: the folder holds no run, a damaged one, or one of a newer version, or the device
            cannot be used.
    """
    from climatenerf.core.device import resolve_device
    from climatenerf.core.storage import hash_of_files
    from climatenerf.field.checkpoint import load_field
    from climatenerf.scene import load_scene
    from climatenerf.training.folder import check_config
    from climatenerf.training.snapshot import CONFIG, FIELD, SCENE, identity_of, read_together
    from climatenerf.weather.style import FILE_NAME as STYLE
    from climatenerf.weather.style import style_in

    where = resolve_device(device)
    folder = Path(folder)

    def read(paths: Mapping[str, Path]) -> Run:
        field = load_field(folder, where)
        check_config(paths[CONFIG].parent)
        scene = load_scene(paths[SCENE])
        style = style_in(folder)
        about = [paths[FIELD], paths[SCENE], *([folder / STYLE] if style else [])]
        identity = identity_of(paths[FIELD]) or ""
        return Run(folder, field, scene, hash_of_files(about), identity, style)

    return read_together(folder, read)


def render_movie(
    run: Run | PathText,
    out: PathText,
    weather: Weather | KeyframedWeather | PathText | None = None,
    *,
    path: str = "training",
    frames: int = 48,
    fps: float = 24.0,
    size: tuple[int, int] | None = None,
    supersample: int = 1,
    appearance: str = "mean",
    layers: Sequence[str] = (),
    formats: Sequence[Literal["npz", "png", "exr"]] = ("npz",),
    part: tuple[int, int] | None = None,
    join_only: bool = False,
    preview: bool = False,
    complete_ground: bool = True,
    workers: int | str | None = None,
    progress: Progress | None = None,
    note: Callable[[str], None] | None = None,
    effects: Sequence[Effect] | None = None,
) -> Path:
    """Render a run in a weather: PNG frames, a movie, a JSON sidecar, measured layers.

    Frames that are finished are kept, so a stopped render resumes with the same call, and several
    processes can each render a part of one folder.

    Args:
        run: the fitted place, or its folder.
        out: folder of the movie. A complete earlier render in it is replaced when this one is
            complete.
        weather: the weather, or a weather file (TOML); None renders the place as it is.
        path: "training", "orbit", "still", "still:PHOTO", or a nerfstudio camera_path.json.
        frames: number of frames; a camera_path.json has its own.
        fps: frames per second.
        size: width and height of the frames, pixels; None takes the photos'.
        supersample: rays per pixel along each side, 1 to 8.
        appearance: "mean", or the training photo whose exposure and light the frames have.
        layers: names of the layers to write, or ("all",).
        formats: file formats of the layers.
        part: (i, n) renders the frames whose index is i - 1 modulo n, and joins nothing.
        join_only: render nothing; join the finished frames.
        preview: show the frame at work in `preview.png`.
        complete_ground: let a terrain stand in where no photo shows the ground.
        workers: how many processes of this machine render the frames, or the address of a Dask
            scheduler, such as "tcp://10.0.0.1:8786"; None renders them here. A script that calls
            this needs `if __name__ == "__main__":`, since its processes import it.
        progress: called with what is prepared ("ground", an effect), then with "frames" and
            "movie".
        note: called with sentences about what was assumed or left out.
        effects: the effects to render with; None takes the installed ones. A section of the weather
            that has values of its own needs its effect among them.

    Returns:
        The movie; with `part` the folder of the frames.

    Raises:
        UserError: a value is out of range, frames to join are missing, or the folder holds
            something else.
    """
    from climatenerf.field.protocol import device_of
    from climatenerf.output import job as jobs
    from climatenerf.paths.camera_path import camera_path

    run = run if isinstance(run, Run) else load_run(run)
    out, say = _folder(out), note or (lambda sentence: None)
    used = installed_effects() if effects is None else check_effects(tuple(effects))
    table = layer_table(used)
    unknown = set(layers) - {"all", *table}
    if unknown:
        raise UserError(f"there is no layer {min(unknown)!r}; use all or {', '.join(table)}")
    if part is not None and join_only:
        raise UserError("a part is rendered or the frames are joined; ask for one of them")
    if part is not None and not 1 <= part[0] <= part[1]:
        raise UserError(f"part {part[0]} of {part[1]} does not exist; parts count from 1")
    view = jobs.appearance_index(appearance, run.scene)
    wanted = tuple(table) if "all" in layers else tuple(layers)
    if "label" in wanted and not run.field.knows_classes:
        if "label" in layers:
            raise UserError(
                f"{run.folder} was fitted without class labels, so it has no layer label; fit with"
                " --labels"
            )
        say("no layer label: the run was fitted without class labels")
        wanted = tuple(name for name in wanted if name != "label")
    cameras = camera_path(path, run.scene, frames, size)
    for sentence in cameras.notes:
        say(sentence)
    job = jobs.plan(
        run.folder,
        cameras,
        cameras.fps or fps,
        _keyframed(weather, used),
        supersample=supersample,
        layers=wanted,
        formats=formats,
        appearance=view,
        effects=used,
        digest=run.digest,
        complete_ground=complete_ground,
        style=run.style,
    )

    def prepare() -> "FrameSource":
        from climatenerf.output.frame_source import frame_source
        from climatenerf.weather.world import Kept

        field = run.completed(progress) if complete_ground else run.field
        return frame_source(job, field, run.scene, progress, Kept(run.folder, job.run))

    if workers is not None and (part is not None or join_only):
        raise UserError("workers render all frames and join them; leave part and join out")
    if workers is not None and device_of(run.field).type != "cpu":
        raise UserError("workers compute on the CPU; load the run with device cpu")
    if join_only:
        return jobs.join(job, run.scene, out, note=note, progress=progress)
    if part is None:
        options: dict[str, Any] = {"preview": preview, "note": note, "progress": progress}
        if workers is not None:
            from climatenerf.cluster.frames import renderer

            options["render"] = renderer(workers)
        return jobs.render_movie(job, run.scene, out, prepare, **options)
    indices = jobs.frames_of_part(job, part)
    jobs.render_frames(job, out, prepare, indices, preview=preview, progress=progress)
    missing = len(jobs.missing_frames(job, out))
    say(f"{len(job) - missing} of {len(job)} frames are finished")
    return out / "frames"


def evaluate(run: Run | PathText, *, progress: Progress | None = None) -> dict[str, Any]:
    """Compare a run's held-out photos with renders from the same cameras.

    Args:
        run: the fitted place, or its folder.
        progress: called with "held-out photos".

    Returns:
        Means of `psnr` (dB), `ssim` and `psnr_cc` (dB, colour-corrected), None without held-out
        photos; `views` has them for each photo.

    Raises:
        UserError: a photo cannot be read.
    """
    from climatenerf.evaluation.heldout import evaluate as measure
    from climatenerf.training.folder import check_config

    run = run if isinstance(run, Run) else load_run(run)
    downscale = int(check_config(run.folder).get("downscale", 1))
    report = progress or (lambda what, fraction: None)
    return measure(
        run.field, run.scene, downscale, lambda done, all: report("held-out photos", done / all)
    )


def _folder(path: PathText) -> Path:
    """Return an output folder; refuse an empty text, which `Path` takes for the working folder."""
    if not os.fspath(path):
        raise UserError('the folder to write into is ""; name one, or give "."')
    return Path(path)


def _keyframed(
    weather: Weather | KeyframedWeather | PathText | None, effects: Sequence[Effect]
) -> KeyframedWeather:
    """Return any description of weather as weather over time, with a section for each effect."""
    if weather is None:
        weather = Weather(effects=effects)
    if isinstance(weather, Weather | KeyframedWeather):
        return for_effects(weather, effects)
    return read_weather(Path(weather), effects)
