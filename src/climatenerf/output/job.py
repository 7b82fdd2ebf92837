"""A render job: plan the frames of a movie, render any of them in any process, join them.

    job = plan(run_folder, path, 24.0, weather)
    render_frames(job, out, lambda: frame_source(job, field, scene), frames_of_part(job, (3, 16)))
    movie = join(job, scene, out)

A finished frame is recognised by a hash of everything that it depends on. So a stopped job resumes
with the same call, and parts that several processes or machines render fit together.
"""

import contextlib
import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np

import climatenerf
from climatenerf.core.errors import UserError
from climatenerf.core.input_limits import check_fps
from climatenerf.core.layer_table import Layer
from climatenerf.core.storage import hash_of_files, plain, read_json, write_json
from climatenerf.output import render_folder
from climatenerf.output.frame_source import FrameSource, Preview, RenderedFrame, measured
from climatenerf.output.layers import LayerFormat, require_exr, save_layers
from climatenerf.output.render_folder import MOVIE, PREVIEW, SIDECAR
from climatenerf.output.sidecar import FrameRecord, sidecar
from climatenerf.output.video import (
    SIMULATED,
    MovieWriter,
    find_ffmpeg,
    padding_note,
    write_png,
)
from climatenerf.paths.camera_path import CameraPath
from climatenerf.scene import Scene
from climatenerf.scene.images import read_rgb
from climatenerf.weather.description import KeyframedWeather, weather_to_table
from climatenerf.weather.effect import Effect
from climatenerf.weather.registry import EFFECTS, layer_table
from climatenerf.weather.style import FILE_NAME as STYLE
from climatenerf.weather.style import Style

MAX_SIDE = 8192
MAX_RAYS = 2**26
"""Rays of one frame; that many need 6 GB."""

Progress = Callable[[str, float], None]
"""Called with what is being done and the fraction of it that is done."""


@dataclass(frozen=True)
class RenderJob:
    """Everything that the frames of a movie depend on.

    Attributes:
        run: Hash of the run, from `hash_of_run`.
        path: Camera of each frame.
        fps: Frames per second; frame i shows the moment i / fps, s.
        weather: Weather over time.
        supersample: Rays per pixel along each side.
        layers: Names of the layers to write, keys of `table`.
        formats: File formats of the layers.
        appearance: Index of the training view whose exposure and light the frames have; None takes
            the mean.
        effects: The effects that the weather has sections for.
        complete_ground: Whether the terrain stands in where no photo shows the ground.
        style: New colours of the run, of which `run` is a hash as well; None: those of the photos.
    """

    run: str
    path: CameraPath
    fps: float
    weather: KeyframedWeather
    supersample: int = 1
    layers: tuple[str, ...] = ()
    formats: tuple[LayerFormat, ...] = ("npz",)
    appearance: int | None = None
    effects: tuple[Effect, ...] = EFFECTS
    complete_ground: bool = True
    style: Style | None = None

    @property
    def table(self) -> dict[str, Layer]:
        """All layers that a frame can have, by name."""
        return layer_table(self.effects)

    def __len__(self) -> int:
        return len(self.path)

    def time(self, index: int) -> float:
        """Return the moment that a frame shows, s."""
        return index / self.fps

    @cached_property
    def key(self) -> str:
        """Hash of the whole job, of which every frame depends on every part.

        Light, waves and snow are prepared from the weather at all moments and from all camera
        positions. Poses are rounded to 1e-6 (m, or a matrix entry): two machines may differ in
        the last bits, and that must not make two renders of one.
        """
        described = {
            "version": climatenerf.__version__,
            "run": self.run,
            "weather": weather_to_table(self.weather, self.effects),
            "fps": self.fps,
            "cameras": self.path.cameras,
            "c2w": (np.round(self.path.c2w, 6) + 0.0),
            "supersample": self.supersample,
            "layers": self.layers,
            "formats": self.formats,
            "appearance": self.appearance,
            "complete_ground": self.complete_ground,
            "effects": {effect.name: effect.version for effect in self.effects},
        }
        return _hash(described)

    def frame_key(self, index: int) -> str:
        """Return the hash by which a finished frame is recognised."""
        return _hash([self.key, index])

    def files(self, index: int) -> list[str]:
        """Return the files of a frame, relative to the movie's folder, the picture first."""
        return render_folder.frame_files(index, self.layers, self.formats)


class RenderFrames(Protocol):
    """Renders the frames that are not finished yet, as `render_frames`."""

    def __call__(
        self,
        job: RenderJob,
        out: Path,
        prepare: Callable[[], FrameSource],
        indices: Iterable[int],
        *,
        preview: bool = False,
        progress: Progress | None = None,
    ) -> None:
        """See `render_frames`."""
        ...


