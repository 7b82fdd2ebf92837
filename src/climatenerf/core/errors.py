"""The exception for users, and what makes any failure one line of text."""

import errno
import unicodedata
from pathlib import Path

MAX_LINE = 1200
"""Characters of a message; the middle of a longer one is left out."""


class UserError(Exception):
    """Input or a request that the user can correct.

    The message is one sentence: what is wrong, where, and what to do about it. The command line
    prints it and exits with status 2; it never shows a traceback for it.
    """


def explain(error: OSError, path: Path) -> UserError:
    """Return the sentence for a failed read or write of ``path``."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return UserError(
            f"the disk is full: could not write {path}; free some space or choose another folder"
        )
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return UserError(f"no permission for {path}; change that or choose another place")
    if error.errno in (errno.ENOTDIR, errno.EEXIST):
        return UserError(
            f"cannot create {path}: something on the way there is a file, not a folder;"
            " choose another place"
        )
    if error.errno == errno.EISDIR:
        return UserError(f"{path} is a folder where a file was expected; choose another name")
    if error.errno == errno.ENAMETOOLONG:
        return UserError(f"the name {path} is longer than the disk allows; shorten it")
    reason = error.strerror or str(error)
    return UserError(f"could not read or write {path}: {reason}; check the disk and the path")


def one_line(text: str, limit: int = MAX_LINE) -> str:
    """Return a message as one line: no line breaks, no control characters, of bounded length.

    A name from a file may hold all of them, and a terminal would obey escape sequences.
    """
    lines = (line.strip() for line in text.splitlines())
    joined = " ".join(line for line in lines if line)
    plain = "".join(c if unicodedata.category(c) != "Cc" else ascii(c)[1:-1] for c in joined)
    if len(plain) <= limit:
        return plain
    return f"{plain[: limit // 2]} ... {plain[-limit // 2 :]}"


def excerpt(value: object, limit: int = 60) -> str:
    """Return a value from a file for a message, cut off and on one line."""
    if isinstance(value, int) and value.bit_length() > 256:  # Python refuses to write it out
        long = value.bit_length() > 14_000
        digits = int(value.bit_length() * 0.30103) + 1 if long else len(str(abs(value)))
        return f"a number of {digits} digits"
    if isinstance(value, dict | list | tuple) and len(value) > 8:
        return f"a {'table' if isinstance(value, dict) else 'list'} of {len(value)} entries"
    try:
        return one_line(repr(value), limit)
    except (ValueError, RecursionError):
        return f"a {type(value).__name__}"
