"""The weather file: the same sections and names as the flags, in TOML.

    seed = 7
    [flood]
    level = { "0 s" = "0 m", "4 s" = "0.8 m" }   # keyframes, linear in between
    wind-speed = "6 m/s"
    [smog]
    visibility = "200 m"

Loads no torch.
"""

import difflib
import tomllib
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from climatenerf.core.errors import UserError
from climatenerf.weather.parameters import Weather, check, kind_of
from climatenerf.weather.units import DURATION, format_quantity, parse_quantity

Keyframes = tuple[tuple[float, Any], ...]


@dataclass(frozen=True)
class KeyframedWeather:
    """Weather whose values may change with time.

    Attributes:
        base: all values that do not change (keyframed ones hold their first value).
        keyframes: for "section.field", the times in s, ascending, with their values.
    """

    base: Weather
    keyframes: Mapping[str, Keyframes]

    def at(self, time: float) -> Weather:
        """The weather `time` seconds into the movie; the end values hold before and after."""
        weather = self.base
        for name, frames in self.keyframes.items():
            weather = _with(weather, name, _interpolate(frames, time))
        return weather


def read_weather(path: Path) -> KeyframedWeather:
    """Read a weather file.

    Raises:
        UserError: the file cannot be read, is not TOML, names something unknown (the nearest valid
            name is offered), or holds a value of the wrong dimension or outside its range.
    """
    try:
        with path.open("rb") as file:
            table = tomllib.load(file)
    except OSError as error:
        raise UserError(
            f"cannot read the weather file {path}: {error.strerror}; check the path"
        ) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UserError(
            f"the weather file {path} is not valid TOML: {error}; correct it"
        ) from error
    try:
        return weather_from_table(table)
    except UserError as error:
        raise UserError(f"in the weather file {path}: {error}") from error


def weather_from_table(table: Mapping[str, Any]) -> KeyframedWeather:
    """Turn the tables of a weather file, or of a sidecar, into weather; the errors are the same."""
    weather, keyframes = Weather(), {}
    sections = {section.name: getattr(weather, section.name) for section in fields(Weather)}
    for title, entries in table.items():
        section = _known(title, list(sections), "section")
        if section == "seed":
            weather = replace(weather, seed=_integer(entries))
            continue
        if not isinstance(entries, Mapping):
            raise UserError(f"[{section}] wants a table of values; got {entries!r}")
        items = {item.name: item for item in fields(sections[section])}
        for key, raw in entries.items():
            item = items[_known(key, list(items), f"key in [{section}]")]
            name = f"{section}.{item.name}"
            if isinstance(raw, Mapping):
                keyframes[name] = _read_keyframes(name, item, raw)
                weather = _with(weather, name, keyframes[name][0][1])
            else:
                weather = _with(weather, name, _read_value(name, item, raw))
    for name, frames in keyframes.items():
        for _, value in frames:
            check(_with(weather, name, value))
    return KeyframedWeather(check(weather), keyframes)


def weather_to_table(weather: Weather | KeyframedWeather) -> dict[str, Any]:
    """Plain tables for JSON or TOML, with units; values that are None are left out.

    `weather_from_table` turns them back into equal weather.
    """
    film = weather if isinstance(weather, KeyframedWeather) else KeyframedWeather(weather, {})
    table: dict[str, Any] = {"seed": film.base.seed}
    for section in fields(Weather):
        if section.name == "seed":
            continue
        entries = {}
        value = getattr(film.base, section.name)
        for item in fields(value):
            frames = film.keyframes.get(f"{section.name}.{item.name}")
            key = item.name.replace("_", "-")
            if frames is not None:
                entries[key] = {
                    format_quantity(t, DURATION): _write_value(item, v) for t, v in frames
                }
            elif getattr(value, item.name) is not None:
                entries[key] = _write_value(item, getattr(value, item.name))
        table[section.name] = entries
    return table


def given_flags(arguments: Sequence[str]) -> frozenset[str]:
    """Names ("flood.wind_speed", "seed") of the weather flags in a command line's arguments."""
    names = {"seed"} | {
        f"{section.name}.{item.name}"
        for section in fields(Weather)
        if section.name != "seed"
        for item in fields(getattr(Weather(), section.name))
    }
    words = (word[2:].split("=")[0].replace("-", "_") for word in arguments if word[:2] == "--")
    return frozenset(names.intersection(words))


