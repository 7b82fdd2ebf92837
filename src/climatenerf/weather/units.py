"""Quantities with units, as users write them: `"0.5 m"`, `"6 m/s"`, `"35 deg"`.

Inside the program every quantity is a plain float in SI units (angles: radians). A `Parameter` in a
dataclass field's annotation states unit and range once: flags, help, weather files, keyframes and
checks all read it. Importing this module does not import torch or pint.
"""

import functools
import math
import re
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

from tyro.constructors import PrimitiveConstructorSpec

from climatenerf.core.errors import UserError, excerpt, one_line

if TYPE_CHECKING:
    import pint

# A number, then a unit. The alphabet of units is small on purpose: the text that reaches the units
# library is short and cannot hold an expression.
_QUANTITY = re.compile(
    r"\s*(?P<number>[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(?P<unit>[\w°/*^. -]{0,24}?)\s*"
)
MAX_TEXT = 200
"""Characters of a quantity."""
_ANGLE_UNITS = ("degree", "radian", "milliradian", "arcminute", "arcsecond", "turn", "grade")


@dataclass(frozen=True)
class Kind:
    """One physical dimension.

    Attributes:
        name: the dimension in messages, with its article ("a length").
        metavar: the word in `--help`.
        example: a valid text for messages.
        unit: unit in which values are written.
        scale: SI value of one `unit`.
    """

    name: str
    metavar: str
    example: str
    unit: str
    scale: float = 1.0


