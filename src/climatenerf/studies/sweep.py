"""Sweeps of a weather parameter: the same picture for several values, in one strip.

After the figures of the paper's supplement that show how its simulation is controlled. Each value
has a response, a number of its picture that the parameter should move in one direction.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

import climatenerf
from climatenerf.core.colour import luma
from climatenerf.core.errors import UserError, one_line
from climatenerf.core.storage import write_json
from climatenerf.output.contact_sheet import contact_sheet, labelled_grid, write_jpeg
from climatenerf.output.video import SIMULATED, write_png
from climatenerf.render.session import Frame, RenderSession
from climatenerf.studies.shot import Shot
from climatenerf.studies.study_folder import SCHEMA_VERSION, remove_left_over
from climatenerf.weather.description import (
    KeyframedWeather,
    combine,
    weather_to_table,
    without_effect,
)
from climatenerf.weather.effect import Effect
from climatenerf.weather.flood.parameters import Flood
from climatenerf.weather.light.parameters import Sky
from climatenerf.weather.registry import parameters
from climatenerf.weather.season.parameters import Season
from climatenerf.weather.smog.parameters import Smog
from climatenerf.weather.snow.parameters import Snow
from climatenerf.weather.units import Choice, Folder, Parameter
from climatenerf.weather.weather import Weather

INDEX, SHEET = "sweep.json", "sweep.jpg"
CELL, SMALL_CELL = 384, 256  # width of a picture in a strip and in the sheet, pixels
MAX_STRIP, MAX_SHEET = 400_000, 900_000  # bytes
MAX_VALUES = 20
MIN_CHANGE = 2.0  # RMS difference of the ends, in 1/255, that an eye can see
WATER = 0.5  # fraction of water from which a pixel counts as water

USUAL: dict[str, Any] = {
    "smog": Smog(visibility=100.0),
    "flood": Flood(level=0.5),
    "snow": Snow(depth=0.15),
    "season": Season(kind="autumn"),
    "sky": Sky(kind="clear"),
}
"""What a parameter of an effect is swept in, where no weather is given."""

PAPER = (
    ("smog.visibility=400 m,150 m,80 m,40 m,20 m", Smog()),
    ("smog.colour=.9 .9 .92,.9 .86 .8,.88 .8 .66,.86 .72 .5,.84 .64 .34", Smog(visibility=60.0)),
    ("flood.level=10 cm,30 cm,50 cm,75 cm,1 m", Flood()),
    ("flood.clarity=10 cm,30 cm,1 m,3 m,10 m", Flood(level=0.5)),
    ("flood.colour=.1 .3 .34,.2 .33 .33,.3 .36 .32,.4 .38 .3,.5 .4 .28", Flood(level=0.5)),
    ("flood.wave-scale=0.5,1,2,4,8", Flood(level=0.5, wind_speed=3.0)),
    ("flood.wind-speed=1 m/s,2 m/s,4 m/s,7 m/s,12 m/s", Flood(level=0.5, fetch=200.0)),
    ("flood.fetch=10 m,30 m,100 m,1 km,10 km", Flood(level=0.5, wind_speed=5.0)),
    ("flood.ior=1.05,1.15,1.333,1.6,2", Flood(level=0.5)),
    ("snow.depth=1 cm,3 cm,10 cm,25 cm,50 cm", Snow()),
)
"""The rows of the paper, and the effect in which each is swept."""


@dataclass(frozen=True)
class Response:
    """A number of a picture.

    Attributes:
        name: with its unit at the end.
        of: the number, from the picture's frame and the frame of the first value.
        layers: names of layers on demand that it reads.
    """

    name: str
    of: Callable[[Frame, Frame], float]
    layers: tuple[str, ...] = ()


@dataclass(frozen=True)
class Sweep:
    """A parameter, its values, and all that stays.

    Attributes:
        name: such as "flood.wind_speed".
        texts: the values as they were given.
        weathers: the weather of each value.
    """

    name: str
    texts: tuple[str, ...]
    weathers: tuple[Weather, ...]

    @property
    def flag(self) -> str:
        """The parameter as flags and files name it, such as "flood.wind-speed"."""
        return self.name.replace("_", "-")

    @property
    def strip(self) -> str:
        """File name of the strip."""
        return f"{self.flag}.jpg"

    def picture(self, index: int) -> str:
        """File name of the picture of a value."""
        return f"{self.flag}-{index + 1:02d}.png"

    @property
    def files(self) -> list[str]:
        """All files of the sweep."""
        return [self.strip, *(self.picture(i) for i in range(len(self.texts)))]


@dataclass(frozen=True)
class Swept:
    """The pictures of a sweep and what they show.

    Attributes:
        sweep: what was asked for.
        response: name of the number.
        values: of the response, one a picture.
        pictures: one a value.
    """

    sweep: Sweep
    response: str
    values: tuple[float, ...]
    pictures: tuple[UInt8[np.ndarray, "h w 3"], ...]

    @property
    def monotone(self) -> bool:
        """Whether each value moves the response in the same direction as the one before."""
        steps = np.diff(self.values)
        return bool((steps > 0).all() or (steps < 0).all())

    @property
    def change(self) -> float:
        """RMS difference of the first and the last picture, in 1/255."""
        return difference(self.pictures[0], self.pictures[-1])


def line(swept: Swept) -> str:
    """Return the responses of a sweep as a line for people."""
    values = ", ".join(f"{value:.3g}" for value in swept.values)
    monotone = "" if swept.monotone else " NOT MONOTONE"
    change = f"the ends differ by {swept.change:.1f}/255"
    if swept.change <= MIN_CHANGE:
        change += ", WHICH IS INVISIBLE"
    return f"{swept.sweep.flag}: {swept.response} {values}{monotone}; {change}"


def difference(one: UInt8[np.ndarray, "h w 3"], other: UInt8[np.ndarray, "h w 3"]) -> float:
    """Return the RMS difference of two display pictures, in 1/255."""
    return float(np.sqrt(np.mean((one.astype(np.float64) - other.astype(np.float64)) ** 2)))


# --- what to sweep --------------------------------------------------------------------------------


def read_sweep(text: str, weather: Weather | None, effects: Sequence[Effect]) -> Sweep:
    """Return the sweep that `NAME=VALUE,VALUE,...` asks for.

    Args:
        text: name of a weather flag without its dashes, and its values; the numbers of a colour
            have spaces between them.
        weather: all else; None: what `USUAL` has for the effect, else the photos' own.
        effects: those that are installed.

    Raises:
        UserError: there is no such parameter, a value is none of it, or it changes nothing.
    """
    given, equals, rest = text.partition("=")
    name, known = given.strip().removeprefix("--").replace("-", "_"), parameters(effects)
    if not equals or name not in known:
        got = one_line(text, 60)
        what = "is no NAME=VALUE,VALUE" if not equals else "names no weather flag"
        raise UserError(
            f'--sweep "{got}" {what}; give one such as smog.visibility="50 m,100 m,200 m", or paper'
        )
    flag, section = name.replace("_", "-"), name.partition(".")[0]
    texts = tuple(one_line(each) for each in rest.split(","))
    if not 2 <= len(texts) <= MAX_VALUES or not all(texts):
        raise UserError(
            f"--sweep {flag} needs from 2 to {MAX_VALUES} values with commas between them; got"
            f' "{one_line(rest, 60)}"'
        )
    values = [_value(each, known[name], flag) for each in texts]
    if weather is None:
        usual = {section: USUAL[section]} if section in USUAL else {}
        weather = Weather(effects=effects, **usual)
    film, changed = KeyframedWeather(weather, {}), frozenset({name})
    films = [combine(film, weather.with_value(name, v), changed, effects) for v in values]
    absent = [without_effect(each, changed, effects) for each in films]
    if all(absent):
        raise UserError(
            f"--sweep {flag} changes nothing without {next(iter(absent[0].values()))}; give it in a"
            " weather file with --weather"
        )
    return Sweep(name, texts, tuple(each.base for each in films))


def _value(text: str, parameter: Parameter, flag: str) -> Any:
    """Return a value as the flag would read it.

    Raises:
        UserError: it is none.
    """
    plain = parameter.kind is None and not isinstance(parameter, Choice | Folder)
    words = text.split() if plain else [text]
    none = parameter.optional and text.lower() == "none"
    try:
        if plain and len(words) != parameter.count and not none:
            raise ValueError(f'must be {parameter.metavar}; got "{text}"')
        return parameter.instance_from_str(words)
    except ValueError as error:
        reason = one_line(str(error), 200)
        if not reason.startswith("must be"):
            reason = f"must be a number ({reason})"
        raise UserError(f"--sweep {flag}: a value {reason}") from error


def paper_sweeps(effects: Sequence[Effect]) -> tuple[Sweep, ...]:
    """Return the rows of the paper, and those that its text names."""
    found = []
    for text, section in PAPER:
        given: dict[str, Any] = {text.partition(".")[0]: section}
        weather = Weather(effects=effects, **given)
        found.append(read_sweep(text, weather, effects))
    return tuple(found)


# --- responses ------------------------------------------------------------------------------------


def _mean(layer: str) -> Callable[[Frame, Frame], float]:
    return lambda frame, first: float(frame.layers[layer].astype(np.float64).mean())


def _change(frame: Frame, first: Frame) -> float:
    return difference(frame.picture, first.picture)


def _warmth(frame: Frame, first: Frame) -> float:
    """Mean red less blue, display values."""
    rgb = frame.picture.astype(np.float64).mean((0, 1))
    return float(rgb[0] - rgb[2])


def _luma(frame: Frame, first: Frame) -> float:
    return float(luma(frame.linear).mean())


def _wave_tilt(frame: Frame, first: Frame) -> float:
    """RMS angle between the water's normals and the vertical, degrees."""
    normal = frame.layers["normal"][frame.layers["mask_water"] > WATER]
    if not len(normal):
        return float("nan")
    return float(np.sqrt(np.mean(np.degrees(np.arccos(np.clip(normal[:, 2], -1, 1))) ** 2)))


