"""Time frames that can be cancelled, and how long a render computes between two checkpoints.

python benchmarks/cancelling.py RUN
python benchmarks/cancelling.py RUN --size 480x270 --frames 5

A session's frame is rendered with and without a callback for cancelling, in turns. `longest_gap_s`
is the longest time between two calls of the callback: a viewer that cancels waits at most so long.
"""

import argparse
import statistics
import time
from pathlib import Path
from typing import Any

import common
from frame_time import water_level

from climatenerf.cli.render import parse_size
from climatenerf.field.checkpoint import load_field
from climatenerf.paths.camera_path import CameraPath, camera_path
from climatenerf.render.session import RenderSession
from climatenerf.scene import load_scene
from climatenerf.weather.flood.parameters import Flood
from climatenerf.weather.smog.parameters import Smog
from climatenerf.weather.snow.parameters import Snow
from climatenerf.weather.weather import Weather


class Clock:
    """A callback that never cancels and records when it is called."""

    def __init__(self):
        self.times = [time.perf_counter()]

    def __call__(self) -> bool:
        self.times.append(time.perf_counter())
        return False

    def gaps(self) -> list[float]:
        """Return the seconds between calls, up to now."""
        times = [*self.times, time.perf_counter()]
        return [b - a for a, b in zip(times, times[1:], strict=False)]


def compare(session: RenderSession, path: CameraPath, frames: int) -> dict[str, Any]:
    """Time the path's first frame with and without the callback."""
    camera, c2w = path.cameras[0], path.c2w[0]
    session.frame(camera, c2w)  # compiles what is not in the cache
    seconds: dict[str, list[float]] = {"plain": [], "cancellable": []}
    gaps: list[float] = []
    for _ in range(frames):
        for name, times in seconds.items():
            clock = Clock() if name == "cancellable" else None
            start = time.perf_counter()
            session.frame(camera, c2w, cancelled=clock)
            times.append(time.perf_counter() - start)
            gaps += clock.gaps() if clock else []
    gaps.sort()
    return {
        "seconds": {name: common.spread(times) for name, times in seconds.items()},
        "median_gap_s": statistics.median(gaps),
        "p99_gap_s": gaps[int(0.99 * (len(gaps) - 1))],
        "longest_gap_s": gaps[-1],
        "gaps_over_20_ms": sum(gap > 0.02 for gap in gaps) / len(gaps),
        "checkpoints": len(gaps),
    }


def main() -> None:
    """Compare each weather and print the result."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("--size", default="240x135")
    parser.add_argument("--path", default="still", help="camera path; its first frame is used")
    parser.add_argument("--frames", type=int, default=7)
    options = parser.parse_args()
    field, scene = load_field(options.run), load_scene(options.run)
    path = camera_path(options.path, scene, 1, parse_size(options.size))
    weathers = {
        "clean": Weather(),
        "flood": Weather(flood=Flood(level=water_level(field, scene, path))),
        "smog": Weather(smog=Smog(visibility=100.0)),
        "snow": Weather(snow=Snow(depth=0.1)),
    }
    rows = {
        name: compare(
            RenderSession(field, scene, weather, path.c2w[:, :3, 3]), path, options.frames
        )
        for name, weather in weathers.items()
    }
    common.report("frames that can be cancelled", {"size": options.size, "weathers": rows}, 0)


if __name__ == "__main__":
    main()
