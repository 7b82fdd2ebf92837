"""``climatenerf render RUN -o OUT``: movies and measured layers in any weather."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro

from climatenerf.cli import progress
from climatenerf.errors import UserError
from climatenerf.weather.description import (
    KeyframedWeather,
    combine,
    given_flags,
    read_weather,
    weather_to_table,
)
from climatenerf.weather.parameters import Flood, Smog, Snow, Sun, Weather

if TYPE_CHECKING:
    from climatenerf.render.camera_path import CameraPath
    from climatenerf.render.stage import Stage

LAYER_NAMES = ("depth", "normal", "water_depth", "transmittance", "snow_thickness",
               "mask_water", "mask_snow", "mask_smog")  # fmt: skip


@dataclass(frozen=True)
class Render:
    """Render a fitted place in any weather: PNG frames, a movie, layers."""

    run: tyro.conf.Positional[Path]
    """Run folder made by `climatenerf fit`."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for the frames, the movie and the layers."""
    weather: Path | None = None
    """Weather file (TOML); flags override it."""
    path: str = "training"
    """Camera path: training, orbit, still, still:NAME, or a nerfstudio camera_path.json."""
    frames: int = 48
    """Number of frames."""
    fps: float = 24.0
    """Frames per second of the movie."""
    size: str | None = None
    """Size of the frames, such as 480x270. Default: the photos' own."""
    supersample: int = 1
    """Rays per pixel along each side."""
    layers: tuple[Literal["all", *LAYER_NAMES], ...] = ()  # type: ignore[valid-type]
    """Layers to keep beside the frames."""
    layer_format: tuple[Literal["npz", "png", "exr"], ...] = ("npz",)
    """How layers are written."""
    smog: Smog = field(default_factory=Smog)
    flood: Flood = field(default_factory=Flood)
    snow: Snow = field(default_factory=Snow)
    sun: Sun = field(default_factory=Sun)
    seed: int = 0
    """Of waves and snowfall."""


def run(options: Render, arguments: Sequence[str] | None = None) -> int:
    """Renders and says where the result is."""
    size = parse_size(options.size)
    if options.frames < 1 or options.supersample < 1 or not options.fps > 0:
        raise UserError("--frames, --supersample and --fps must be above 0")
    film = None if options.weather is None else read_weather(options.weather)
    flags = Weather(options.smog, options.flood, options.snow, options.sun, options.seed)
    given = given_flags(sys.argv[1:] if arguments is None else arguments)
    weather = combine(film, flags, given)
    layers = LAYER_NAMES if "all" in options.layers else options.layers
    if "exr" in options.layer_format and layers:
        from climatenerf.render.layers import require_exr

        require_exr()

    from climatenerf.field.checkpoint import load_field
    from climatenerf.render.camera_path import camera_path
    from climatenerf.scene import load_scene
    from climatenerf.training.run import check_config

    field = load_field(options.run)
    check_config(options.run)
    scene = load_scene(options.run)
    path = camera_path(options.path, scene, options.frames, size)
    for note in path.notes:
        progress.say(note)
    fps = path.fps or options.fps
    stage = prepare_stage(field, scene, weather, path, fps)
    movie = render_movie(
        stage, path, fps, options.out, options.supersample, layers, options.layer_format
    )
    progress.result(f"movie: {movie}")
    return 0


def parse_size(text: str | None) -> tuple[int, int] | None:
    """Width and height from "480x270"."""
    if text is None:
        return None
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(p.isdecimal() and 16 <= int(p) <= 8192 for p in parts):
        raise UserError(f'--size wants width x height such as 480x270, 16 to 8192; got "{text}"')
    return int(parts[0]), int(parts[1])


def prepare_stage(field, scene, weather: KeyframedWeather, path: "CameraPath", fps: float):
    """Light, waves and snowfall, with a progress bar."""
    from climatenerf.render.stage import prepare

    times = np.arange(len(path)) / fps
    with progress.Bar("prepare", 1.0) as bar:

        def told(what: str, share: float) -> None:
            bar.update(share, {"now": what})

        stage = prepare(field, scene, weather, path.c2w[:, :3, 3], times, told)
        bar.update(1.0, {"now": "ready"})
    return stage