def plan(
    run: Path,
    path: CameraPath,
    fps: float,
    weather: KeyframedWeather,
    *,
    supersample: int = 1,
    layers: Sequence[str] = (),
    formats: Sequence[LayerFormat] = ("npz",),
    appearance: int | None = None,
    effects: Sequence[Effect] = EFFECTS,
    digest: str | None = None,
    complete_ground: bool = True,
    style: Style | None = None,
) -> RenderJob:
    """Return the job that renders a fitted run along a path.

    Args:
        run: folder of the run.
        path: camera of each frame.
        fps: frames per second, 0.1 to 240.
        weather: weather over time.
        supersample: rays per pixel along each side, 1 to 8.
        layers: names of the layers to write.
        formats: file formats of the layers.
        appearance: index of a training view, from `appearance_index`; None takes the mean.
        effects: the effects that the weather has sections for.
        digest: hash of the run's files that were read; None takes that of the files as they are.
        complete_ground: whether the terrain stands in where no photo shows the ground.
        style: new colours of the run; None: those of the photos.

    Raises:
        UserError: a value is out of range, the frames are too large, the run is incomplete, or EXR
            is wanted without its package.
    """
    if not 1 <= supersample <= 8:
        raise UserError(f"--supersample must be from 1 to 8; got {supersample}")
    check_fps(fps)
    check_size(path.size, supersample)
    layers = tuple(name for name in layer_table(effects) if name in layers)
    formats = tuple(dict.fromkeys(formats))
    if layers and "exr" in formats:
        require_exr()
    return RenderJob(
        digest or hash_of_run(run),
        path,
        float(fps),
        weather,
        supersample,
        layers,
        formats,
        appearance,
        tuple(effects),
        complete_ground,
        style,
    )


def check_size(size: tuple[int, int], supersample: int) -> None:
    """Refuse frames that would not fit into memory.

    Args:
        size: width and height, pixels.
        supersample: rays per pixel along each side.

    Raises:
        UserError: the frames are too large.
    """
    rays = size[0] * size[1] * supersample**2
    if max(size) > MAX_SIDE or rays > MAX_RAYS:
        raise UserError(
            f"a frame of {size[0]}x{size[1]} pixels with {supersample}x{supersample} rays each is"
            f" too large; at most {MAX_SIDE} pixels a side and {MAX_RAYS / 1e6:.0f} million rays"
        )


def appearance_index(name: str, scene: Scene) -> int | None:
    """Return the index of a training photo among the training views; None for the name "mean".

    Args:
        name: "mean", or the photo's name with or without folder and suffix.
        scene: the capture.

    Raises:
        UserError: no training photo, or more than one, has the name.
    """
    if name == "mean":
        return None
    views = scene.of_split("train")
    names = [(view.name, Path(view.name).name, Path(view.name).stem) for view in views]
    found = [i for i, forms in enumerate(names) if name == forms[0]] or [
        i for i, forms in enumerate(names) if name in forms
    ]
    if len(found) > 1:
        raise UserError(
            f'"{name}" means {len(found)} photos; give the whole name, such as {names[found[0]][0]}'
        )
    if found:
        return found[0]
    raise UserError(
        f'the run has no training photo "{name}" to take the appearance of; give "mean" or a name'
        f" such as {views[0].name}"
    )


def hash_of_run(run: Path) -> str:
    """Return the hash of a run's field and scene, and of its style if it has one.

    Raises:
        UserError: the run lacks field or scene.
    """
    style = [run / STYLE] if (run / STYLE).is_file() else []
    return hash_of_files([run / "field.safetensors", run / "scene.json", *style])


def frames_of_part(job: RenderJob, part: tuple[int, int] | None = None) -> range:
    """Return the indices of the frames of a part (number from 1, of how many); None takes all."""
    number, count = part or (1, 1)
    return range(number - 1, len(job), count)


def missing_frames(job: RenderJob, out: Path, indices: Iterable[int] | None = None) -> list[int]:
    """Return which frames are not finished in a folder, of the indices or of all."""
    indices = range(len(job)) if indices is None else indices
    return [i for i in indices if render_folder.frame_record(out, i, job.frame_key(i)) is None]


def check_folder(job: RenderJob, out: Path, preview: bool = False) -> None:
    """Refuse a folder that cannot receive the job; write nothing.

    Args:
        job: the job.
        out: folder of the movie; it need not exist.
        preview: whether `preview.png` will be written.

    Raises:
        UserError: files that no render made would be overwritten, or the folder holds an unfinished
            render with other settings.
    """
    planned = [name for index in range(len(job)) for name in job.files(index)]
    render_folder.check_foreign_files(out, planned, list(job.table), preview)
    render_folder.working_folder(out, job.key)


