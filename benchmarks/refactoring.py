"""Compare the speed and memory of two checkouts, to show what a refactoring costs.

python benchmarks/refactoring.py BEFORE AFTER RUN
python benchmarks/refactoring.py BEFORE AFTER RUN --pairs 9 --threads 1 --parts fit flood

BEFORE and AFTER are folders of two source trees; RUN is a run folder that both can read. Every
measurement is a fresh process of the command line with PYTHONPATH set to one tree, so the trees
may differ in every module. Measurements of the two trees alternate, and each pair reverses the
order of the last: a drift of the machine's speed cancels. A first pair compiles the kernels and is
not counted.

`fit`: seconds of an optimiser step. Two fits of different lengths on the embedded street give the
time of the later steps alone; loading kernels, which takes seconds of the first step, cancels.
`clean`, `flood`, `snow`: seconds of a frame of RUN, from the times at which the frames of one
render appear on disk. The first frame of a render is not counted; preparing the weather and
loading are in none. `peak_mb` is the largest resident memory of a process, in 10^6 bytes.
"""

import argparse
import json
import os
import statistics
import tempfile
from collections.abc import Callable
from pathlib import Path

import common

WEATHERS = {
    "clean": [],
    "flood": ["--flood.level", "0.4 m", "--flood.wind-speed", "3 m/s"],
    "snow": ["--snow.depth", "12 cm"],
}
PARTS = ("fit", *WEATHERS)


def fit(tree: Path, street: Path, options: argparse.Namespace) -> dict[str, float]:
    """Measure a step of a fit.

    Args:
        tree: the checkout.
        street: the scene to fit.
        options: of the command line.

    Returns:
        `seconds` a step and `peak_mb`.
    """
    seconds, peaks = [], []
    for steps in options.steps:
        with tempfile.TemporaryDirectory() as folder:
            run = Path(folder) / "run"
            args = ["fit", str(street), "-o", str(run), "--steps", str(steps), "--seed", "0"]
            args += ["--downscale", str(options.downscale)]
            peaks.append(climatenerf(tree, args, options.threads))
            seconds.append(json.loads((run / "metrics.json").read_text())["seconds"])
    return {
        "seconds": (seconds[1] - seconds[0]) / (options.steps[1] - options.steps[0]),
        "peak_mb": max(peaks),
    }


def frame(tree: Path, weather: str, options: argparse.Namespace) -> dict[str, float]:
    """Measure a frame along the training path.

    Args:
        tree: the checkout.
        weather: a key of `WEATHERS`.
        options: of the command line.

    Returns:
        `seconds` a frame, the median over the frames after the first, and `peak_mb`.
    """
    with tempfile.TemporaryDirectory() as folder:
        args = ["render", str(options.run), "-o", folder, "--path", "training"]
        args += ["--frames", str(options.frames), "--size", options.size, *WEATHERS[weather]]
        peak = climatenerf(tree, args, options.threads)
        written = [path.stat().st_mtime_ns for path in sorted(Path(folder).glob("frames/*.png"))]
    gaps = [1e-9 * (b - a) for a, b in zip(written, written[1:], strict=False)]
    return {"seconds": statistics.median(gaps), "peak_mb": peak}


def climatenerf(tree: Path, args: list[str], threads: int | None) -> float:
    """Run a verb of a checkout's command line; return its peak memory in 10^6 bytes."""
    return common.peak_bytes(["-m", "climatenerf", *args], environment(tree, threads)) / 1e6


def environment(tree: Path, threads: int | None) -> dict[str, str]:
    """Return the variables of a process that imports `climatenerf` from a checkout."""
    found = {**os.environ, "PYTHONPATH": str(tree / "src"), "PYTHONSAFEPATH": "1"}
    if threads:
        names = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
        found |= dict.fromkeys(names, str(threads))
    return found


def compare(
    measure: Callable[[Path], dict[str, float]], trees: dict[str, Path], pairs: int
) -> dict[str, object]:
    """Measure both trees in alternation.

    Args:
        measure: gives `seconds` and `peak_mb` of a tree.
        trees: "before" and "after".
        pairs: how many pairs count.

    Returns:
        The spread of each tree's seconds, the ratio of the medians (after over before), the ratios
        of all pairs, and the same for memory.
    """
    measured: dict[str, list[dict[str, float]]] = {name: [] for name in trees}
    for pair in range(pairs + 1):
        order = list(trees) if pair % 2 else list(trees)[::-1]
        for name in order:
            values = measure(trees[name])
            if pair:
                measured[name].append(values)
    results: dict[str, object] = {}
    for key in ("seconds", "peak_mb"):
        values = {name: [each[key] for each in rows] for name, rows in measured.items()}
        spreads = {name: common.spread(each) for name, each in values.items()}
        pairwise = [b / a for a, b in zip(values["before"], values["after"], strict=True)]
        results[key] = {
            **spreads,
            "ratio_of_medians": spreads["after"]["median"] / spreads["before"]["median"],
            "ratio_of_pairs": common.spread(pairwise),
        }
    return results


def main() -> None:
    """Measure the requested parts and print the comparison."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("before", type=Path, help="checkout to compare with")
    parser.add_argument("after", type=Path, help="checkout to judge")
    parser.add_argument("run", type=Path, help="run folder that both checkouts can read")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--pairs", type=int, default=7, help="pairs that count")
    parser.add_argument(
        "--steps", type=int, nargs=2, default=[20, 120], help="lengths of the two fits"
    )
    parser.add_argument("--downscale", type=int, default=2, help="of the photos for the fits")
    parser.add_argument("--frames", type=int, default=4, help="frames of each render, at least 2")
    parser.add_argument("--size", default="480x270", help="size of the frames")
    parser.add_argument("--threads", type=int, help="threads of each process; default: all cores")
    options = parser.parse_args()
    if options.pairs < 1 or options.frames < 2 or not 0 < options.steps[0] < options.steps[1]:
        parser.error("--pairs must be at least 1, --frames at least 2, and --steps must increase")
    trees = {"before": options.before.resolve(), "after": options.after.resolve()}
    options.run = options.run.resolve()
    for tree in trees.values():
        code = ["-c", "import climatenerf; print(climatenerf.__file__)"]
        imported = common.output(code, environment(tree, None)).strip()
        if not Path(imported).is_relative_to(tree):
            parser.error(f"{tree} is no checkout: Python imports {imported or 'nothing'} instead")
    street = trees["before"] / "src" / "climatenerf" / "assets" / "street"
    jobs: dict[str, Callable[[Path], dict[str, float]]] = {
        "fit": lambda tree: fit(tree, street, options)
    }
    for weather in WEATHERS:
        jobs[weather] = lambda tree, weather=weather: frame(tree, weather, options)
    results = {part: compare(jobs[part], trees, options.pairs) for part in options.parts}
    names = ("steps", "downscale", "frames", "size", "threads")
    settings = {name: getattr(options, name) for name in names}
    common.report("speed and memory of two checkouts", {**settings, "parts": results}, 0)


if __name__ == "__main__":
    main()
