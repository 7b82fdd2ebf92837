"""Quantities with units, as users write them: `"0.5 m"`, `"6 m/s"`, `"35 deg"`.

Inside the program every quantity is a plain float in SI units (angles: radians). The types at the
end annotate dataclass fields so that tyro reads flags, and `weather.description` reads weather
files, through the same parser. Importing this module loads neither torch nor pint.
"""

import functools
import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

from tyro.constructors import PrimitiveConstructorSpec

from climatenerf.core.errors import UserError

if TYPE_CHECKING:
    import pint

# A number, then a unit. The unit's alphabet is small on purpose: whatever reaches the units library
# is short and holds no expression worth evaluating.
_QUANTITY = re.compile(
    r"\s*(?P<number>[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(?P<unit>[\w°/*^. -]{0,24}?)\s*"
)
_ANGLE_UNITS = ("degree", "radian", "milliradian", "arcminute", "arcsecond", "turn", "grade")


@dataclass(frozen=True)
class Kind:
    """One dimension that a user can give.

    Attributes:
        name: what the dimension is called in messages, with its article ("a length").
        metavar: the word shown in `--help`.
        example: a valid text, quoted in messages.
        unit: unit in which the value is written back.
        scale: SI value of one `unit`.
    """

    name: str
    metavar: str
    example: str
    unit: str
    scale: float = 1.0


LENGTH = Kind("a length", "LENGTH", "0.5 m", "m")
SPEED = Kind("a speed", "SPEED", "6 m/s", "m/s")
ANGLE = Kind("an angle", "ANGLE", "35 deg", "deg", math.pi / 180)
PER_LENGTH = Kind("a number per length", "PER-LENGTH", "0.02 1/m", "1/m")
DURATION = Kind("a duration", "DURATION", "4 s", "s")


@functools.lru_cache(maxsize=1)
def _registry() -> "pint.UnitRegistry":
    import pint

    return pint.UnitRegistry()


def parse_quantity(text: str, kind: Kind, where: str = "") -> float:
    """Read a quantity with its unit.

    Args:
        text: what the user wrote, for example `"10 cm"`.
        kind: the dimension that is wanted.
        where: name of the flag or of the entry in a file, put before the message.

    Returns:
        The value in SI units; angles in radians.

    Raises:
        UserError: no number, no unit, an unknown unit, another dimension, or a value that is not
            finite.
    """
    wants = f'{where} wants {kind.name} such as "{kind.example}"; got "{text}"'.lstrip()
    match = _QUANTITY.fullmatch(text)
    if match is None:
        raise UserError(wants)
    number, unit = float(match["number"]), re.sub(r"^(per |/)", "1/", match["unit"])
    if not unit:
        raise UserError(f"{wants}, which has no unit")
    registry = _registry()
    try:
        units = registry.parse_units(unit)
        if kind is ANGLE and str(units) not in _ANGLE_UNITS:
            raise UserError(wants)
        value = float(registry.Quantity(number, units).to(kind.unit).magnitude) * kind.scale
    except UserError:
        raise
    except Exception as error:  # pint fails in a dozen ways, down to errors of its tokeniser
        raise UserError(wants) from error
    if not math.isfinite(value):
        raise UserError(f"{wants}, which is not finite")
    return value


def format_quantity(value: float, kind: Kind) -> str:
    """Write an SI value back with its unit, so that `parse_quantity` returns the same float."""
    shown = value / kind.scale
    for digits in (6, 9, 12):  # 35 deg is written "35 deg", not "35.00000000000001 deg"
        rounded = round(shown, digits)
        if rounded * kind.scale == value:
            shown = rounded
            break
    return f"{shown:.0f} {kind.unit}" if _is_small_integer(shown) else f"{shown!r} {kind.unit}"


def _is_small_integer(value: float) -> bool:
    return abs(value) < 1e9 and value == int(value)


def _spec(kind: Kind, optional: bool) -> PrimitiveConstructorSpec[Any]:
    def instance_from_str(words: list[str]) -> float | None:
        text = words[0]
        if optional and text.strip().lower() == "none":
            return None
        try:
            return parse_quantity(text, kind)
        except UserError as error:
            raise ValueError(str(error)) from error  # tyro prints it and exits with status 2

    def is_instance(value: Any) -> bool:
        return (optional and value is None) or (
            isinstance(value, int | float) and not isinstance(value, bool)
        )

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=f'{kind.metavar}, e.g. "{kind.example}"',
        instance_from_str=instance_from_str,
        is_instance=is_instance,
        str_from_instance=lambda value: ["none" if value is None else format_quantity(value, kind)],
    )


Length = Annotated[float, _spec(LENGTH, False), LENGTH]
Speed = Annotated[float, _spec(SPEED, False), SPEED]
Angle = Annotated[float, _spec(ANGLE, False), ANGLE]
PerLength = Annotated[float, _spec(PER_LENGTH, False), PER_LENGTH]
Duration = Annotated[float, _spec(DURATION, False), DURATION]
OptionalLength = Annotated[float | None, _spec(LENGTH, True), LENGTH]
OptionalSpeed = Annotated[float | None, _spec(SPEED, True), SPEED]
OptionalAngle = Annotated[float | None, _spec(ANGLE, True), ANGLE]
OptionalPerLength = Annotated[float | None, _spec(PER_LENGTH, True), PER_LENGTH]
OptionalDuration = Annotated[float | None, _spec(DURATION, True), DURATION]
