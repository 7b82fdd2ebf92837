"""What runs in a worker."""

import ctypes
import functools
import hashlib
import os
import pickle
import platform
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from climatenerf.core.errors import UserError, explain

if TYPE_CHECKING:
    from climatenerf.output.frame_source import FrameSource
    from climatenerf.output.job import RenderJob

THREADS = "NUMBA_NUM_THREADS"
"""Environment variable with the number of threads of a worker's kernels; 1 if it is not set."""
PR_SET_PDEATHSIG = 1  # <linux/prctl.h>
_LIBC = ctypes.CDLL(None) if sys.platform == "linux" else None  # a forked child may not load it


@dataclass(frozen=True)
class Saved:
    """A pickled job with its frame source.

    Attributes:
        path: The file.
        sha256: What it must hold.
        versions: What `versions` gave where it was written.
    """

    path: Path
    sha256: str
    versions: dict[str, str]

    def __hash__(self) -> int:
        return hash(self.sha256)


def versions() -> dict[str, str]:
    """Return the versions on which the bytes of a frame depend, and those that a pickle needs."""
    import numba
    import numpy
    import torch

    import climatenerf

    return {
        "climatenerf": climatenerf.__version__,
        "Python": ".".join(platform.python_version_tuple()[:2]),
        "torch": torch.__version__,
        "NumPy": numpy.__version__,
        "Numba": numba.__version__,
    }


def different_version(theirs: Mapping[str, str], wanted: Mapping[str, str]) -> str | None:
    """Return the sentence for a worker with other versions; None if all are the same."""
    for name, version in wanted.items():
        if theirs[name] != version:
            return (
                f"a worker has {name} {theirs[name]} and the program has {version}; install the"
                " same versions on all machines"
            )
    return None


def own_threads() -> int:
    """Return the number of threads of a worker's kernels."""
    return int(os.environ.get(THREADS, 1))


def holds(path: Path, content: str) -> bool:
    """Return whether this machine reads a file's content where the program wrote it."""
    try:
        return path.read_text() == content
    except (OSError, UnicodeError):
        return False


def render_frame(out: Path, prepared: Saved, index: int) -> tuple[float, str]:
    """Render and write one frame, unless it is finished; return the seconds, and the process.

    Args:
        out: folder of the movie, which `claim` has taken for the job.
        prepared: a pickled job and its frame source.
        index: number of the frame.

    Raises:
        UserError: a file cannot be read or written, or another render has taken the folder.
    """
    from climatenerf.output import job as jobs

    begin = time.perf_counter()
    job, source = unpickled(prepared)
    jobs.render_frame(job, out, index, source)
    return time.perf_counter() - begin, f"{platform.node()}, process {os.getpid()}"


@functools.lru_cache(maxsize=1)
def unpickled(prepared: Saved) -> "tuple[RenderJob, FrameSource]":
    """Return what another process has prepared; a worker reads it once.

    A pickle can run any code, so only one with the hash that came with the task is unpickled. A
    worker may have come after the others were checked, so its versions are checked here.

    Raises:
        UserError: the file cannot be read, or holds something else, or versions differ.
    """
    import numba
    import torch

    difference = different_version(versions(), prepared.versions)
    if difference is not None:
        raise UserError(difference)
    threads = min(own_threads(), numba.get_num_threads())
    numba.set_num_threads(threads)
    torch.set_num_threads(threads)
    try:
        data = prepared.path.read_bytes()
    except OSError as error:
        raise explain(error, prepared.path) from error
    if hashlib.sha256(data).hexdigest() != prepared.sha256:
        raise UserError(
            f"{prepared.path} holds something else than was written; check that all machines share"
            " the folder"
        )
    return pickle.loads(data)


def run_verb(
    words: Sequence[str], log: Path, folder: Path, threads: int | None
) -> tuple[int, float, str]:
    """Run a verb of the command line in a process of its own.

    Args:
        words: verb and flags.
        log: file that receives all that the verb prints.
        folder: working folder of the verb.
        threads: of its kernels; None: as many as there are cores.

    Returns:
        Exit status, seconds, and the last line that it printed, or the signal that ended it.
    """
    begin = time.perf_counter()
    environment = {**os.environ} | ({} if threads is None else {THREADS: str(threads)})
    try:
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("ab") as file:
            file.write(f"$ climatenerf {' '.join(words)}\n".encode())
            file.flush()
            status = subprocess.run(
                [sys.executable, "-m", "climatenerf", *words],
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=file,
                env=environment,
                preexec_fn=_end_with_parent if sys.platform == "linux" else None,
            ).returncode
    except OSError as error:
        raise explain(error, log) from error
    message = last_line(log)
    if status < 0:
        message = f"ended by signal {-status}; if nobody sent it, the memory was not enough"
    return status, time.perf_counter() - begin, message


def _end_with_parent() -> None:
    """Ask the system to stop this process, as `kill` does, when the worker ends in any way."""
    if _LIBC is not None:
        _LIBC.prctl(PR_SET_PDEATHSIG, signal.SIGTERM)


def last_line(path: Path) -> str:
    """Return the last line of a text file that is not empty."""
    with path.open("rb") as file:
        file.seek(max(path.stat().st_size - 4096, 0))
        lines = file.read().decode(errors="replace").replace("\r", "\n").split("\n")
    return next((line.strip() for line in reversed(lines) if line.strip()), "")