def render_frames(
    job: RenderJob,
    out: Path,
    prepare: Callable[[], FrameSource],
    indices: Iterable[int],
    *,
    preview: bool = False,
    progress: Progress | None = None,
) -> None:
    """Render the frames that are not finished yet; other processes may render others of the job.

    Args:
        job: the job.
        out: folder of the movie.
        prepare: makes what renders the frames; called once, and only if one is missing.
        indices: the frames to render.
        preview: show the frame at work in `preview.png`, coarse at first.
        progress: called with "frames" and the fraction that is finished.

    Raises:
        UserError: see `check_folder`; or a disk error.
    """
    indices = list(indices)
    missing = frames_to_render(job, out, indices, preview)
    if not missing:
        return
    render = prepare()
    claim(job, out)
    show = (lambda seen: write_png(out / PREVIEW, seen, SIMULATED)) if preview else None
    done = len(indices) - len(missing)
    try:
        for index in missing:
            _report(progress, done / len(indices))
            render_frame(job, out, index, render, show)
            done += 1
        _report(progress, 1.0)
    finally:
        if preview:
            (out / PREVIEW).unlink(missing_ok=True)


def frames_to_render(
    job: RenderJob, out: Path, indices: Iterable[int], preview: bool = False
) -> list[int]:
    """Return which of the frames are not finished, in a folder that can receive them.

    Raises:
        UserError: see `check_folder`; or a disk error.
    """
    render_folder.continue_promotion(out)
    check_folder(job, out, preview)
    return missing_frames(job, out, indices)


def claim(job: RenderJob, out: Path) -> None:
    """Record in the folder that it receives this job.

    Raises:
        UserError: it holds another unfinished render; or a disk error.
    """
    with render_folder.locked(out):
        render_folder.clear_abandoned(out, list(job.table))
        described = render_folder.describe(job.key, len(job), job.layers, job.formats, ())
        render_folder.claim(out, described)


def render_frame(
    job: RenderJob,
    out: Path,
    index: int,
    render: FrameSource,
    show: Preview | None = None,
) -> None:
    """Render and write one frame of a claimed folder, unless another process has finished it.

    Args:
        job: the job.
        out: folder of the movie.
        index: number of the frame, from 0.
        render: renders it.
        show: called with coarser pictures first.

    Raises:
        UserError: a disk error, or another render has taken the folder.
    """
    if missing_frames(job, out, [index]):
        _save(job, out, index, render(index, show))


def join(
    job: RenderJob,
    scene: Scene,
    out: Path,
    *,
    note: Callable[[str], None] | None = None,
    progress: Progress | None = None,
) -> Path:
    """Write movie and sidecar from finished frames, and return the path of the movie.

    A complete earlier render in the folder is replaced when both are written. If nothing is to be
    done, nothing is written. If the movie fails, the sidecar is written all the same, and an
    earlier render stays.

    Args:
        job: the job.
        scene: its capture, for the frame of reference and the scale in the sidecar.
        out: folder of the movie.
        note: called with a sentence if the movie differs from the frames.
        progress: called with "movie" and the fraction that is encoded.

    Raises:
        UserError: frames are missing, ffmpeg fails, or a disk error.
    """
    render_folder.continue_promotion(out)
    missing = missing_frames(job, out)
    if missing:
        first = ", ".join(f"{index:04d}" for index in missing[:5])
        raise UserError(
            f"{len(missing)} of {len(job)} frames of this render are missing in {out} ({first}"
            f"{', ...' if len(missing) > 5 else ''}); render them with the same flags, then join"
        )
    with render_folder.locked(out):
        render_folder.clear_abandoned(out, list(job.table))
        folder = render_folder.working_folder(out, job.key)
        sidecar = _sidecar(job, scene, out)
        if not _joined(folder, sidecar):
            try:
                _encode(job, folder, note, progress)
            except UserError as error:
                if folder == out:
                    raise
                raise _kept(error, out, folder) from error
            finally:
                write_json(folder / SIDECAR, sidecar)
        render_folder.promote(out, job.key)
    return out / MOVIE


def _kept(error: UserError, out: Path, folder: Path) -> UserError:
    return UserError(
        f"{error} (the frames wait in {folder}, and {out} keeps its earlier movie until the same"
        " command has made the new one)"
    )


