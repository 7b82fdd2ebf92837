"""Render jobs with a trivial frame source, and processes that render or join their parts."""

import functools
import multiprocessing
from pathlib import Path

import numpy as np

from climatenerf.core.cameras import Camera
from climatenerf.core.storage import is_temporary
from climatenerf.output.frame_source import RenderedFrame
from climatenerf.output.job import (
    RenderJob,
    frames_of_part,
    join,
    render_frames,
    render_movie,
)
from climatenerf.paths.camera_path import CameraPath
from climatenerf.scene import Scene
from climatenerf.weather.description import KeyframedWeather
from climatenerf.weather.smog.parameters import Smog
from climatenerf.weather.weather import Weather

WIDTH, HEIGHT = 32, 18
SCENE = Scene(Path("/none"), "test", (), ())


def make_job(frames: int = 8, visibility: float = 50.0, **changes) -> RenderJob:
    """A camera that moves along x, in smog."""
    c2w = np.repeat(np.eye(4)[None], frames, axis=0)
    c2w[:, 0, 3] = np.arange(frames)
    camera = Camera(WIDTH, HEIGHT, 20.0, 20.0, WIDTH / 2, HEIGHT / 2)
    path = CameraPath(c2w, (camera,) * frames, "test")
    weather = KeyframedWeather(Weather(smog=Smog(visibility=visibility)), {})
    settings = {"layers": ("depth",), **changes}
    return RenderJob("a run", path, 12.0, weather, **settings)


def noise_of(job: RenderJob):
    """A frame source whose pictures depend on the job and the index only."""
    return functools.partial(noise_frame, job)


def noise_frame(job: RenderJob, index: int, preview) -> RenderedFrame:
    rng = np.random.default_rng([int(job.key[:8], 16), index])
    picture = rng.integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    names = ("depth", "water_depth", "transmittance", "snow_thickness", "seen")
    layers = {name: rng.random((HEIGHT, WIDTH), np.float32) for name in names}
    layers |= {f"mask_{name}": rng.random((HEIGHT, WIDTH)) for name in ("water", "snow")}
    if preview is not None:
        preview(picture)
    return RenderedFrame(picture, layers, {"fact": 1.5})


def render_part(out: Path, part: tuple[int, int], frames: int) -> None:
    """Entry point of a process that renders a part."""
    job = make_job(frames)
    render_frames(job, out, lambda: noise_of(job), frames_of_part(job, part))


def render_whole(out: Path, frames: int, visibility: float) -> None:
    """Entry point of a process that renders a movie."""
    job = make_job(frames, visibility)
    render_movie(job, SCENE, out, lambda: noise_of(job))


def start(target, *args) -> multiprocessing.Process:
    """Start a process quickly: its server has imported this module already."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["support.render_jobs"])
    process = context.Process(target=target, args=args)
    process.start()
    return process


def join_parts(out: Path, frames: int) -> None:
    """Entry point of a process that joins."""
    join(make_job(frames), SCENE, out)


def files_of(folder: Path) -> dict[str, bytes]:
    """All files of a render by relative path, except the lock and temporary files."""
    found = {p.relative_to(folder).as_posix(): p for p in folder.rglob("*") if p.is_file()}
    return {name: p.read_bytes() for name, p in found.items() if not is_left_over(name)}


def is_left_over(name: str) -> bool:
    """Whether a path in a render folder is the lock, or what a process leaves that is killed."""
    path = Path(name)
    scratch = name.startswith(".frames/unfinished-")
    return name == ".frames/lock" or scratch or is_temporary(path.name)