def _wave_frequency(frame: Frame, first: Frame) -> float:
    """RMS change of the water's normals from pixel to pixel, over their RMS from the vertical."""
    wet, slope = frame.layers["mask_water"] > WATER, frame.layers["normal"][..., :2]
    pairs = wet[:, 1:] & wet[:, :-1]
    steps = (slope[:, 1:] - slope[:, :-1])[pairs]
    if not pairs.any() or not slope[wet].any():
        return float("nan")
    return float(np.sqrt((steps**2).sum(-1).mean() / (slope[wet] ** 2).sum(-1).mean()))


CHANGE = Response("difference_from_first_255", _change)
_TRANSMITTANCE = Response("mean_transmittance", _mean("transmittance"))
_WARMTH = Response("red_less_blue_255", _warmth)
RESPONSES = {
    "smog.visibility": _TRANSMITTANCE,
    "smog.sigma": _TRANSMITTANCE,
    "smog.colour": _WARMTH,
    "flood.level": Response("water_share", _mean("mask_water")),
    "flood.colour": _WARMTH,
    "flood.wave_scale": Response("wave_frequency_1_px", _wave_frequency, ("normal",)),
    "flood.wind_speed": Response("wave_tilt_deg", _wave_tilt, ("normal",)),
    "flood.fetch": Response("wave_frequency_1_px", _wave_frequency, ("normal",)),
    "flood.ior": Response("mean_radiance", _luma),
    "snow.depth": Response("mean_snow_thickness_m", _mean("snow_thickness")),
}
"""What shows each parameter of the paper; any other is shown by the change of the picture."""