def render_movie(
    job: RenderJob,
    scene: Scene,
    out: Path,
    prepare: Callable[[], FrameSource],
    *,
    preview: bool = False,
    note: Callable[[str], None] | None = None,
    progress: Progress | None = None,
    render: RenderFrames | None = None,
) -> Path:
    """Render the frames that are missing, join them, and return the path of the movie.

    A stopped render leaves a sidecar of the frames that are finished, and resumes with the same
    call. Arguments and errors are those of `render_frames` and `join`.

    Args:
        render: renders the frames in place of `render_frames`, such as on other machines.
    """
    render_folder.continue_promotion(out)
    check_folder(job, out, preview)
    if note is not None:  # before hours of rendering
        _note_about_movie(job, note)
    render = render or render_frames
    try:
        render(job, out, prepare, range(len(job)), preview=preview, progress=progress)
    except BaseException:
        _write_partial_sidecar(job, scene, out)
        raise
    return join(job, scene, out, progress=progress)


def _save(job: RenderJob, out: Path, index: int, frame: RenderedFrame) -> None:
    """Write a frame's files and its record."""
    layers = {name: frame.layers[name] for name in job.layers}
    keys = job.key, job.frame_key(index)
    with render_folder.unfinished_files(out) as scratch:
        picture = job.files(index)[0]
        write_png(scratch / picture, frame.picture, SIMULATED, keys[1])
        written = save_layers(scratch, f"{index:04d}", layers, job.formats, job.table)
        record = {
            "files": [picture, *sum(written.values(), [])],
            "layers": written,
            "measured": measured(frame.layers, job.effects),
            "facts": frame.facts,
        }
        render_folder.commit_frame(out, scratch, index, keys, record)


def _sidecar(job: RenderJob, scene: Scene, out: Path) -> dict[str, Any]:
    """Return the sidecar of the frames that are finished, as JSON holds it."""
    records, facts = [], {}
    for index in range(len(job)):
        record = render_folder.frame_record(out, index, job.frame_key(index))
        if record is None:
            continue
        facts |= record["facts"]
        camera, c2w, time = job.path.cameras[index], job.path.c2w[index], job.time(index)
        weather = weather_to_table(job.weather.at(time), job.effects)
        layers, numbers = record["layers"], record["measured"]
        file = job.files(index)[0]
        records.append(FrameRecord(file, time, camera, c2w, layers, weather, numbers))
    about: dict[str, Any] = {"path": job.path.name, "notes": list(job.path.notes), "fps": job.fps}
    about["appearance_of_training_view"] = job.appearance  # null: the mean
    about["complete_ground"] = job.complete_ground
    if job.style is not None:
        about["style"] = {name: getattr(job.style, name) for name in ("name", "sources", "note")}
    about |= {"supersample": job.supersample, "frames_wanted": len(job), "render": job.key, **facts}
    seed = job.weather.base.seed
    weather = weather_to_table(job.weather, job.effects)
    return plain(sidecar(scene, records, weather, seed, about, job.table))


def _joined(out: Path, wanted: dict[str, Any]) -> bool:
    """Return whether movie and sidecar are there and up to date."""
    try:
        return (out / MOVIE).is_file() and read_json(out / SIDECAR) == wanted
    except UserError:
        return False


def _encode(
    job: RenderJob, folder: Path, note: Callable[[str], None] | None, progress: Progress | None
) -> None:
    """Write the movie from the pictures in its folder."""
    with MovieWriter(folder / MOVIE, job.path.size, job.fps) as writer:
        if note is not None and writer.note is not None:
            note(writer.note)
        for index in range(len(job)):
            writer.add(read_rgb(folder / job.files(index)[0]))
            _report(progress, (index + 1) / len(job), "movie")


def _write_partial_sidecar(job: RenderJob, scene: Scene, out: Path) -> None:
    """Describe the frames that a stopped render leaves: without a sidecar they are no data."""
    if not (out / render_folder.STATE).is_dir():
        return
    # A process that holds the lock for longer is joining, and describes all frames.
    with contextlib.suppress(UserError), render_folder.locked(out, wait=2.0):
        folder = render_folder.working_folder(out, job.key)
        current = render_folder.current_render(folder)
        if current is not None and current["render"] == job.key:
            found = _sidecar(job, scene, out)
            if found["frames"]:
                write_json(folder / SIDECAR, found)


def _note_about_movie(job: RenderJob, note: Callable[[str], None]) -> None:
    """Report at once why there will be no movie, or why it will differ from the frames."""
    try:
        find_ffmpeg()
    except UserError as error:
        note(f"the frames will be rendered without a movie: {error}")
    padded = padding_note(MOVIE, job.path.size)
    if padded is not None:
        note(padded)


def _report(progress: Progress | None, fraction: float, what: str = "frames") -> None:
    if progress is not None:
        progress(what, fraction)


def _hash(value: Any) -> str:
    text = json.dumps(plain(value), sort_keys=True, ensure_ascii=False)
    return hashlib.sha256(text.encode()).hexdigest()