def render_movie(
    stage: "Stage",
    path: "CameraPath",
    fps: float,
    out: Path,
    supersample: int = 1,
    layers: Sequence[str] = (),
    formats: Sequence[Literal["npz", "png", "exr"]] = ("npz",),
    title: str = "render",
) -> Path:
    """Writes out/frames/*.png, out/movie.mp4, the layers and the sidecar; returns the movie."""
    from climatenerf.render.frame import render_frame
    from climatenerf.render.layers import SIMULATED, FrameRecord, save_layers, write_sidecar
    from climatenerf.render.movie import MovieWriter, write_png
    from climatenerf.storage import make_folder

    make_folder(out / "frames")
    before = files_of_render(out)
    records: list[FrameRecord] = []
    about: dict[str, Any] = {"path": path.name, "notes": list(path.notes), "fps": fps}
    about |= {"supersample": supersample, "frames_wanted": len(path)}
    if stage.waves is not None:
        about["significant_wave_height_m"] = stage.waves.significant_height
    bar, writer = progress.Bar(title, len(path)), MovieWriter(out / "movie.mp4", path.size, fps)
    try:
        with bar, writer:
            if writer.problem is not None:
                progress.warn(str(writer.problem))
            if writer.note is not None:
                progress.say(writer.note)
            for index in range(len(path)):
                time = index / fps
                camera, c2w = path.cameras[index], path.c2w[index]
                picture, found = render_frame(
                    stage.at(time), camera, c2w, supersample, "normal" in layers
                )
                name = f"{index:04d}"
                (out / "movie.json").unlink(missing_ok=True)  # from here on it would be wrong
                write_png(out / "frames" / f"{name}.png", picture, SIMULATED)
                writer.add(picture)
                kept = save_layers(out, name, {k: found[k] for k in layers}, tuple(formats))
                weather = weather_to_table(stage.weather.at(time))
                file = f"frames/{name}.png"
                records.append(FrameRecord(file, time, camera, c2w, kept, weather, measured(found)))
                bar.advance()
    finally:
        # Also of a render that was stopped, or that has no movie: frames without it are no data.
        if records:
            weather, seed = weather_to_table(stage.weather), stage.weather.base.seed
            write_sidecar(out / "movie.json", stage.scene, records, weather, seed, about)
    # A longer render before this one has left frames and layers that are not of this weather.
    for stale in before - files_of_render(out):
        stale.unlink(missing_ok=True)
    return out / "movie.mp4"


def files_of_render(out: Path) -> set[Path]:
    """Frames and layers that a folder's sidecar names; none if there is no sound one."""
    from climatenerf.storage import read_json

    try:
        frames = read_json(out / "movie.json")["frames"]
        names = [n for f in frames for n in [f["file"], *sum(f["layers"].values(), [])]]
        paths = {(out / name).resolve() for name in names}
    except (UserError, OSError, KeyError, TypeError, AttributeError):
        return set()
    return {path for path in paths if path.is_relative_to(out.resolve())}


def measured(layers: dict[str, np.ndarray]) -> dict[str, float]:
    """A few numbers that say what the frame shows."""
    snowy = layers["mask_snow"] > 0.5
    return {
        "water_share": float(layers["mask_water"].mean()),
        "mean_water_depth_m": _mean(layers["water_depth"], layers["mask_water"] > 0.5),
        "mean_transmittance": float(layers["transmittance"].mean()),
        "snow_share": float(layers["mask_snow"].mean()),
        "mean_snow_thickness_m": _mean(layers["snow_thickness"], snowy),
    }


def _mean(values: np.ndarray, where: np.ndarray) -> float:
    return float(values[where].mean()) if where.any() else 0.0
