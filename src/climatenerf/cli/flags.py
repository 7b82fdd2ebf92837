"""Parsing of a verb's flags: tyro's help, and one sentence in place of its boxes."""

import contextlib
import io
import re
from collections.abc import Sequence
from typing import Any

from climatenerf.cli import streams
from climatenerf.core.errors import UserError

_KINDS = {"FLOAT": "a number", "INT": "a whole number", "PATH": "a path", "STR": "a text"}
_RULE = re.compile(r"─+|-{10,}")
_NO_TYPE = re.compile(
    r"Error parsing (\S+): no type matching (\S+) could be instantiated from \[(.*?)\]"
)


def optional(metavar: str) -> Any:
    """Return the help of a flag whose default, None, means nothing to a reader.

    Args:
        metavar: what stands for the value: STR, INT, FLOAT or PATH, which messages know.
    """
    import tyro

    return tyro.conf.arg(metavar=metavar, help_behavior_hint="")


def names_of(*words: str) -> tuple[str, ...]:
    """Return the names in a flag's words, which spaces or commas separate."""
    return tuple(name.strip() for word in words for name in word.split(",") if name.strip())


def parse_flags(kind: type, prog: str, words: Sequence[str]) -> Any:
    """Return the options of a verb; tyro prints help itself and exits with status 0.

    Args:
        kind: dataclass of the options.
        prog: what the user typed before the flags, such as "climatenerf fit".
        words: the flags.

    Raises:
        UserError: a flag is unknown, lacks its value, or has one that cannot be used.
    """
    import tyro

    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            # Without --no-FLAG for flags that are off by default.
            return tyro.cli(
                kind, prog=prog, args=list(words), config=(tyro.conf.FlagCreatePairsOff,)
            )
    except BrokenPipeError:  # the reader of the help, such as `| head`, has read enough
        streams.flush_output()
        raise SystemExit(0) from None
    except SystemExit as stop:
        if not stop.code:
            raise
        raise UserError(f"{_sentence(complaint.getvalue())}; see {prog} --help") from None


def _sentence(box: str) -> str:
    """Return the sentence in a box that tyro prints, with the first flag that it suggests."""
    lines = [line[1:].rstrip("│ ") for line in box.splitlines() if not line.startswith(("╭", "╰"))]
    sections: list[list[str]] = [[]]
    for line in lines:
        if _RULE.fullmatch(line.strip()):
            sections.append([])
        else:
            sections[-1].append(line)
    if "│" not in box:  # without UTF-8 the title is no part of the frame
        del sections[:1]
    first = sections[0] if sections else [box]
    text = " ".join(line.strip() for line in first)
    if text.startswith("Missing from"):  # names are indented less than their help
        indents = [len(line) - len(line.lstrip()) for line in first[1:]]
        names = [
            line.strip() for line, indent in zip(first[1:], indents, strict=True) if indent <= 5
        ]
        text = f"{first[0].strip().removesuffix(':')}: {', '.join(names)}"
    # "Error parsing --flag: must be ..." -> "--flag must be ...".
    text = re.sub(r"^Error parsing (\S+): must be", r"\1 must be", text)
    if (wrong := _NO_TYPE.match(text)) is not None:
        flag, types, value = wrong.groups()
        kind = types.removeprefix("{None}|")
        text = f"{flag} must be {_KINDS.get(kind, kind)}; got {value}"
    text = re.sub(r"\. Expected \d+ values?$", "", text.strip().rstrip("."))
    text = text.replace(", 'None')", ")").replace("'None', ", "")
    for section in sections[1:]:
        if section and section[0].strip() == "Perhaps you meant:" and len(section) > 1:
            words = section[1].split()
            if words:
                text += f"; did you mean {words[0].rstrip(',')}?"
    return text[:1].lower() + text[1:].rstrip(".")