# --- rendering ------------------------------------------------------------------------------------


def render_sweep(
    sweep: Sweep, shot: Shot, session: RenderSession, progress: Callable[[str], None]
) -> Swept:
    """Render the picture of each value and measure its response.

    Args:
        sweep: the parameter and its values.
        shot: camera and moment.
        session: of the place; its weather is changed.
        progress: called with the value that is rendered.
    """
    response = RESPONSES.get(sweep.name, CHANGE)
    first, values, pictures = None, [], []
    for text, weather in zip(sweep.texts, sweep.weathers, strict=True):
        progress(f"{sweep.flag} {text}")
        session.change(weather)
        frame = session.frame(shot.camera, shot.c2w, shot.time, layers=response.layers)
        first = frame if first is None else first
        values.append(response.of(frame, first))
        pictures.append(frame.picture)
    return Swept(sweep, response.name, tuple(values), tuple(pictures))


def sweep_files(sweeps: Sequence[Sweep]) -> list[str]:
    """Return the files that sweeps write."""
    return [INDEX, SHEET, *(name for sweep in sweeps for name in sweep.files)]


def kind_of(sweeps: Sequence[Sweep]) -> str:
    """Return the kind of study, by which its folder is known: of the same parameters."""
    return f"sweep of {', '.join(sweep.flag for sweep in sweeps)}"