LENGTH = Kind("a length", "LENGTH", "0.5 m", "m")
SHORT_LENGTH = Kind("a length", "LENGTH", "0.5 mm", "mm", 1e-3)
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
        text: a number and a unit, for example `"10 cm"`.
        kind: the expected dimension.
        where: name of the flag or of the file's entry, which begins the message.

    Returns:
        The value in SI units; angles in radians.

    Raises:
        UserError: no number, no unit, an unknown unit, another dimension, or a value that is not
            finite.
    """
    got = one_line(text, 60)
    message = f'{where} must be {kind.name} such as "{kind.example}"; got "{got}"'.lstrip()
    # The time of the search grows with the square of the number of digits.
    match = _QUANTITY.fullmatch(text) if len(text) <= MAX_TEXT else None
    if match is None:
        raise UserError(message)
    number, unit = float(match["number"]), re.sub(r"^(per |/)", "1/", match["unit"])
    if not unit:
        raise UserError(f"{message}, which has no unit")
    registry = _registry()
    try:
        units = registry.parse_units(unit)
        if kind is ANGLE and str(units) not in _ANGLE_UNITS:
            raise UserError(message)
        value = float(registry.Quantity(number, units).to(kind.unit).magnitude) * kind.scale
    except UserError:
        raise
    except Exception as error:  # pint fails in a dozen ways, down to errors of its tokeniser
        raise UserError(message) from error
    if not math.isfinite(value):
        raise UserError(f"{message}, which is not finite")
    return value


def format_quantity(value: float, kind: Kind) -> str:
    """Write an SI value back with its unit, so that `parse_quantity` returns the same float."""
    number = value / kind.scale
    for digits in (6, 9, 12):  # 35 deg is written "35 deg", not "35.00000000000001 deg"
        rounded = round(number, digits)
        if rounded * kind.scale == value:
            number = rounded
            break
    return f"{number:.0f} {kind.unit}" if _is_small_integer(number) else f"{number!r} {kind.unit}"


def _is_small_integer(value: float) -> bool:
    return abs(value) < 1e9 and value == int(value)


class Parameter(PrimitiveConstructorSpec[Any]):
    """Unit and range of a dataclass field, as metadata of its annotation.

    `quantity`, `number` and `colour` make them. tyro reads flags through it, as through any of its
    constructor specifications.

    Attributes:
        kind: dimension; None: a plain number.
        low: least valid value, SI.
        high: greatest valid value, SI.
        count: how many numbers one value has, 1 or 3.
        optional: whether "none" is a value.
    """

    kind: Kind | None
    low: float
    high: float
    count: int
    optional: bool

    def __init__(
        self, kind: Kind | None, low: float, high: float, count: int = 1, optional: bool = False
    ):
        self.kind, self.low, self.high, self.count = kind, low, high, count
        self.optional = optional
        name = (
            f'{kind.metavar}, e.g. "{kind.example}"' if kind else "FLOAT" + " FLOAT" * (count - 1)
        )
        super().__init__(
            nargs=count,
            metavar=f"{name}; {self.range}" if math.isfinite(low) else name,
            instance_from_str=self._from_words,
            is_instance=self._is_instance,
            str_from_instance=self._to_words,
        )

    @property
    def range(self) -> str:
        """The valid range in words, in the unit in which values are written."""
        return f"{self.text(self.low)} to {self.text(self.high)}"

    def text(self, value: float) -> str:
        """One number with its unit, rounded for people."""
        if self.kind is None:
            return f"{value:g}"
        return f"{value / self.kind.scale:.6g} {self.kind.unit}"

    def _got(self, value: float) -> str:
        """One number of any size for a message."""
        try:
            return self.text(value)
        except OverflowError:
            return excerpt(value)

    def check(self, value: float | tuple[float, ...] | None, name: str) -> None:
        """Check a value against the range; `name` is the field's, such as "flood.wind_speed".

        Raises:
            UserError: outside the range, or not finite.
        """
        if value is None:
            return
        for number in value if isinstance(value, tuple) else (value,):
            # The slack forgives 360 deg in radians. A NaN fails every comparison.
            slack = 1e-12 * max(abs(self.low), abs(self.high)) if self.kind is not None else 0.0
            if not self.low - slack <= number <= self.high + slack:
                raise UserError(
                    f"--{name.replace('_', '-')} must lie between {self.text(self.low)} and"
                    f" {self.text(self.high)}; got {self._got(number)}"
                )

    def read(self, raw: Any, where: str) -> Any:
        """A value of a weather file; `where` begins the message.

        Raises:
            UserError: another type or dimension.
        """
        if self.optional and isinstance(raw, str) and raw.strip().lower() == "none":
            return None
        if self.kind is not None:
            if not isinstance(raw, str):
                message = f'{where} must be {self.kind.name} such as "{self.kind.example}"'
                raise UserError(f"{message}; got {excerpt(raw)}")
            return parse_quantity(raw, self.kind, where)
        if self.count == 1:
            if isinstance(raw, bool) or not isinstance(raw, int | float):
                raise UserError(f"{where} must be a number; got {excerpt(raw)}")
            return float(raw)
        numbers = isinstance(raw, list | tuple) and len(raw) == self.count
        if not numbers or any(isinstance(x, bool) or not isinstance(x, int | float) for x in raw):
            raise UserError(
                f"{where} must be three numbers such as [0.5, 0.4, 0.3]; got {excerpt(raw)}"
            )
        return tuple(float(x) for x in raw)

    def parse(self, text: str, where: str) -> Any:
        """A value typed as one text: "0.5 m", "0.5 0.4 0.3", "none"; `where` begins the message.

        Raises:
            UserError: another form or dimension.
        """
        words = text.replace(",", " ").split() if self.count > 1 else [text.strip()]
        none = self.optional and [word.lower() for word in words] == ["none"]
        try:
            if len(words) != self.count and not none:
                raise ValueError(f"must be {self.count} numbers; got {excerpt(text)}")
            return self._from_words(words)
        except ValueError as error:
            raise UserError(f"{where} {one_line(str(error), 200)}") from error

    def write(self, value: Any) -> Any:
        """The value as a weather file holds it; `read` returns it unchanged."""
        if self.kind is not None:
            return "none" if value is None else format_quantity(value, self.kind)
        return list(value) if isinstance(value, tuple) else value

    def _from_words(self, words: list[str]) -> Any:
        if self.optional and all(word.strip().lower() == "none" for word in words):
            return None
        try:
            if self.kind is not None:
                return parse_quantity(words[0], self.kind)
            values = tuple(float(word) for word in words)
        except UserError as error:
            raise ValueError(str(error)) from error  # tyro prints it and exits with status 2
        return values if self.count > 1 else values[0]

    def _is_instance(self, value: Any) -> bool:
        if value is None:
            return self.optional
        numbers = value if self.count > 1 and isinstance(value, tuple) else (value,)
        return len(numbers) == self.count and all(
            isinstance(x, int | float) and not isinstance(x, bool) for x in numbers
        )

    def _to_words(self, value: Any) -> list[str]:
        if value is None:
            return ["none"] * self.count
        if self.kind is not None:
            return [format_quantity(value, self.kind)]
        return [str(x) for x in (value if self.count > 1 else (value,))]


class Choice(Parameter):
    """One of several words, as metadata of a dataclass field's annotation.

    Attributes:
        words: the valid ones.
    """

    words: tuple[str, ...]

    def __init__(self, *words: str):
        self.words = words
        super().__init__(None, -math.inf, math.inf)
        object.__setattr__(self, "metavar", "{" + ",".join(words) + "}")

    def check(self, value: Any, name: str) -> None:
        """Check that a value is one of the words; see `Parameter.check`.

        Raises:
            UserError: it is another one.
        """
        if value not in self.words:
            raise UserError(
                f"--{name.replace('_', '-')} must be one of {', '.join(self.words)}; got"
                f" {excerpt(value)}"
            )

    def read(self, raw: Any, where: str) -> str:
        """A value of a weather file.

        Raises:
            UserError: none of the words.
        """
        if raw not in self.words:
            raise UserError(f"{where} must be one of {', '.join(self.words)}; got {excerpt(raw)}")
        return raw

    def write(self, value: str) -> str:
        """The word itself."""
        return value

    def text(self, value: Any) -> str:
        """The word itself."""
        return str(value)

    def _from_words(self, words: list[str]) -> str:
        if words[0] not in self.words:
            raise ValueError(f"must be one of {', '.join(self.words)}; got {excerpt(words[0])}")
        return words[0]

    def _is_instance(self, value: Any) -> bool:
        return value in self.words

    def _to_words(self, value: Any) -> list[str]:
        return [value]


class Folder(Parameter):
    """A folder of the user's, as metadata of a dataclass field's annotation; "none" without one."""

    def __init__(self) -> None:
        super().__init__(None, -math.inf, math.inf, optional=True)
        object.__setattr__(self, "metavar", "FOLDER")

    def check(self, value: Any, name: str) -> None:
        """Check that a value is a path or None; see `Parameter.check`.

        Raises:
            UserError: it is empty or something else.
        """
        if value is not None and not (isinstance(value, str) and value.strip()):
            raise UserError(f"--{name.replace('_', '-')} must be a folder; got {excerpt(value)}")

    def read(self, raw: Any, where: str) -> str | None:
        """A value of a weather file.

        Raises:
            UserError: no text.
        """
        if not isinstance(raw, str) or not raw.strip():
            raise UserError(f"{where} must be a folder; got {excerpt(raw)}")
        return None if raw.strip().lower() == "none" else raw

    def write(self, value: str | None) -> str:
        """The path itself."""
        return "none" if value is None else value

    def text(self, value: Any) -> str:
        """The path itself."""
        return str(value)

    def _from_words(self, words: list[str]) -> str | None:
        return None if words[0].strip().lower() == "none" else words[0]

    def _is_instance(self, value: Any) -> bool:
        return value is None or isinstance(value, str)

    def _to_words(self, value: Any) -> list[str]:
        return ["none" if value is None else value]


def folder() -> Folder:
    """A folder, or none."""
    return Folder()


def choice(*words: str) -> Choice:
    """One of several words."""
    return Choice(*words)


def quantity(
    kind: Kind, low: float = -math.inf, high: float = math.inf, optional: bool = False
) -> Parameter:
    """A number with a unit, from `low` to `high` (SI)."""
    return Parameter(kind, low, high, 1, optional)


def number(low: float, high: float, optional: bool = False) -> Parameter:
    """A plain number from `low` to `high`."""
    return Parameter(None, low, high, 1, optional)


def triple(low: float, high: float, optional: bool = False) -> Parameter:
    """Three numbers, such as red, green and blue, each from `low` to `high`."""
    return Parameter(None, low, high, 3, optional)


def parameters_of(section: type) -> dict[str, Parameter]:
    """The parameters of a dataclass by field name, in order.

    Raises:
        TypeError: a field has no `Parameter` in its annotation.
    """
    hints = get_type_hints(section, include_extras=True)
    found = {}
    for item in fields(section):
        metadata = getattr(hints[item.name], "__metadata__", ())
        own = next((each for each in metadata if isinstance(each, Parameter)), None)
        if own is None:
            raise TypeError(f"{section.__name__}.{item.name} states no unit and range")
        found[item.name] = own
    return found


OptionalLength = Annotated[float | None, quantity(LENGTH, optional=True)]
