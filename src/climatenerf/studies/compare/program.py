"""Running a program of another project as a process of its own, in the user's checkout of it."""

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from climatenerf.core.errors import UserError, explain, one_line
from climatenerf.core.storage import make_folder

LOG_TAIL = 65536  # bytes of a log that are searched for its last line


def run_program(command: Sequence[str | Path], checkout: Path, log: Path, name: str) -> None:
    """Run a program to its end, with its output in a log.

    The program ends with this process, also after Ctrl-C. It has no standard input, so a question
    ends it.

    Args:
        command: the program and its arguments.
        checkout: folder in which it runs.
        log: file for its output.
        name: of the program, for messages.

    Raises:
        UserError: it cannot be started, or fails.
    """
    make_folder(log.parent)
    try:
        output = log.open("wb")
    except OSError as error:
        raise explain(error, log) from error
    with output:
        try:
            process = subprocess.Popen(
                [os.fspath(word) for word in command],
                cwd=checkout,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        except OSError as error:
            raise UserError(
                f"{name} does not start ({error.strerror}: {error.filename}); check its checkout"
                " and the Python that is given for it"
            ) from error
        try:
            status = process.wait()
        except BaseException:
            with contextlib.suppress(OSError):  # it has just ended
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            raise
    if status != 0:
        raise UserError(
            f"{name} failed ({_last_line(log) or f'exit status {status}'}); see {log}, then run the"
            " same command again"
        )


def python_of(given: Path | None) -> Path:
    """Return the Python of another project's environment, or the present one."""
    # Not resolved: the Python of an environment is a link to the system's.
    return Path(sys.executable) if given is None else given.expanduser().absolute()


def check_checkout(folder: Path, file: str, name: str) -> Path:
    """Return the absolute path of a checkout that holds a file.

    Raises:
        UserError: it does not.
    """
    if not (folder.expanduser() / file).is_file():
        raise UserError(
            f"{folder} is no checkout of {name}: it has no {file}; give the folder of its"
            " repository"
        )
    return folder.expanduser().resolve()


def _last_line(log: Path) -> str:
    with contextlib.suppress(OSError):
        with log.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(0, size - LOG_TAIL))
            lines = file.read().decode("utf-8", "replace").strip().splitlines()
        return one_line(lines[-1], 200) if lines else ""
    return ""
