"""Measure the speed of the kernels that work on a whole scene, and compare it with a bound.

python benchmarks/scene_kernels.py

The bounds are those of `kernels.py`; the scene is the reference street. The kernels are the
metaball sums of snow, the plane sweep of multi-view stereo, and the consensus of the sky's visual
hull.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import common
import numpy as np
import torch
from kernels import bounds

from climatenerf.ops.cpu import metaballs, plane_sweep
from climatenerf.scene import read_scene
from climatenerf.training.dataset import TrainingPixels
from climatenerf.training.evidence.multiview_stereo import build_pictures, depth_ranges
from climatenerf.training.run import begin
from climatenerf.training.settings import FitSettings
from climatenerf.weather.snow.lattice import Deposits, SnowGrid, grow

ROOT = Path(__file__).resolve().parents[1]
WINDOW = (2 * plane_sweep.SIDE + 1) ** 2


@dataclass(frozen=True)
class Job:
    """A call of a kernel, and what it needs per unit of work.

    Attributes:
        run: calls the kernel.
        unit: name of a unit.
        units: number of units of one call.
        reads: reads of cache lines at random addresses per unit.
        multiply_adds: multiply-adds per unit.
    """

    run: Callable[[], object]
    unit: str
    units: int
    reads: float
    multiply_adds: float


def snow_sums(random: np.random.Generator, points: int) -> Job:
    """Evaluate points near the surface of 15 cm of snow on rough, level ground."""
    grid = SnowGrid((0.0, 0.0), (-1.0, 1.0), 0.05, 96)
    line = (np.arange(2 * grid.half_cells) + 0.5 - grid.half_cells) * grid.spacing
    x, y = (each.ravel() for each in np.meshgrid(line, line))
    position = np.stack([x, y, random.normal(0, 0.02, x.shape)], -1).astype(np.float32)
    even = np.ones(len(x), np.float32)
    deposits = Deposits(grid, position, even, 0.8 * even, np.array([0, len(x)]), np.array([1]))
    lattice = grow(deposits, 0.15)
    at = random.uniform((-4, -4, 0.1), (4, 4, 0.2), (points, 3)).astype(np.float32)
    # 64 vertices: distance (3), two powers, sums of four quantities with their gradients, means.
    # Reads: four planes of each of three arrays; heights are twice as wide.
    return Job(lambda: metaballs.evaluate(at, lattice), "points", points, 16, 64 * 20)


def windows(random: np.random.Generator, pixels: TrainingPixels, points, count: int) -> Job:
    """Sweep windows of photos through all depths that the kernel tries."""
    pictures = build_pictures(pixels, *depth_ranges(pixels, points, (1.0, 5.0)))
    view = random.integers(0, len(pictures.size), count)
    centre = (random.uniform(0.05, 0.95, (count, 2)) * pictures.size[view]).astype(np.float32)
    compared = 0
    window = np.empty(WINDOW, np.float32)
    for i, (x, y) in zip(view, centre, strict=True):
        if plane_sweep._take_window(pictures, i, x, y, window):
            tile = plane_sweep._tile(pictures, i, x, y)
            steps = plane_sweep._steps(pictures, i, tile, x, y)
            compared += steps * int((pictures.neighbours[i, tile] >= 0).sum())
    # Per pixel of a window: projection (15), interpolation (6), three sums. Refinement of the best
    # depths is not counted. All reads hit the core's own cache.
    return Job(
        lambda: plane_sweep.match(pictures, view, centre),
        "window comparisons",
        compared,
        0,
        24 * WINDOW,
    )


def hull_points(random: np.random.Generator, pixels: TrainingPixels, count: int) -> Job:
    """Query the visual hull of the sky with points around the cameras."""
    hull = pixels.sky_hull
    assert hull is not None, "the reference street has labels"
    x = torch.from_numpy(random.normal(0, 8, (count, 3)).astype(np.float32))
    radius = torch.full((count,), 0.1)
    votes = count * len(hull.views[-1])
    return Job(lambda: hull.consensus(x, radius), "votes", votes, 0.5, 13)


def main() -> None:
    """Measure the bounds and the kernels, and print them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--size", type=float, default=1.0, help="factor on the amount of work")
    options = parser.parse_args()
    random = np.random.default_rng(0)
    scene = read_scene(ROOT / "reference" / "street")
    trainer = begin(scene, FitSettings(minutes=None, steps=1, multiview_stereo=False), 1)
    size = options.size
    jobs = {
        "metaball sums": snow_sums(random, int(2**18 * size)),
        "plane sweep": windows(
            random, trainer.pixels, trainer.evidence.free_space.sparse, int(2**14 * size)
        ),
        "visual hull": hull_points(random, trainer.pixels, int(2**18 * size)),
    }
    best = bounds(options.repeats, 2**17)
    rows: dict[str, dict] = {"machine": best}
    for name, job in jobs.items():
        taken = common.measure(job.run, options.repeats)
        rate = job.units / taken["median"] / 1e6
        each = max(job.reads / best["Mreads/s"], job.multiply_adds / best["Gmultiply-adds/s"] / 1e3)
        rows[name] = {
            "unit": job.unit,
            "M/s": rate,
            "bound M/s": 1 / each,
            "fraction of bound": rate * each,
            "seconds": taken,
        }
    common.report("speed of the kernels that work on a scene, and their bounds", rows, seed=0)


if __name__ == "__main__":
    main()
