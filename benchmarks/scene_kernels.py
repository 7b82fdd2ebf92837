"""How near to what the machine could do are the kernels that ask snow, photos and labels?

python benchmarks/scene_kernels.py

As `kernels.py`, whose bounds these are held against, for those that work on a whole scene, here the
reference street: metaball sums of snow, windows of photos compared with neighbouring photos, and
places of which the photos are asked whether they see sky behind.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import common
import numpy as np
import torch
from kernels import bounds

from climatenerf.ops.cpu import metaballs
from climatenerf.ops.cpu import plane_sweep as matching
from climatenerf.scene import read_scene
from climatenerf.training.dataset import TrainingPixels
from climatenerf.training.evidence.multiview_stereo import build_pictures, depth_ranges
from climatenerf.training.run import begin
from climatenerf.training.settings import FitSettings
from climatenerf.weather.snow.lattice import Deposits, SnowGrid, grow

ROOT = Path(__file__).resolve().parents[1]
WINDOW = (2 * matching.SIDE + 1) ** 2


@dataclass(frozen=True)
class Job:
    """A kernel at work, and what it needs for each of its units.

    Attributes:
        run: does the work.
        unit: what is counted.
        units: how many of them.
        reads: of cache lines from random places, for each unit.
        multiply_adds: for each unit.
    """

    run: Callable[[], object]
    unit: str
    units: int
    reads: float
    multiply_adds: float


def snow_sums(random: np.random.Generator, points: int) -> Job:
    """Places about the surface of 15 cm of snow on rough, level ground."""
    grid = SnowGrid((0.0, 0.0), (-1.0, 1.0), 0.05, 96)
    line = (np.arange(2 * grid.half_cells) + 0.5 - grid.half_cells) * grid.spacing
    x, y = (each.ravel() for each in np.meshgrid(line, line))
    place = np.stack([x, y, random.normal(0, 0.02, x.shape)], -1).astype(np.float32)
    even = np.ones(len(x), np.float32)
    deposits = Deposits(grid, place, even, 0.8 * even, np.array([0, len(x)]), np.array([1]))
    lattice = grow(deposits, 0.15)
    at = random.uniform((-4, -4, 0.1), (4, 4, 0.2), (points, 3)).astype(np.float32)
    # Of 64 vertices the distance (3), two powers and sums of four things, their slopes and means.
    # Four planes of each of three arrays; heights are twice as wide.
    return Job(lambda: metaballs.evaluate(at, lattice), "points", points, 16, 64 * 20)


def windows(random: np.random.Generator, pixels: TrainingPixels, points, count: int) -> Job:
    """Windows of photos, each at all distances at which the kernel looks."""
    pictures = build_pictures(pixels, *depth_ranges(pixels, points, (1.0, 5.0)))
    view = random.integers(0, len(pictures.size), count)
    place = (random.uniform(0.05, 0.95, (count, 2)) * pictures.size[view]).astype(np.float32)
    looked = 0
    window = np.empty(WINDOW, np.float32)
    for i, (x, y) in zip(view, place, strict=True):
        if matching._take_window(pictures, i, x, y, window):
            tile = matching._tile(pictures, i, x, y)
            steps = matching._steps(pictures, i, tile, x, y)
            looked += steps * int((pictures.others[i, tile] >= 0).sum())
    # Of each of a window's pixels: where it comes to lie (15), its level (6), three sums. Finer
    # looks at the best distances are not counted. What is read lies in one core's own cache.
    return Job(
        lambda: matching.match(pictures, view, place), "windows seen", looked, 0, 24 * WINDOW
    )


def places(random: np.random.Generator, pixels: TrainingPixels, count: int) -> Job:
    """Places about the cameras of which every photo is asked."""
    witness = pixels.sky_hull
    assert witness is not None, "the reference street has labels"
    x = torch.from_numpy(random.normal(0, 8, (count, 3)).astype(np.float32))
    radius = torch.full((count,), 0.1)
    asked = count * len(witness.views[-1])
    return Job(lambda: witness.consensus(x, radius), "places seen", asked, 0.5, 13)


def main() -> None:
    """Measures the bounds and the kernels, and prints them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--size", type=float, default=1.0, help="of the work, 1: as a program's")
    options = parser.parse_args()
    random = np.random.default_rng(0)
    scene = read_scene(ROOT / "reference" / "street")
    fitting = begin(scene, FitSettings(minutes=None, steps=1, multiview_stereo=False), 1)
    size = options.size
    jobs = {
        "metaball sums": snow_sums(random, int(2**18 * size)),
        "matching": windows(random, fitting.pixels, fitting.points, int(2**14 * size)),
        "witnesses": places(random, fitting.pixels, int(2**18 * size)),
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
            "share of bound": rate * each,
            "seconds": taken,
        }
    common.report("speed of the kernels that ask a scene, and their bounds", rows, seed=0)


if __name__ == "__main__":
    main()
