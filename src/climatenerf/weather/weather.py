"""The parameters of all effects at one moment. Does not import torch.

Values are SI floats (angles in radians); a flag or a weather file gives them with a unit. Every
section is always there, and its main value None means that the effect is absent. Colours are
display sRGB in [0, 1]. Compass directions run clockwise from +y (north where photos carry GPS).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from climatenerf.core.errors import UserError
from climatenerf.weather.effect import Effect
from climatenerf.weather.registry import EFFECTS
from climatenerf.weather.units import number

_SEED = number(0, 2**63 - 1)


class Weather:
    """Everything that is put into the scene, in any combination; immutable.

    A section is an attribute named as its effect: `weather.flood.level`.

    Attributes:
        sections: parameters of each effect, by name.
        seed: random seed of waves and snow, 0 to 2^63 - 1.
    """

    sections: Mapping[str, Any]
    seed: int
    __slots__ = ("sections", "seed")

    def __init__(self, *, seed: int = 0, effects: Sequence[Effect] = EFFECTS, **sections: Any):
        """Takes sections by name, `Weather(flood=Flood(level=0.5))`; others get their defaults."""
        known = {effect.name: effect for effect in effects}
        for name, section in sections.items():
            if name not in known:
                raise TypeError(
                    f"no weather effect is named {name!r}; there are {', '.join(known)}"
                )
            if not isinstance(section, known[name].parameters):
                raise TypeError(
                    f"{name} must be a {known[name].parameters.__name__}; got {section!r}"
                )
        defaults = {name: effect.parameters() for name, effect in known.items()}
        object.__setattr__(self, "sections", defaults | sections)
        object.__setattr__(self, "seed", seed)

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError("weather is immutable; use with_value")

    def __getattr__(self, name: str) -> Any:
        try:
            return self.sections[name]
        except KeyError:
            raise AttributeError(f"no weather effect is named {name!r}") from None

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Weather):
            return NotImplemented
        return (self.sections, self.seed) == (other.sections, other.seed)

    def __hash__(self) -> int:
        return hash((tuple(self.sections.items()), self.seed))

    def __repr__(self) -> str:
        given = [f"{name}={section!r}" for name, section in self.sections.items()]
        return f"Weather({', '.join([*given, f'seed={self.seed}'])})"

    def __getstate__(self) -> tuple[Mapping[str, Any], int]:
        return self.sections, self.seed

    def __setstate__(self, state: tuple[Mapping[str, Any], int]) -> None:
        object.__setattr__(self, "sections", state[0])
        object.__setattr__(self, "seed", state[1])

    def value(self, name: str) -> Any:
        """The value of "flood.wind_speed", of a whole section "flood", or of "seed"."""
        if name == "seed":
            return self.seed
        section, _, item = name.partition(".")
        return getattr(self.sections[section], item) if item else self.sections[section]

    def with_value(self, name: str, value: Any) -> "Weather":
        """The same weather with one value changed, named as `value` names it."""
        sections, seed = dict(self.sections), self.seed
        section, _, item = name.partition(".")
        if name == "seed":
            seed = value
        elif section not in sections:
            raise KeyError(name)
        else:
            sections[section] = replace(sections[section], **{item: value}) if item else value
        changed = object.__new__(Weather)
        changed.__setstate__((sections, seed))
        return changed

    def with_sections(self, effects: Sequence[Effect]) -> "Weather":
        """The same weather with a default section for each effect that it lacks."""
        missing = {e.name: e.parameters() for e in effects if e.name not in self.sections}
        changed = object.__new__(Weather)
        changed.__setstate__(({**self.sections, **missing}, self.seed))
        return changed

    def present(self, effects: Sequence[Effect] = EFFECTS) -> tuple[Effect, ...]:
        """The effects that these parameters put into the scene."""
        return tuple(effect for effect in effects if effect.present(self.sections[effect.name]))


def check(weather: Weather, effects: Sequence[Effect] = EFFECTS) -> Weather:
    """Check every value against its range.

    Returns:
        The same weather, so that the call can be chained.

    Raises:
        UserError: a value lies outside its range, is not finite, or contradicts another one.
    """
    for effect in effects:
        section, defaults = weather.sections[effect.name], effect.defaults()
        for one, other in effect.alternatives:
            given = [defaults[name] is None and getattr(section, name) is not None
                     for name in (one, other)]  # fmt: skip
            if all(given):
                raise UserError(
                    f"--{effect.name}.{one} and --{effect.name}.{other} say the same thing: give"
                    " only one"
                )
        for name, parameter in effect.fields().items():
            parameter.check(getattr(section, name), f"{effect.name}.{name}")
    _SEED.check(weather.seed, "seed")
    return weather
