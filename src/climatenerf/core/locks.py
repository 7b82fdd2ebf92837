"""Locks of folders into which one process writes at a time. Readers take no lock.

They are advisory locks of the operating system, which frees them when a process dies, however it
dies. A file system without such locks gets the lock files of the package filelock, which state
their process, or no lock at all.
"""

import contextlib
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from climatenerf.core.errors import UserError
from climatenerf.core.storage import explain, make_folder, remove_abandoned

LOCK = ".lock"
"""File in a folder on which its only writer holds a lock; it stays when the lock is released."""


@contextlib.contextmanager
def only_writer(folder: Path, within: Iterable[str] = ()) -> Iterator[None]:
    """Hold the lock of a folder, which is created if it is absent.

    Temporary files that dead writers left are removed first. A folder that this call has created
    and that holds nothing else in the end is removed. A thread that holds the lock may take it
    again.

    Args:
        folder: the folder.
        within: names of subfolders in which temporary files are looked for, too.

    Raises:
        UserError: another process or thread holds the lock, or the folder cannot be written.
    """
    created = not os.path.lexists(folder)
    make_folder(folder)
    with locked(folder / LOCK, wait=0.0, busy=in_use(folder)):
        remove_abandoned(folder, within)
        try:
            yield
        finally:
            if created:
                _remove_if_empty(folder)


@contextlib.contextmanager
def locked(path: Path, *, wait: float | None = None, busy: str = "") -> Iterator[None]:
    """Hold a lock on a file, which is created in an existing folder if it is absent.

    Args:
        path: the file.
        wait: how long to wait for another holder, s; None: until it ends.
        busy: message of the error after that time.

    Raises:
        UserError: another process or thread still holds the lock, or the file cannot be written.
    """
    from filelock import FileLock, Timeout

    # One object for each path, which counts how often a thread holds the lock.
    lock = FileLock(os.path.realpath(path), is_singleton=True)
    try:
        lock.acquire(timeout=-1 if wait is None else wait)
    except Timeout as error:
        raise UserError(busy) from error
    except NotImplementedError:
        pass
    except OSError as error:
        raise explain(error, path) from error
    try:
        yield
    finally:
        lock.release()


def in_use(folder: Path) -> str:
    """Return the sentence that refuses a second writer."""
    return (
        f"another process is writing into {folder}; wait until it ends, or choose another folder"
        " with -o"
    )


def _remove_if_empty(folder: Path) -> None:
    """Remove a folder that holds nothing but its lock."""
    with contextlib.suppress(OSError):
        if [path.name for path in folder.iterdir()] == [LOCK]:
            (folder / LOCK).unlink()
            folder.rmdir()
