"""``climatenerf render RUN -o OUT``: movies and measured layers in any weather."""

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, make_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from climatenerf.cli import progress
from climatenerf.cli.flags import names_of, optional
from climatenerf.cluster.workers import parse_workers
from climatenerf.core.errors import UserError, one_line
from climatenerf.core.input_limits import MAX_FRAMES
from climatenerf.core.storage import read_json
from climatenerf.scene.scene import Scene
from climatenerf.weather.description import (
    KeyframedWeather,
    combine,
    given_flags,
    read_weather,
    without_effect,
)
from climatenerf.weather.effect import Effect
from climatenerf.weather.registry import check_effects, installed_effects
from climatenerf.weather.weather import Weather


@dataclass(frozen=True)
class Render:
    """Render a fitted place in any weather: PNG frames, a movie, layers. Re-run the same command to
    resume a stopped render."""

    run: tyro.conf.Positional[Path]
    """Run folder made by `climatenerf fit`."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for the frames, the movie and the layers."""
    weather: Annotated[Path | None, optional("PATH")] = None
    """Weather file (TOML); flags override it."""
    path: str = "training"
    """Camera path: training, orbit, still, still:NAME, or a nerfstudio camera_path.json."""
    frames: int = 48
    """Number of frames."""
    fps: float = 24.0
    """Frames per second of the movie."""
    size: Annotated[str | None, optional("STR")] = None
    """Size of the frames, such as 480x270. Default: the photos' own."""
    supersample: int = 1
    """Rays per pixel along each side."""
    appearance: str = "mean"
    """Exposure and light of the frames: mean, or those of a training photo, such as 0012.jpg."""
    preview: bool = False
    """Show the frame at work in OUT/preview.png: coarse at first, finer pass by pass."""
    complete_ground: bool = True
    """Leave holes where no photo shows the ground, such as below the cameras. By default a smooth
    terrain completes the ground there; the layer seen shows where."""
    layers: tuple[str, ...] = ()
    """Measured layers to write beside the frames: all, or names such as depth; a wrong name lists
    them."""
    layer_format: tuple[Literal["npz", "png", "exr"], ...] = ("npz",)
    """File formats of the layers."""
    part: Annotated[str | None, optional("STR")] = None
    """Render a part of the frames, such as 3/16: frames 0002, 0018, 0034, ... Several processes can
    each render a part of one folder; --join then assembles them."""
    workers: Annotated[str | None, optional("N|ADDRESS")] = None
    """Render on several workers: N processes of this machine, or those of a Dask scheduler such as
    tcp://10.0.0.1:8786, which must share the folders."""
    join: bool = False
    """Render nothing; assemble movie.mp4 and movie.json from finished frames."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to compute. cuda: an NVIDIA GPU under Linux, with a C compiler installed; the current
    GPU kernels were tested without a GPU."""
    seed: int = 0
    """Random seed of waves and snowfall."""


def options_class(effects: Sequence[Effect] | None = None) -> type[Render]:
    """`Render` with a section of flags for each effect; None takes the installed effects."""
    used = installed_effects() if effects is None else effects
    check_effects(used, reserved=[item.name for item in fields(Render)])
    sections = [
        (each.name, each.parameters, field(default_factory=each.parameters)) for each in used
    ]
    return make_dataclass("Render", sections, bases=(Render,), frozen=True)


def run(
    options: Render,
    arguments: Sequence[str] | None = None,
    effects: Sequence[Effect] | None = None,
) -> int:
    """Render, and print where the result is.

    Args:
        options: an instance of `options_class`.
        arguments: words of the command line, which tell given flags from defaults.
        effects: those that the options have flags for; None takes the installed effects.
    """
    size = parse_size(options.size)
    if not 1 <= options.frames <= MAX_FRAMES or not 1 <= options.supersample <= 8:
        raise UserError(f"--frames must be from 1 to {MAX_FRAMES}, --supersample from 1 to 8")
    if options.layers and not options.layer_format:
        raise UserError("--layer-format names no format; give npz, png or exr")
    part = parse_part(options.part)
    if part is not None and options.join:
        raise UserError(
            "--part renders frames and --join assembles them; render all parts, then use --join"
        )
    workers = None if options.workers is None else parse_workers(options.workers)
    if workers is not None and (part is not None or options.join or options.preview):
        raise UserError(
            "--workers renders all frames and joins them; leave --part, --join and --preview out"
        )
    if workers is not None and options.device != "cpu":
        raise UserError("--workers computes on the CPU; leave --device out")
    used = installed_effects() if effects is None else tuple(effects)
    film = None if options.weather is None else read_weather(options.weather, used)
    sections = {each.name: getattr(options, each.name) for each in used}
    flags = Weather(seed=options.seed, effects=used, **sections)
    given = given_flags(sys.argv[1:] if arguments is None else arguments, used)
    weather = combine(film, flags, given, used)
    for name, absent in without_effect(weather, given, used).items():
        progress.warn(f"--{name} changes nothing without {absent}")
    for name in weather.frozen(used):
        progress.warn(f"{name} keeps one value for the whole movie; its keyframes are ignored")

    from climatenerf.api import load_run, render_movie
    from climatenerf.output.render_folder import SIDECAR

    run = load_run(options.run, device=options.device)
    check_out(options.out, options.run, run.scene)
    warn_of_low_water(weather, run.scene)
    with progress.StageBars() as bars:
        made = render_movie(
            run,
            options.out,
            weather,
            path=options.path,
            frames=options.frames,
            fps=options.fps,
            size=size,
            supersample=options.supersample,
            appearance=options.appearance,
            layers=names_of(*options.layers),
            formats=options.layer_format,
            part=part,
            join_only=options.join,
            preview=options.preview,
            complete_ground=options.complete_ground,
            workers=workers,
            progress=bars,
            note=progress.say,
            effects=used,
        )
    if part is None:
        say_light(read_json(options.out / SIDECAR))
    progress.result(f"{'movie' if part is None else 'frames'}: {made}")
    return 0


