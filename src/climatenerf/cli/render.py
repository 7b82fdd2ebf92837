"""``climatenerf render RUN -o OUT``: movies and measured layers in any weather."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro

from climatenerf.cli import progress
from climatenerf.core.errors import UserError
from climatenerf.scene import Scene
from climatenerf.weather.description import (
    KeyframedWeather,
    combine,
    given_flags,
    read_weather,
    weather_to_table,
)
from climatenerf.weather.parameters import Flood, Smog, Snow, Sun, Weather

if TYPE_CHECKING:
    from climatenerf.paths.camera_path import CameraPath
    from climatenerf.render.session import Stage

MAX_RAYS = 2**26  # in one frame: 6 GB
PREVIEW = "preview.png"
LAYER_NAMES = ("depth", "normal", "label", "water_depth", "transmittance", "snow_thickness",
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
    appearance: str = "mean"
    """Exposure and light of the frames: mean, or those of a training photo such as 0012.jpg."""
    preview: bool = False
    """Show the frame at work early, in OUT/preview.png: coarse at first, finer pass by pass."""
    layers: tuple[Literal["all", *LAYER_NAMES], ...] = ()  # type: ignore[valid-type]
    """Layers to keep beside the frames."""
    layer_format: tuple[Literal["npz", "png", "exr"], ...] = ("npz",)
    """How layers are written."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to compute. cuda: an NVIDIA GPU under Linux, with a C compiler beside it; its
    present kernels were tested without one."""
    smog: Smog = field(default_factory=Smog)
    flood: Flood = field(default_factory=Flood)
    snow: Snow = field(default_factory=Snow)
    sun: Sun = field(default_factory=Sun)
    seed: int = 0
    """Of waves and snowfall."""


def run(options: Render, arguments: Sequence[str] | None = None) -> int:
    """Renders and says where the result is."""
    size = parse_size(options.size)
    if options.frames < 1 or not 1 <= options.supersample <= 8:
        raise UserError("--frames must be above 0, --supersample from 1 to 8")
    check_fps(options.fps)
    film = None if options.weather is None else read_weather(options.weather)
    flags = Weather(options.smog, options.flood, options.snow, options.sun, options.seed)
    given = given_flags(sys.argv[1:] if arguments is None else arguments)
    weather = combine(film, flags, given)
    for name, absent in without_effect(weather, given).items():
        progress.warn(f"--{name} changes nothing without {absent}")
    layers = LAYER_NAMES if "all" in options.layers else options.layers
    if "exr" in options.layer_format and layers:
        from climatenerf.output.layers import require_exr

        require_exr()

    from climatenerf.field.device import on

    with on(options.device):
        return render_run(options, weather, size, layers)


def without_effect(weather: KeyframedWeather, given: frozenset[str]) -> dict[str, str]:
    """Flags of a weather that is not there, and what would bring it."""
    bring = {
        "smog": "--smog.visibility or --smog.sigma",
        "flood": "--flood.level",
        "snow": "--snow.depth",
    }
    found = {}
    for name in sorted(given):
        section = name.partition(".")[0]
        keyed = any(key.startswith(f"{section}.") for key in weather.keyframes)
        if section in bring and not keyed and not getattr(weather.base, section).present:
            found[name.replace("_", "-")] = bring[section]
    return found


def render_run(
    options: Render,
    weather: KeyframedWeather,
    size: tuple[int, int] | None,
    layers: Sequence[str],
) -> int:
    """The same on the device in use, once the flags are understood."""
    from climatenerf.field.checkpoint import load_field
    from climatenerf.paths.camera_path import camera_path
    from climatenerf.scene import load_scene
    from climatenerf.training.folder import check_config

    field = load_field(options.run)
    check_config(options.run)
    scene = load_scene(options.run)
    shown = appearance_of(options.appearance, scene)
    appearance = None if shown is None else field.embeddings[[shown]].detach()
    if not field.knows_classes:
        if "label" in options.layers:
            raise UserError(
                f"{options.run} was fitted without class labels, so it has no layer label; fit with"
                " --labels"
            )
        if "label" in layers:
            progress.say("no layer label: the run was fitted without class labels")
        layers = tuple(name for name in layers if name != "label")
    path = camera_path(options.path, scene, options.frames, size)
    for note in path.notes:
        progress.say(note)
    fps = check_fps(path.fps or options.fps)
    check_amount(path.size, options.supersample)
    check_place(options.out, len(path), options.preview)
    stage = prepare_stage(field, scene, weather, path, fps, appearance)
    movie = render_movie(
        stage,
        path,
        fps,
        options.out,
        options.supersample,
        layers,
        options.layer_format,
        shown=shown,
        preview=options.preview,
    )
    progress.result(f"movie: {movie}")
    return 0


def appearance_of(name: str, scene: Scene) -> int | None:
    """Index of the training photo whose exposure and light are shown; None for the mean."""
    if name == "mean":
        return None
    views = scene.of_split("train")
    names = [(view.name, Path(view.name).name, Path(view.name).stem) for view in views]
    found = [i for i, own in enumerate(names) if name == own[0]] or [
        i for i, own in enumerate(names) if name in own
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


def parse_size(text: str | None) -> tuple[int, int] | None:
    """Width and height from "480x270"."""
    if text is None:
        return None
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(p.isdecimal() and 16 <= int(p) <= 8192 for p in parts):
        raise UserError(f'--size wants width x height such as 480x270, 16 to 8192; got "{text}"')
    return int(parts[0]), int(parts[1])


def check_fps(fps: float) -> float:
    """The frame rate itself, if a movie can have it."""
    if not 0.1 <= fps <= 240:
        raise UserError(f"the frame rate must lie between 0.1 and 240 per second; got {fps:g}")
    return fps


def check_amount(size: tuple[int, int], supersample: int) -> None:
    """Refuses frames that would not fit into memory."""
    rays = size[0] * size[1] * supersample**2
    if max(size) > 8192 or rays > MAX_RAYS:
        raise UserError(
            f"a frame of {size[0]}x{size[1]} pixels with {supersample}x{supersample} rays each is"
            f" too large; at most 8192 pixels a side and {MAX_RAYS / 1e6:.0f} million rays"
        )


def check_place(out: Path, frames: int, preview: bool = False) -> None:
    """Refuses a folder in which a render would overwrite what is not an earlier render's."""
    ours = files_of_render(out)
    planned = [out / "frames" / f"{index:04d}.png" for index in range(frames)]
    planned += [out / name for name in ("movie.mp4", "movie.json") if not ours]
    planned += [out / PREVIEW] if preview and not is_simulated(out / PREVIEW) else []
    for name in LAYER_NAMES:
        planned += [p for p in (out / name).glob("*") if p.stem.isdecimal()]
    for path in planned:
        if path.exists() and path.resolve() not in ours:
            raise UserError(
                f"{path} was not made by the render that {out} holds, and would be overwritten;"
                " choose another folder with -o, or remove it"
            )


