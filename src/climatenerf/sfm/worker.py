"""Run structure from motion in a subprocess.

COLMAP ends its process on a full disk or when memory runs out. The parent turns that into a
`UserError`, Ctrl-C takes effect at once, and finished stages stay in the work folder. Parent and
worker exchange JSON lines over pipes.
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

MIN_FREE_BYTES = 20_000_000  # with less free space a crash is attributed to the full disk
LOG = "colmap.log"

# COLMAP matches on its own threads. If each of them also starts OpenBLAS threads, the approximate
# nearest neighbours of two pictures can differ between equal runs (1 in 100, under load).
WORKER_ENVIRONMENT = {"OMP_NUM_THREADS": "1"}


def reconstruct_in_subprocess(
    imported: PhotoImport, work: Path, out: Path, features: int, seed: int, progress: Progress
) -> Model:
    """Run `reconstruct` in a subprocess, with the same arguments, and return its result.

    Raises:
        UserError: as `reconstruct`, or the subprocess ended early.
    """
    request = {
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
            start_new_session=True,  # Ctrl-C reaches the parent only, which ends the worker
        )
    assert process.stdin is not None and process.stdout is not None
    finished = False
    try:
        # The pipe stays open: the worker exits when it closes.
        process.stdin.write(json.dumps(plain(request)).encode() + b"\n")
        process.stdin.flush()
        for line in process.stdout:
            message = json.loads(line)
            if "error" in message:
                raise UserError(message["error"])
            if "stage" in message:
                progress(message["stage"], message["fraction"])
            finished = "done" in message
        process.wait(10)
    except (BrokenPipeError, subprocess.TimeoutExpired):
        pass  # `_failure` finds the cause
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
    """Return the probable cause of a worker's early end, and the remedy."""
    if shutil.disk_usage(work).free < MIN_FREE_BYTES:
        return (
            f"the disk is full: could not write to {work}; free some space or choose another folder"
            " (files that were already saved are intact)"
        )
    if status == -signal.SIGKILL:
        return (
            "the computation of poses was killed, probably for lack of memory; try --features 2048"
        )
    lines = (work / LOG).read_text(errors="replace").strip().splitlines()
    last = next((line for line in reversed(lines) if "] " in line or "Error" in line), "")
    last = last or f"exit status {status}"
    return (
        f"the computation of poses failed ({last.strip()[:300]}); see {work / LOG}, and run the"
        " command again"
    )


def main() -> None:
    """Run the worker: read a request from standard input, write progress to standard output."""
    request = json.loads(sys.stdin.readline())
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    # COLMAP may also write to standard output: redirect that to standard error.
    output = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)

    def send(message: dict) -> None:
        output.write(json.dumps(message) + "\n")

    fields = request["imported"]
    imported = PhotoImport(
        folder=Path(fields["folder"]),
        pictures=tuple(picture_from_json(picture) for picture in fields["pictures"]),
        unusable=fields["unusable"],
        is_video=fields["is_video"],
    )
    try:
        reconstruct(
            imported,
            Path(request["work"]),
            Path(request["out"]),
            request["features"],
            request["seed"],
            lambda stage, fraction: send({"stage": stage, "fraction": fraction}),
        )
    except UserError as error:
        send({"error": str(error)})
    else:
        send({"done": True})


def _exit_with_parent() -> None:
    sys.stdin.read()
    os._exit(1)


if __name__ == "__main__":
    main()