def warn_of_low_water(film: KeyframedWeather, scene: Scene) -> None:
    """Warn of water that stays below all ground near the cameras."""
    frames = film.keyframes.get("flood.level")
    level = film.base.flood.level if frames is None else max(value for _, value in frames)
    lowest = scene.lowest_ground_z - scene.ground_z
    if level is not None and level < lowest:
        progress.warn(
            f"--flood.level {level:g} m lies below the ground near the cameras, whose lowest is at"
            f" {lowest:.1f} m; no water may be seen"
        )


def say_light(sidecar: dict[str, Any]) -> None:
    """Print where the sun of the photos was found, if the weather needed their light."""
    if sidecar.get("photos_light_known") == 0:
        progress.warn(
            "the photos do not tell their light: snow, water and smog are lit as in the open"
        )
    hard = sidecar.get("photos_sun_width_deg") == 0
    sky = sidecar.get("weather", {}).get("sky", {}).get("kind", "captured")
    if sky != "captured" and not hard:
        progress.say("no sun was found by shadows; if the photos show shadows, these stay")
    if "photos_sun_elevation_deg" not in sidecar:
        return
    elevation, azimuth, error = (
        sidecar[f"photos_sun_{name}_deg"] for name in ("elevation", "azimuth", "error")
    )
    place = f"{elevation:.0f} deg high at azimuth {azimuth:.0f} deg"
    what = "sun of the photos" if hard else "brightest part of the photos' sky"
    text = f"{what}: {place} (+-{error:.0f} deg)"
    difference = sidecar.get("photos_sun_from_almanac_deg")
    if difference is not None:
        text += f"; {difference:.1f} deg from the sun of their date, time and place"
    progress.say(text)


def check_out(out: Path, run: Path, scene: Scene) -> None:
    """Check that frames would lie neither beside the files of the run nor beside photos.

    Raises:
        UserError: they would, and a later reading of that folder would take them for its own.
    """
    folder = os.path.realpath(out)
    if folder == os.path.realpath(run) or (out / "field.safetensors").exists():
        raise UserError(f"-o {out} is the folder of a run; name another, such as {out / 'movie'}")
    if folder in {os.path.realpath(view.path.parent) for view in scene.views}:
        raise UserError(
            f"-o {out} holds photos of the capture, among which frames would later be taken for"
            " photos; name another folder"
        )


def parse_part(text: str | None) -> tuple[int, int] | None:
    """Return number and count of a part given as "3/16".

    Raises:
        UserError: it has another form, or there is no such part.
    """
    if text is None:
        return None
    number, slash, count = (word.strip() for word in text.partition("/"))
    digits = slash and number.isdecimal() and count.isdecimal() and len(number + count) < 20
    if not (digits and 1 <= int(number) <= int(count)):
        got = one_line(text, 60)
        raise UserError(
            f'--part must be a number and a count, from 1/N to N/N such as 3/16; got "{got}"'
        )
    return int(number), int(count)


def parse_size(text: str | None) -> tuple[int, int] | None:
    """Return width and height, pixels, given as "480x270".

    Raises:
        UserError: it has another form, or a side is not from 16 to 8192.
    """
    if text is None:
        return None
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(_is_side(p) for p in parts):
        got = one_line(text, 60)
        raise UserError(f'--size must be width x height such as 480x270, 16 to 8192; got "{got}"')
    return int(parts[0]), int(parts[1])


def _is_side(text: str) -> bool:
    return text.isdecimal() and len(text) < 9 and 16 <= int(text) <= 8192
