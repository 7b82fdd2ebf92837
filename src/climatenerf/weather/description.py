"""The weather file: the same sections and names as the flags, in TOML.

    seed = 7
    [flood]
    level = { "0 s" = "0 m", "4 s" = "0.8 m" }   # keyframes, linear in between
    wind-speed = "6 m/s"
    [smog]
    visibility = "200 m"

Sections, names, units and ranges come from the effects. Does not import torch.
"""

import difflib
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import tomli_w

from climatenerf.core.errors import UserError, excerpt, one_line
from climatenerf.core.parsing import read_toml
from climatenerf.weather.effect import Effect
from climatenerf.weather.registry import EFFECTS, parameters
from climatenerf.weather.units import DURATION, Parameter, format_quantity, parse_quantity
from climatenerf.weather.weather import Weather, check

MAX_KEYFRAMES = 10_000
Keyframes = tuple[tuple[float, Any], ...]


@dataclass(frozen=True)
class KeyframedWeather:
    """Weather whose values may change with time.

    Attributes:
        base: all values that do not change; keyframed ones have their first value.
        keyframes: for "section.field", the times in s, ascending, with their values.
    """

    base: Weather
    keyframes: Mapping[str, Keyframes]

    def frozen(self, effects: Sequence[Effect]) -> list[str]:
        """Keyframed values that effects read once for a movie."""
        once = {name for effect in effects for name in effect.prepared_from
                if name.startswith(f"{effect.name}.")}  # fmt: skip
        return sorted(once & set(self.keyframes))

    @property
    def duration(self) -> float:
        """Time of the last keyframe, s; 0 without keyframes."""
        return max((frames[-1][0] for frames in self.keyframes.values()), default=0.0)

    def at(self, time: float) -> Weather:
        """The weather `time` seconds into the movie; the end values hold before and after."""
        weather = self.base
        for name, frames in self.keyframes.items():
            weather = weather.with_value(name, _interpolate(frames, time))
        return weather


def for_effects(weather: Weather | KeyframedWeather, effects: Sequence[Effect]) -> KeyframedWeather:
    """Weather over time with a section for each effect.

    Sections of other effects stay if they have their defaults.

    Raises:
        UserError: a section has values that no effect would render.
    """
    film = weather if isinstance(weather, KeyframedWeather) else KeyframedWeather(weather, {})
    known = {effect.name for effect in effects}
    keyframed = {name.partition(".")[0] for name in film.keyframes}
    for name, section in film.base.sections.items():
        if name not in known and (name in keyframed or section != type(section)()):
            raise UserError(
                f"the weather has a section {name!r} that no effect renders (there are"
                f" {', '.join(sorted(known)) or 'none'}); pass effects= with its Effect, or install"
                " its package"
            )
    return replace(film, base=film.base.with_sections(effects))


def read_weather(path: Path, effects: Sequence[Effect] = EFFECTS) -> KeyframedWeather:
    """Read a weather file.

    Raises:
        UserError: the file cannot be read, is not TOML, names something unknown (the message offers
            the nearest valid name), or holds a value of the wrong dimension or outside its range.
    """
    table = read_toml(path, "the weather file")
    try:
        return weather_from_table(table, effects)
    except UserError as error:
        raise UserError(f"in the weather file {path}: {error}") from error


def weather_from_table(
    table: Mapping[str, Any], effects: Sequence[Effect] = EFFECTS
) -> KeyframedWeather:
    """Turn tables of a weather file or a sidecar into weather; errors as in `read_weather`."""
    weather, keyframes = Weather(effects=effects), {}
    known = {effect.name: effect.fields() for effect in effects}
    for title, entries in table.items():
        section = _nearest(title, [*known, "seed"], "section")
        if section == "seed":
            weather = weather.with_value("seed", _integer(entries))
            continue
        if not isinstance(entries, Mapping):
            raise UserError(f"[{section}] must be a table of values; got {excerpt(entries)}")
        for key, raw in entries.items():
            item = _nearest(key, list(known[section]), f"key in [{section}]")
            name, parameter = f"{section}.{item}", known[section][item]
            if isinstance(raw, Mapping):
                keyframes[name] = _read_keyframes(name, parameter, raw)
                weather = weather.with_value(name, keyframes[name][0][1])
            else:
                weather = weather.with_value(name, parameter.read(raw, name.replace("_", "-")))
    for name, frames in keyframes.items():
        for _, value in frames:
            check(weather.with_value(name, value), effects)
    return KeyframedWeather(check(weather, effects), keyframes)


