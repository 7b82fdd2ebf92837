"""Time relit frames beside clean ones, and the preparation of light, on a fitted run.

python benchmarks/relight.py RUN
python benchmarks/relight.py RUN --photo t01.jpg --repeats 5

Rows are frames of one camera at 480 by 270 pixels, in turn, so that other load meets all alike.
`over_clean` is the ratio of the medians. `prepared_s` is the time until the first frame, with
the light of the photos, probes and maps of the sun found anew.
"""

import argparse
import statistics
import time
from pathlib import Path

import common

from climatenerf.core.cameras import Camera
from climatenerf.field.checkpoint import load_field
from climatenerf.paths.camera_path import still
from climatenerf.render.session import RenderSession
from climatenerf.scene import load_scene
from climatenerf.weather.description import weather_from_table

SIZE = (480, 270)
WEATHERS: dict[str, dict] = {
    "clean": {},
    "overcast": {"sky": {"kind": "overcast"}},
    "low sun": {"sky": {"kind": "clear"}, "sun": {"elevation": "15 deg", "azimuth": "60 deg"}},
    "fog": {"smog": {"visibility": "80 m", "kind": "fog"}},
    "snow": {"snow": {"depth": "10 cm"}},
    "snow, paper": {"snow": {"depth": "10 cm", "light": "paper"}},
    "flood": {"flood": {"level": "0.3 m"}},
}


def main() -> None:
    """Render and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("--photo", help="name of the photo whose camera is used")
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    field, scene = load_field(options.run), load_scene(options.run)
    path = still(scene, options.photo, 1, SIZE)
    camera: Camera = path.cameras[0]
    sessions, prepared = {}, {}
    for name, table in WEATHERS.items():
        start = time.perf_counter()
        sessions[name] = RenderSession(field, scene, weather_from_table(table))
        sessions[name].frame(camera, path.c2w[0])
        prepared[name] = time.perf_counter() - start
    seconds: dict[str, list[float]] = {name: [] for name in WEATHERS}
    for _ in range(options.repeats):
        for name, session in sessions.items():
            start = time.perf_counter()
            session.frame(camera, path.c2w[0])
            seconds[name].append(time.perf_counter() - start)
    clean = statistics.median(seconds["clean"])
    rows = [
        {
            "weather": name,
            "median_s": statistics.median(values),
            "spread_s": max(values) - min(values),
            "over_clean": statistics.median(values) / clean,
            "prepared_s": prepared[name],
        }
        for name, values in seconds.items()
    ]
    common.report("relit frames", {"size": SIZE, "repeats": options.repeats, "rows": rows})


if __name__ == "__main__":
    main()
