"""What is no ordinary file: reading a pipe, a device or a socket might never end."""

import os
import select
import stat
import time
from pathlib import Path

from climatenerf.core.errors import UserError

STREAM_FOLDERS = ("/dev/fd/", "/proc/self/fd/")
"""Where a shell names its pipes, as in `--weather <(program)`."""
STREAM_SECONDS = 60.0
"""For which a pipe may give nothing."""
_KINDS = {
    stat.S_IFIFO: "a pipe",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
}


def check_regular(path: Path | str, what: str = "") -> None:
    """Refuse a pipe, a device or a socket; a folder or an absent file is left to the reader.

    Args:
        path: the file.
        what: what it is to the user, which begins the message; "" for nothing.

    Raises:
        UserError: it is one.
    """
    kind = special_kind(path)
    if kind is not None:
        begin = f"{what}: " if what else ""
        raise UserError(f"{begin}{path} is {kind} in place of a file; give a file")


def special_kind(path: Path | str) -> str | None:
    """Return "a pipe", "a device" or "a socket"; None for a file, a folder or what is absent."""
    try:
        return _KINDS.get(stat.S_IFMT(os.stat(path).st_mode))
    except (OSError, ValueError):  # ValueError: a zero byte in the name
        return None


def is_stream(path: Path | str) -> bool:
    """Return whether a path is a pipe that a shell made for this process, or standard input."""
    named = str(path)
    own = named == "/dev/stdin" or named.startswith(STREAM_FOLDERS)
    return own and special_kind(path) == "a pipe"


def read_stream(path: Path | str, max_bytes: int) -> bytes:
    """Return what a pipe gives, `max_bytes` at most.

    Raises:
        UserError: it gives nothing for `STREAM_SECONDS`.
        OSError: it cannot be opened.
    """
    data = bytearray()
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        end = time.monotonic() + STREAM_SECONDS
        while len(data) < max_bytes:
            if not select.select([descriptor], [], [], max(0.0, end - time.monotonic()))[0]:
                raise UserError(
                    f"{path} gave nothing for {STREAM_SECONDS:.0f} s; save what it should give to"
                    " a file, and give that"
                )
            block = os.read(descriptor, max_bytes - len(data))
            if not block:
                break
            data += block
            end = time.monotonic() + STREAM_SECONDS
    finally:
        os.close(descriptor)
    return bytes(data)
