"""Run verbs of the command line in forked processes: imported once, isolated from each other.

The parent imports everything and computes nothing (OpenMP does not survive a fork). It reads one
request a line from standard input, and answers with one line. `Runner` is the other end.
"""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
POLL = 0.005  # s
LIMIT = 600.0  # s, of a trial without a valid one to compare with
# One thread: trials may run beside tests, and threads that wait for each other would hang long.
ONE_THREAD = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


@dataclass(frozen=True)
class Outcome:
    """How a verb ended.

    Attributes:
        status: exit status; negative: ended by that signal.
        seconds: duration.
        peak: peak memory, bytes, with that of the imported program.
        hung: whether it was killed at its limit.
        after_stop: seconds from the signal that was sent to the end; None: none was sent.
        out: standard output.
        err: standard error.
    """

    status: int
    seconds: float
    peak: int
    hung: bool
    after_stop: float | None
    out: str
    err: str


class Runner:
    """The warm process, as a context."""

    def __init__(self, work: Path):
        """Prepare the process; `work` receives the output of verbs."""
        self.work = work
        self.process: subprocess.Popen[str] | None = None

    def __enter__(self) -> "Runner":
        paths = [str(ROOT / "src"), str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tools.torture_parts.zygote"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=ROOT,
            env={**os.environ, **ONE_THREAD, "PYTHONPATH": os.pathsep.join(paths)},
        )
        return self

    def __exit__(self, *error: object) -> None:
        assert self.process is not None and self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait(30)

    def start(self, args: Sequence[object], **options: Any) -> None:
        """Begin a verb.

        Args:
            args: arguments of the command line.
            options: `limit` (s); `stop` ([signal, seconds after which it is sent]); `cwd`;
                `environment` (added); `closed` (numbers of streams to close).
        """
        assert self.process is not None and self.process.stdin is not None
        request = {"args": [os.fspath(a) if isinstance(a, Path) else str(a) for a in args]}
        request |= {"out": str(self.work / "stdout"), "err": str(self.work / "stderr"), **options}
        self.process.stdin.write(json.dumps(request) + "\n")
        self.process.stdin.flush()

    def result(self) -> Outcome:
        """Wait for the verb that `start` began."""
        assert self.process is not None and self.process.stdout is not None
        answer = json.loads(self.process.stdout.readline())
        paths = (self.work / "stdout", self.work / "stderr")
        # A verb that is stopped at once has not opened them.
        texts = (p.read_text(errors="replace") if p.exists() else "" for p in paths)
        return Outcome(**answer, **dict(zip(("out", "err"), texts, strict=True)))

    def run(self, *args: object, **options: Any) -> Outcome:
        """Run a verb; see `start`."""
        self.start(args, **options)
        return self.result()


def serve() -> None:
    """Import the program, then run the requests on standard input."""
    _warm_up()
    for line in sys.stdin:
        request = json.loads(line)
        sys.stdout.write(json.dumps(_trial(request)) + "\n")
        sys.stdout.flush()


def _warm_up() -> None:
    from climatenerf.cli import THREADING

    for variable, value in THREADING.items():
        os.environ.setdefault(variable, value)
    import tyro  # noqa: F401

    import climatenerf.cli.capture
    import climatenerf.cli.export
    import climatenerf.cli.fit
    import climatenerf.cli.render
    import climatenerf.output.job
    import climatenerf.render.session
    import climatenerf.training.run  # noqa: F401

    use_small_field()


def use_small_field() -> None:
    """Give fits small tables, few cells and short steps."""
    from climatenerf.cli import fit
    from climatenerf.field.presets import PRESETS
    from climatenerf.training import run
    from climatenerf.training.settings import FitSettings

    size = dataclasses.replace(
        PRESETS["cpu"],
        geometry_log2_rows=12,
        appearance_log2_rows=12,
        surface_log2_rows=10,
        sky_log2_rows=9,
        occupancy_side=32,
        cascades=4,
    )
    # Evidence takes longer than all steps; its files are read in any case.
    light = {"multiview_stereo": False, "free_space": False}
    small = FitSettings(size=size, samples_per_step=2**12, **light)
    fit.settings_of = lambda preset, device="cpu": dataclasses.replace(small, preset=preset)
    run.PREVIEW_WIDTH = 32


def _trial(request: dict[str, Any]) -> dict[str, Any]:
    begun = time.monotonic()
    pid = os.fork()
    if pid == 0:
        _child(request)
    limit = request.get("limit", LIMIT)
    number, after = request.get("stop") or (0, None)
    sent: float | None = None
    hung = False
    while True:
        found, status, usage = os.wait4(pid, os.WNOHANG)
        now = time.monotonic() - begun
        if found:
            break
        if after is not None and sent is None and now >= after:
            os.kill(pid, number)
            sent = now
        if not hung and now > limit + (sent or 0.0):
            hung = True
            os.kill(pid, signal.SIGKILL)
        time.sleep(POLL)
    return {
        "status": os.waitstatus_to_exitcode(status),
        "seconds": now,
        "peak": usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024),
        "hung": hung,
        "after_stop": None if sent is None else now - sent,
    }


def _child(request: dict[str, Any]) -> None:
    """Become the program: run a verb and exit."""
    status: object = 70
    try:
        os.setsid()
        for number, name in ((0, os.devnull), (1, request["out"]), (2, request["err"])):
            flags = os.O_RDONLY if number == 0 else os.O_WRONLY | os.O_CREAT | os.O_TRUNC
            opened = os.open(name, flags)
            os.dup2(opened, number)
            os.close(opened)
        for number in request.get("closed", []):
            os.close(number)
            setattr(sys, ("stdin", "stdout", "stderr")[number], None)
        os.environ.update(request.get("environment", {}))
        os.chdir(request.get("cwd", "/"))
        signal.signal(signal.SIGINT, signal.default_int_handler)
        from climatenerf import cli

        args = [os.fsdecode(os.fsencode(arg)) for arg in request["args"]]
        try:
            status = cli.main(args)
        except SystemExit as end:
            status = end.code
    except BaseException:
        traceback.print_exc()
    finally:
        for stream in (sys.stdout, sys.stderr):
            if stream is not None:
                try:
                    stream.flush()
                except (OSError, ValueError):
                    status = 120
        os._exit(status if isinstance(status, int) else 0 if status is None else 1)


if __name__ == "__main__":
    serve()
