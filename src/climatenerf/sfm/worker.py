"""Structure from motion in a process of its own.

COLMAP ends its process where a disk is full or memory is short. Here that becomes a sentence,
Ctrl-C takes effect at once, and what was finished stays in the work folder. The two sides speak
JSON lines.
"""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
from dataclasses import asdict
from pathlib import Path

from climatenerf.core.errors import UserError
from climatenerf.core.storage import explain, plain
from climatenerf.sfm.photo_import import PhotoImport, picture_from_json
from climatenerf.sfm.reconstruct import Model, Progress, read_result, reconstruct

NEARLY_FULL = 20_000_000  # bytes free, below which a crash is put down to the disk
LOG = "colmap.log"

# COLMAP matches on threads of its own. Where each of them lets OpenBLAS gather a team as well, the
# approximate neighbours of two pictures differed between equal runs (one in a hundred, under load).
WORKER_ENVIRONMENT = {"OMP_NUM_THREADS": "1"}


def reconstruct_in_subprocess(
    imported: PhotoImport, work: Path, out: Path, features: int, seed: int, progress: Progress
) -> Model:
    """`reconstruct` in another process; arguments and errors are its own.

    Raises:
        UserError: as `reconstruct`, or the process ended before its time.
    """
    order = {
        "imported": asdict(imported),
        "work": work,
        "out": out,
        "features": features,
        "seed": seed,
    }
    try:
        log = (work / LOG).open("wb")
    except OSError as error:
        raise explain(error, work / LOG) from error
    with log:
        process = subprocess.Popen(
            [sys.executable, "-m", "climatenerf.sfm.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            env={**os.environ, **WORKER_ENVIRONMENT},
            start_new_session=True,  # Ctrl-C is for this side, which ends the other one
        )
    assert process.stdin is not None and process.stdout is not None
    finished = False
    try:
        # The pipe stays open: its end tells the worker that this side is gone.
        process.stdin.write(json.dumps(plain(order)).encode() + b"\n")
        process.stdin.flush()
        for line in process.stdout:
            words = json.loads(line)
            if "error" in words:
                raise UserError(words["error"])
            if "stage" in words:
                progress(words["stage"], words["share"])
            finished = "done" in words
        process.wait(10)
    except (BrokenPipeError, subprocess.TimeoutExpired):
        pass  # why it ended is told below
    finally:
        process.kill()
        process.wait()
        with contextlib.suppress(OSError):
            process.stdin.close()
        process.stdout.close()
    model = read_result(imported, work, features, seed)
    if not finished or model is None:
        raise UserError(_failure(work, process.returncode))
    return model


def _failure(work: Path, status: int) -> str:
    """The probable cause of a worker's end, and the remedy."""
    if shutil.disk_usage(work).free < NEARLY_FULL:
        return (
            f"the disk is full: could not go on in {work}; free some space or choose another folder"
            " (what was already saved is unharmed)"
        )
    if status == -signal.SIGKILL:
        return "finding poses was ended from outside, likely for memory; try --features 2048"
    words = (work / LOG).read_text(errors="replace").strip().splitlines()
    last = next((line for line in reversed(words) if "] " in line or "Error" in line), "")
    last = last or f"it ended with status {status}"
    return f"finding poses failed ({last.strip()[:300]}); see {work / LOG}, and run it again"


def main() -> None:
    """The worker's side: an order on standard input, progress and errors on standard output."""
    order = json.loads(sys.stdin.readline())
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    # COLMAP, too, may write to standard output: it goes where errors go.
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)

    def say(words: dict) -> None:
        answers.write(json.dumps(words) + "\n")

    told = order["imported"]
    imported = PhotoImport(
        folder=Path(told["folder"]),
        pictures=tuple(picture_from_json(picture) for picture in told["pictures"]),
        unusable=told["unusable"],
        is_video=told["is_video"],
    )
    try:
        reconstruct(
            imported,
            Path(order["work"]),
            Path(order["out"]),
            order["features"],
            order["seed"],
            lambda stage, share: say({"stage": stage, "share": share}),
        )
    except UserError as error:
        say({"error": str(error)})
    else:
        say({"done": True})


def _exit_with_parent() -> None:
    sys.stdin.read()
    os._exit(1)


if __name__ == "__main__":
    main()
