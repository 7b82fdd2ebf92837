"""Standard output and standard error that cannot fail the work.

Either may be closed, a full disk, a pipe whose reader has ended, or of a narrow encoding. What is
written to them is not worth the hours of a fit.
"""

import contextlib
import io
import os
import sys


def open_all() -> None:
    """Make both streams usable: open a closed one on nothing, and escape what it cannot encode.

    A closed number would be given to the next file that is opened, into which a library that
    prints would then write.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            with contextlib.suppress(OSError):
                os.open(os.devnull, os.O_RDWR)  # takes the lowest free number
    for name in ("stderr", "stdout"):  # standard error first: it reports on the other
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115
            if name == "stdout":
                complain("warning: standard output is closed, so results are not printed\n")
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def write_output(text: str) -> None:
    """Write to standard output; what cannot be written is reported once and then dropped."""
    try:
        sys.stdout.write(text)
        sys.stdout.flush()
    except (OSError, ValueError) as error:
        _drop_output(error)


def flush_output() -> None:
    """Write out standard output, so that nothing fails while the interpreter exits."""
    try:
        sys.stdout.flush()
    except (OSError, ValueError) as error:
        _drop_output(error)


def complain(text: str) -> None:
    """Write to standard error, if that is possible."""
    with contextlib.suppress(OSError, ValueError):
        sys.stderr.write(text)
        sys.stderr.flush()


def _drop_output(error: Exception) -> None:
    if not isinstance(error, BrokenPipeError):  # `| head` has read enough
        complain(f"warning: standard output cannot be written ({error})\n")
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
