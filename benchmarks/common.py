"""Helpers of the benchmark scripts: timing, memory, a description of the machine, JSON output."""

import importlib.metadata
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from climatenerf.cli import THREADING

# As in the command line; torch reads them when it is imported.
for variable, value in THREADING.items():
    os.environ.setdefault(variable, value)

CAPTURES = Path(__file__).resolve().parents[2] / "shared" / "data"
PYTHON = sys.executable


def measure(job: Callable[[], object], repeats: int = 5, warm_up: int = 1) -> dict[str, float]:
    """Time a job.

    Args:
        job: called `warm_up` times, then `repeats` times.
        repeats: number of timed calls.
        warm_up: number of calls before them that are not timed.

    Returns:
        Seconds, as `spread`.
    """
    for _ in range(warm_up):
        job()
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        job()
        seconds.append(time.perf_counter() - start)
    return spread(seconds)


def spread(values: list[float]) -> dict[str, float]:
    """Return median, extremes and count of some values."""
    return {
        "median": statistics.median(values),
        "min": min(values),
        "max": max(values),
        "repeats": len(values),
    }


def command(*args: str) -> str:
    """Run `climatenerf` with arguments in its own process; return its standard output."""
    return output(["-m", "climatenerf", *args])


def output(args: list[str], environment: dict[str, str] | None = None) -> str:
    """Run Python with arguments in its own process; return its standard output."""
    done = subprocess.run(
        [PYTHON, *args], stdout=subprocess.PIPE, text=True, check=True, env=environment
    )
    return done.stdout


def peak_bytes(args: list[str], environment: dict[str, str] | None = None) -> float:
    """Run Python with arguments in its own process; return its peak resident memory.

    Its output is shown only if it fails; then this process exits as well.
    """
    with tempfile.TemporaryFile("w+") as output:
        child = subprocess.Popen(
            [PYTHON, *args], stdout=output, stderr=subprocess.STDOUT, env=environment
        )
        _, status, usage = os.wait4(child.pid, 0)
        if status:
            output.seek(0)
            sys.exit(f"{output.read()}`python {' '.join(args)}` failed")
    # Linux counts in KiB, macOS in bytes.
    return usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def machine() -> dict[str, object]:
    """Describe the processor, the usable cores and the load."""
    name = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        models = [line for line in info.read_text().splitlines() if line.startswith("model name")]
        name = models[0].partition(":")[2].strip() if models else name
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {"processor": name, "cores": usable, "load_before": os.getloadavg()[0]}


def versions() -> dict[str, str]:
    """Return the versions of Python and of the libraries that compute."""
    found = {"python": platform.python_version()}
    return found | {p: importlib.metadata.version(p) for p in ("torch", "numpy", "numba")}


MACHINE = machine()  # at import; later the load includes the benchmark itself


def report(question: str, results: object, seed: int | None = None) -> None:
    """Print results as JSON, with the machine and versions."""
    answer = {"question": question, "machine": MACHINE, "versions": versions(), "seed": seed}
    print(json.dumps({**answer, "results": results}, indent=1))
