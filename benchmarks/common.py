"""What the benchmark scripts share: timing, the machine's description, JSON on standard output."""

import importlib.metadata
import json
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from climatenerf.cli import THREADING

# As the command line does, and before torch is imported.
for variable, value in THREADING.items():
    os.environ.setdefault(variable, value)

CAPTURES = Path(__file__).resolve().parents[2] / "shared" / "data"
PYTHON = sys.executable


def measure(job: Callable[[], object], repeats: int = 5, warm_up: int = 1) -> dict[str, float]:
    """Seconds of `job`: median and spread over `repeats`, after `warm_up` runs not counted."""
    for _ in range(warm_up):
        job()
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        job()
        seconds.append(time.perf_counter() - start)
    return spread(seconds)


def spread(values: list[float]) -> dict[str, float]:
    """Median, extremes and count."""
    return {
        "median": statistics.median(values),
        "least": min(values),
        "most": max(values),
        "repeats": len(values),
    }


def command(*words: str) -> str:
    """Runs `climatenerf WORDS` in a process of its own; returns what it printed."""
    done = subprocess.run(
        [PYTHON, "-m", "climatenerf", *words], stdout=subprocess.PIPE, text=True, check=True
    )
    return done.stdout


def machine() -> dict[str, object]:
    """The processor and how busy it was."""
    name = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        models = [line for line in info.read_text().splitlines() if line.startswith("model name")]
        name = models[0].partition(":")[2].strip() if models else name
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {"processor": name, "cores": usable, "load_before": os.getloadavg()[0]}


def versions() -> dict[str, str]:
    """Of Python and of what computes."""
    found = {"python": platform.python_version()}
    return found | {p: importlib.metadata.version(p) for p in ("torch", "numpy", "numba")}


MACHINE = machine()  # at the start: later the load is this benchmark's own


def report(question: str, results: object, seed: int | None = None) -> None:
    """Prints the answer as JSON."""
    answer = {"question": question, "machine": MACHINE, "versions": versions(), "seed": seed}
    print(json.dumps({**answer, "results": results}, indent=1))