def combine(
    film: KeyframedWeather | None, flags: Weather, given: frozenset[str]
) -> KeyframedWeather:
    """Weather of a file with flags on top: a flag replaces the file's value and its keyframes.

    Args:
        film: weather file, if any.
        flags: values of all flags, given or not.
        given: names of those that were given, from `given_flags`.

    Raises:
        UserError: file and flags contradict each other.
    """
    if film is None:
        return KeyframedWeather(check(flags), {})
    weather = film.base
    for name in sorted(given):
        weather = _with(weather, name, _get(flags, name))
    # Two words for one thing: the flag replaces the file's other word. (Attenuation alone decides
    # where it is given, so a flag for it needs nothing dropped.)
    dropped = set(given)
    for said, other in (
        ("smog.visibility", "smog.sigma"),
        ("smog.sigma", "smog.visibility"),
        ("flood.clarity", "flood.attenuation"),
    ):
        if said in given and other not in given:
            weather = _with(weather, other, None)
            dropped.add(other)
    keyframes = {name: frames for name, frames in film.keyframes.items() if name not in dropped}
    return KeyframedWeather(check(weather), keyframes)


def _known(name: str, valid: list[str], what: str) -> str:
    plain = name.replace("-", "_")
    if plain in valid:
        return plain
    near = difflib.get_close_matches(plain, valid, n=1, cutoff=0)[0].replace("_", "-")
    raise UserError(f'unknown {what} "{name}"; did you mean "{near}"?')


def _read_value(name: str, item: Any, raw: Any) -> Any:
    where, kind = name.replace("_", "-"), kind_of(item.type)
    if kind is not None:
        if not isinstance(raw, str):
            raise UserError(f'{where} wants {kind.name} such as "{kind.example}"; got {raw}')
        if raw.strip().lower() == "none" and item.default is None:
            return None
        return parse_quantity(raw, kind, where)
    if item.type is float:
        if isinstance(raw, bool) or not isinstance(raw, int | float):
            raise UserError(f"{where} wants a number; got {raw!r}")
        return float(raw)
    if raw == "none" and item.default is None:
        return None
    numbers = isinstance(raw, list | tuple) and len(raw) == 3
    if not numbers or any(isinstance(x, bool) or not isinstance(x, int | float) for x in raw):
        raise UserError(f"{where} wants three numbers such as [0.5, 0.4, 0.3]; got {raw!r}")
    return tuple(float(x) for x in raw)


def _read_keyframes(name: str, item: Any, raw: Mapping[str, Any]) -> Keyframes:
    where = name.replace("_", "-")
    if not raw:
        raise UserError(f"{where} has an empty table of keyframes; give it at least one time")
    times = {parse_quantity(text, DURATION, f"a time of {where}"): v for text, v in raw.items()}
    if len(times) < len(raw):
        raise UserError(f"{where} names the same time twice")
    frames = tuple((t, _read_value(name, item, times[t])) for t in sorted(times))
    if any(value is None for _, value in frames):
        raise UserError(
            f'{where} has "none" in a keyframe; there is nothing between it and a value'
        )
    return frames


def _write_value(item: Any, value: Any) -> Any:
    kind = kind_of(item.type)
    if kind is not None:
        return format_quantity(value, kind)
    return list(value) if isinstance(value, tuple) else value


def _integer(raw: Any) -> int:
    if isinstance(raw, bool) or not isinstance(raw, int):
        raise UserError(f"seed wants a whole number; got {raw!r}")
    return raw


def _get(weather: Weather, name: str) -> Any:
    section, _, item = name.partition(".")
    value = getattr(weather, section)
    return getattr(value, item) if item else value


def _with(weather: Weather, name: str, value: Any) -> Weather:
    section, _, item = name.partition(".")
    if item:
        value = replace(getattr(weather, section), **{item: value})
    return replace(weather, **{section: value})


def _interpolate(frames: Keyframes, time: float) -> Any:
    i = bisect_right([t for t, _ in frames], time)
    if i == 0 or i == len(frames):
        return frames[min(i, len(frames) - 1)][1]
    (t0, a), (t1, b) = frames[i - 1], frames[i]
    share = (time - t0) / (t1 - t0)
    if isinstance(a, tuple):
        return tuple((1 - share) * x + share * y for x, y in zip(a, b, strict=True))
    return (1 - share) * a + share * b


def to_toml(table: Mapping[str, Any]) -> str:
    """Text of a weather file for the tables of `weather_to_table`."""
    lines = [f"seed = {table['seed']}"]
    for section, entries in table.items():
        if isinstance(entries, Mapping):
            lines += ["", f"[{section}]", *(f"{k} = {_toml(v)}" for k, v in entries.items())]
    return "\n".join(lines) + "\n"


def _toml(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f'"{k}" = {_toml(v)}' for k, v in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(_toml(x) for x in value) + "]"
    if isinstance(value, str):
        return f'"{value}"'
    return repr(value)