def weather_to_table(
    weather: Weather | KeyframedWeather, effects: Sequence[Effect] = EFFECTS
) -> dict[str, Any]:
    """Plain tables for JSON or TOML, with units; values that are None are left out.

    `weather_from_table` turns them back into equal weather.
    """
    film = weather if isinstance(weather, KeyframedWeather) else KeyframedWeather(weather, {})
    table: dict[str, Any] = {"seed": film.base.seed}
    for effect in effects:
        entries = table[effect.name] = {}
        for item, parameter in effect.fields().items():
            frames = film.keyframes.get(f"{effect.name}.{item}")
            value, key = film.base.value(f"{effect.name}.{item}"), item.replace("_", "-")
            if frames is not None:
                entries[key] = {format_quantity(t, DURATION): parameter.write(v) for t, v in frames}
            elif value is not None:
                entries[key] = parameter.write(value)
    return table


def weather_to_toml(
    weather: Weather | KeyframedWeather, effects: Sequence[Effect] = EFFECTS
) -> str:
    """Return a weather file, without the values that are the defaults; `read_weather` reads it."""
    table = weather_to_table(weather, effects)
    plain = weather_to_table(Weather(effects=effects), effects)
    changed: dict[str, Any] = {"seed": table["seed"]} if table["seed"] != plain["seed"] else {}
    for effect in effects:
        entries = {
            key: value
            for key, value in table[effect.name].items()
            if plain[effect.name].get(key) != value
        }
        if entries:
            changed[effect.name] = entries
    return tomli_w.dumps(changed)


def from_moments(
    moments: Mapping[float, Weather], effects: Sequence[Effect] = EFFECTS
) -> KeyframedWeather:
    """Return the weather that passes through that of some moments.

    Args:
        moments: by time in s, at least one.
        effects: the effects in use.

    Raises:
        UserError: a value is "none" at one moment and given at another.
    """
    times = sorted(moments)
    first = moments[times[0]]
    keyframes: dict[str, Keyframes] = {}
    for effect in effects:
        for item in effect.fields():
            name = f"{effect.name}.{item}"
            values = [moments[time].value(name) for time in times]
            if all(value == values[0] for value in values):
                continue
            if None in values:
                raise UserError(
                    f"{name.replace('_', '-')} has no value at {times[values.index(None)]:g} s, but"
                    " one at another keyframe; give it one at each"
                )
            keyframes[name] = tuple(zip(times, values, strict=True))
    return KeyframedWeather(first, keyframes)


def given_flags(arguments: Sequence[str], effects: Sequence[Effect] = EFFECTS) -> frozenset[str]:
    """Names ("flood.wind_speed", "seed") of the weather flags in a command line's arguments."""
    names = {"seed", *parameters(effects)}
    words = (word[2:].split("=")[0].replace("-", "_") for word in arguments if word[:2] == "--")
    return frozenset(names.intersection(words))


def combine(
    film: KeyframedWeather | None,
    flags: Weather,
    given: frozenset[str],
    effects: Sequence[Effect] = EFFECTS,
) -> KeyframedWeather:
    """Weather of a file with flags on top: a flag replaces the file's value and its keyframes.

    Args:
        film: weather file, if any.
        flags: values of all flags, given or not.
        given: names of those that were given, from `given_flags`.
        effects: the effects in use.

    Raises:
        UserError: file and flags contradict each other.
    """
    for effect in effects:
        for one, other in effect.alternatives:
            if {f"{effect.name}.{one}", f"{effect.name}.{other}"} <= given:
                raise UserError(
                    f"--{effect.name}.{one} and --{effect.name}.{other} say the same thing: give"
                    " only one"
                )
    if film is None:
        return KeyframedWeather(check(flags, effects), {})
    weather = film.base
    for name in sorted(given):
        weather = weather.with_value(name, flags.value(name))
    replaced = set(given)
    for effect in effects:
        defaults = effect.defaults()
        for pair in effect.alternatives:
            for one, other in (pair, pair[::-1]):
                other_name = f"{effect.name}.{other}"
                if f"{effect.name}.{one}" in given and other_name not in given:
                    weather = weather.with_value(other_name, defaults[other])
                    replaced.add(other_name)
    keyframes = {name: frames for name, frames in film.keyframes.items() if name not in replaced}
    return KeyframedWeather(check(weather, effects), keyframes)


