"""Time the start of the program: `climatenerf --help`, `fit --help`, imports.

python benchmarks/startup.py
python benchmarks/startup.py --repeats 20
python benchmarks/startup.py --compile

With --compile instead, a fit of two steps and a small frame in all weathers are timed without
compiled kernels on disk, and again with them. The difference is the time of compilation, which
happens once per machine.
"""

import argparse
import os
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

import common
from common import PYTHON, measure, report

STREET = Path(common.__file__).resolve().parents[1] / "src/climatenerf/assets/street"

COMMANDS = {
    "climatenerf --help": ["-m", "climatenerf", "--help"],
    "climatenerf fit --help": ["-m", "climatenerf", "fit", "--help"],
    "climatenerf render --help": ["-m", "climatenerf", "render", "--help"],
    "python, nothing": ["-c", "pass"],
    "import climatenerf": ["-c", "import climatenerf"],
    "import climatenerf.scene": ["-c", "import climatenerf.scene"],
    "import climatenerf.field.hash_field": ["-c", "import climatenerf.field.hash_field"],
}


def compiling() -> dict[str, dict[str, float]]:
    """Time a fit and a frame, without and with compiled kernels."""
    rows: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as temporary:
        run, out = f"{temporary}/run", f"{temporary}/out"
        jobs = {
            "fit": ["fit", str(STREET), "-o", run, "--steps", "2", "--downscale", "4"],
            "render": ["render", run, "-o", out, "--path", "still", "--frames", "1"],
        }
        jobs["render"] += ["--size", "64x36", "--flood.level", "30 cm"]
        jobs["render"] += ["--snow.depth", "10 cm", "--smog.visibility", "300 m"]
        environment = {**os.environ, "NUMBA_CACHE_DIR": f"{temporary}/kernels"}
        for state in ("without", "with"):
            for name, args in jobs.items():
                start = time.perf_counter()
                command = [PYTHON, "-m", "climatenerf", *args]
                subprocess.run(command, check=True, env=environment, stdout=subprocess.DEVNULL)
                rows.setdefault(name, {})[state] = time.perf_counter() - start
            for folder in (run, out):
                shutil.rmtree(folder)
    for row in rows.values():
        row["compiling"] = row["without"] - row["with"]
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--compile", action="store_true")
    options = parser.parse_args()
    if options.compile:
        report("seconds of the first run on a machine, and of the second", compiling())
        return

    def run(args: list[str]) -> None:
        subprocess.run([PYTHON, *args], stdout=subprocess.DEVNULL, check=True)

    rows = {
        name: measure(lambda args=args: run(args), options.repeats)
        for name, args in COMMANDS.items()
    }
    report("wall seconds of a fresh process", rows)


if __name__ == "__main__":
    main()