def write_sweeps(
    sweeps: Sequence[Sweep],
    shot: Shot,
    out: Path,
    about: dict[str, Any],
    progress: Callable[[str], None],
    earlier: set[str],
) -> Iterator[Swept]:
    """Render sweeps into a folder; return each as its strip is written.

    Args:
        sweeps: of different parameters.
        shot: camera and moment.
        out: an existing folder, locked and checked.
        about: what was rendered, for the index.
        progress: called with each parameter and value.
        earlier: files of an earlier study in the folder, which are removed before the first new
            one.
    """
    session = shot.session(sweeps[0].weathers[0])
    done: list[Swept] = []
    kind, files = kind_of(sweeps), sweep_files(sweeps)
    for sweep in sweeps:
        swept = render_sweep(sweep, shot, session, progress)
        if not done:  # strips of another size or view must not stay among the new ones
            remove_left_over(out, earlier - {INDEX}, ())
        done.append(swept)
        # Before the pictures: by the index they are known as those of a study.
        write_json(out / INDEX, _index(done, about, kind, files, session.effects))
        labelled = list(zip(sweep.texts, swept.pictures, strict=True))
        for index, (text, picture) in enumerate(labelled):
            write_png(out / sweep.picture(index), picture, f"{sweep.flag} {text}; {SIMULATED}")
        # The first label also names the parameter.
        strip = [(f"{sweep.flag} {labelled[0][0]}", labelled[0][1]), *labelled[1:]]
        write_jpeg(out / sweep.strip, labelled_grid(strip, len(strip), CELL), MAX_STRIP)
        yield swept
    rows = [
        (f"{each.sweep.flag}: {each.sweep.texts[0]} to {each.sweep.texts[-1]}", each.pictures)
        for each in done
    ]
    write_jpeg(out / SHEET, contact_sheet(rows, cell_width=SMALL_CELL), MAX_SHEET)


def _index(
    done: Sequence[Swept],
    about: dict[str, Any],
    kind: str,
    files: list[str],
    effects: Sequence[Effect],
) -> dict[str, Any]:
    return {
        "schema_version": SCHEMA_VERSION,
        "climatenerf": climatenerf.__version__,
        "study": kind,
        **about,
        "files": files,
        "sweeps": [
            {
                "name": swept.sweep.flag,
                "strip": swept.sweep.strip,
                "response": swept.response,
                "monotone": swept.monotone,
                "ends_differ_255": swept.change,
                "weather": weather_to_table(swept.sweep.weathers[0], effects),
                "values": [
                    {"value": text, "picture": swept.sweep.picture(index), "response": value}
                    for index, (text, value) in enumerate(
                        zip(swept.sweep.texts, swept.values, strict=True)
                    )
                ],
            }
            for swept in done
        ],
    }