def without_effect(
    film: KeyframedWeather, given: frozenset[str], effects: Sequence[Effect] = EFFECTS
) -> dict[str, str]:
    """Flags that change nothing in the whole movie, with the flags that they would need."""
    found = {}
    for effect in effects:
        keyframed = any(key.startswith(f"{effect.name}.") for key in film.keyframes)
        section = film.base.sections[effect.name]
        for name, needed in _unmet(film, effect):
            if f"{effect.name}.{name}" in given:
                flag = _flag(effect, name)
                found[flag] = f"{found[flag]} and {needed}" if flag in found else needed
        if not effect.enabled_by or keyframed or effect.present(section):
            continue
        enabling = " or ".join(f"--{effect.name}.{name}" for name in effect.enabled_by)
        for name in sorted(given):
            if name.startswith(f"{effect.name}."):
                found[name.replace("_", "-")] = enabling
    return found


def _unmet(film: KeyframedWeather, effect: Effect) -> Iterator[tuple[str, str]]:
    """Fields that change nothing at any moment, with the flags that they would need."""

    def ever(name: str) -> set[Any]:
        """All values of a field, at the ends of which a movie passes from one to the next."""
        frames = film.keyframes.get(f"{effect.name}.{name}", ())
        return {getattr(film.base.sections[effect.name], name), *(value for _, value in frames)}

    for name, other, values in effect.only_with:
        if ever(other).isdisjoint(values):
            words = ("none" if value is None else value for value in values)
            yield name, " or ".join(f"--{_flag(effect, other)} {word}" for word in words)
    defaults = effect.defaults()
    for name, others in effect.only_beside:
        if all(ever(other) == {defaults[other]} for other in others):
            yield name, " or ".join(f"--{_flag(effect, other)}" for other in others)


def _flag(effect: Effect, name: str) -> str:
    return f"{effect.name}.{name}".replace("_", "-")


def _nearest(name: str, valid: list[str], what: str) -> str:
    plain = name.replace("-", "_")
    if plain in valid:
        return plain
    near = difflib.get_close_matches(plain[:60], valid, n=1, cutoff=0)[0].replace("_", "-")
    raise UserError(f'unknown {what} "{one_line(name, 60)}"; did you mean "{near}"?')


def _read_keyframes(name: str, parameter: Parameter, raw: Mapping[str, Any]) -> Keyframes:
    where = name.replace("_", "-")
    if not raw:
        raise UserError(f"{where} has an empty table of keyframes; give it at least one time")
    if len(raw) > MAX_KEYFRAMES:
        raise UserError(
            f"{where} has {len(raw)} keyframes, more than the {MAX_KEYFRAMES} that can be read;"
            " leave some out"
        )
    times = {parse_quantity(text, DURATION, f"a time of {where}"): v for text, v in raw.items()}
    if len(times) < len(raw):
        raise UserError(f"{where} names the same time twice")
    frames = tuple((t, parameter.read(times[t], where)) for t in sorted(times))
    if any(value is None for _, value in frames):
        raise UserError(
            f'{where} has "none" in a keyframe; there is nothing between it and a value'
        )
    return frames


def _integer(raw: Any) -> int:
    if isinstance(raw, bool) or not isinstance(raw, int):
        raise UserError(f"seed must be a whole number; got {excerpt(raw)}")
    return raw


def _interpolate(frames: Keyframes, time: float) -> Any:
    i = bisect_right([t for t, _ in frames], time)
    if i == 0 or i == len(frames):
        return frames[min(i, len(frames) - 1)][1]
    (t0, a), (t1, b) = frames[i - 1], frames[i]
    if isinstance(a, str):
        return a  # a word holds until the next keyframe
    fraction = (time - t0) / (t1 - t0)
    if isinstance(a, tuple):
        return tuple((1 - fraction) * x + fraction * y for x, y in zip(a, b, strict=True))
    return (1 - fraction) * a + fraction * b
