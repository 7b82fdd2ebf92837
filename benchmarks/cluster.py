"""Time a flooded movie on one and on two workers, and kill workers at random moments.

python benchmarks/cluster.py RUN
python benchmarks/cluster.py RUN --frames 96 --size 960x540 --kills 10

Every worker has one thread. The efficiency is frames * t1 / (n * wall): t1 is the time of a frame
with one worker, wall that of all frames with n. Start and preparation are given apart. Frames of a
render in this process, and of those with killed workers, must have the same bytes.
"""

import argparse
import hashlib
import random
import tempfile
import time
from pathlib import Path

import psutil
from common import report

from climatenerf import Flood, Weather, api
from climatenerf.cli.render import parse_size
from climatenerf.cluster import workers as cluster


def hashes(out: Path) -> dict[str, str]:
    """Hash of each frame."""
    frames = sorted((out / "frames").glob("*.png"))
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in frames}


def kill_one() -> bool:
    """Kill one of this process's workers; whether there was one."""
    below = psutil.Process().children(recursive=True)
    alive = [process for process in below if "spawn_main" in " ".join(process.cmdline())]
    if alive:
        random.choice(alive).kill()
    return bool(alive)


def render(run, out: Path, given: dict, workers: int | None, kill_at: float = 2.0) -> dict:
    """Render; times of the whole and of the frames alone, s."""
    begin = time.perf_counter()
    first, killed = [], []

    def progress(what: str, fraction: float) -> None:
        if what == "frames":
            first.append(time.perf_counter())
            if fraction >= kill_at and not killed:
                killed.append(kill_one())

    api.render_movie(run, out, workers=workers, progress=progress, **given)
    whole = time.perf_counter() - begin
    return {"whole_s": whole, "frames_s": first[-1] - first[0], "killed": killed == [True]}


def main() -> None:
    """Print the measurements as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--size", default="960x540")
    parser.add_argument("--level", type=float, default=0.2, help="of the water, m")
    parser.add_argument("--kills", type=int, default=0)
    parser.add_argument("--kill-size", default="240x135")
    options = parser.parse_args()
    weather = Weather(flood=Flood(level=options.level))
    given = {"weather": weather, "frames": options.frames, "size": parse_size(options.size)}
    found: dict[str, object] = {"frames": options.frames, "size": options.size}
    with tempfile.TemporaryDirectory() as temporary:
        top = Path(temporary)
        api.load_run(options.run).completed()  # saves the terrain
        for count in (1, 2, 1, 2):
            cluster._cores = lambda count=count: count
            run = api.load_run(options.run)
            row = render(run, top / f"{count}", given, count)
            row["frame_s"] = row["frames_s"] / options.frames
            found.setdefault(f"{count} workers", []).append(row)
            pictures = hashes(top / f"{count}")
            assert found.setdefault("hashes", pictures) == pictures
            for path in sorted((top / f"{count}").rglob("*"), reverse=True):
                path.rmdir() if path.is_dir() else path.unlink()
        one = min(row["frames_s"] for row in found["1 workers"])
        two = min(row["frames_s"] for row in found["2 workers"])
        found["efficiency"] = one / (2 * two)
        del found["hashes"]
        cluster._cores = lambda: 2
        small = given | {"size": parse_size(options.kill_size)}
        if options.kills:
            run = api.load_run(options.run)
            render(run, top / "serial", small, None)
        killed = same = 0
        for number in range(options.kills):
            out = top / f"kill{number}"
            row = render(run, out, small, 2, random.uniform(0.01, 0.95))
            killed += row["killed"]
            same += hashes(out) == hashes(top / "serial")
        found["kills"] = {"runs": options.kills, "killed": killed, "same_bytes": same}
    report("cluster", found)


if __name__ == "__main__":
    main()