def is_simulated(path: Path) -> bool:
    """Whether a file is a PNG of ours: a render that is killed leaves its preview."""
    from PIL import Image

    try:
        with Image.open(path) as picture:
            return "simulated" in picture.info
    # No file, no picture, or one so large that it is not opened.
    except (OSError, ValueError, Image.DecompressionBombError):
        return False


def prepare_stage(
    field, scene, weather: KeyframedWeather, path: "CameraPath", fps: float, appearance=None
):
    """Light, waves and snowfall, with a progress bar."""
    from climatenerf.render.session import prepare

    times = np.arange(len(path)) / fps
    with progress.Bar("prepare", 1.0) as bar:

        def told(what: str, share: float) -> None:
            bar.update(share, {"now": what})

        stage = prepare(field, scene, weather, path.c2w[:, :3, 3], times, told, appearance)
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
    shown: int | None = None,
    preview: bool = False,
) -> Path:
    """Writes out/frames/*.png, out/movie.mp4, the layers and the sidecar; returns the movie.

    `shown` is the training view whose appearance the field shows, as the sidecar tells; with
    `preview` out/preview.png shows the frame at work while it becomes finer.
    """
    from climatenerf.core.storage import make_folder
    from climatenerf.output.layers import SIMULATED, FrameRecord, save_layers, write_sidecar
    from climatenerf.output.video import MovieWriter, write_png
    from climatenerf.render.frame import render_frame

    make_folder(out / "frames")
    before = files_of_render(out)
    records: list[FrameRecord] = []
    about: dict[str, Any] = {"path": path.name, "notes": list(path.notes), "fps": fps}
    about["appearance_of_training_view"] = shown  # null: the mean
    about |= {"supersample": supersample, "frames_wanted": len(path)}
    if stage.waves is not None:
        about["significant_wave_height_m"] = stage.waves.significant_height
    early = (lambda seen: write_png(out / PREVIEW, seen, SIMULATED)) if preview else None
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
                wanted = supersample, "normal" in layers, "label" in layers, early
                picture, found = render_frame(stage.at(time), camera, c2w, *wanted)
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
        if preview:
            (out / PREVIEW).unlink(missing_ok=True)
    # A longer render before this one has left frames and layers that are not of this weather.
    for stale in before - files_of_render(out):
        stale.unlink(missing_ok=True)
    return out / "movie.mp4"


def files_of_render(out: Path) -> set[Path]:
    """Frames and layers that a folder's sidecar names; none if there is no sound one."""
    from climatenerf.core.storage import read_json

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
