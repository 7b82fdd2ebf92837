"""Measure a run's terrain and completed ground: where ground is, what making and rendering cost.

python benchmarks/ground.py RUN
python benchmarks/ground.py RUN --size 800x450 --pitch 15 --repeats 5

`cameras` has the fraction of training photos below which the field holds ground, photos show the
place without ground in the field, or the terrain completes it. Frames are rendered from the middle
training photo, turned down by --pitch degrees, without and with completed ground in turns.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import common
import numpy as np

import climatenerf
from climatenerf.cli.render import parse_size
from climatenerf.field.protocol import observed
from climatenerf.paths.camera_path import still
from climatenerf.render.completed_ground import CompletedField
from climatenerf.render.ground_evidence import terrain_below
from climatenerf.render.photo_rays import trace_photos
from climatenerf.render.session import RenderSession
from climatenerf.scene import Scene
from climatenerf.scene.terrain import Terrain
from climatenerf.weather.weather import Weather


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("--size", default="800x450")
    parser.add_argument("--pitch", type=float, default=15.0)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    run = climatenerf.load_run(options.run)
    field = observed(run.field)
    seconds: dict[str, list[float]] = {"rays of the photos": [], "terrain": []}
    for _ in range(options.repeats):
        start = time.perf_counter()
        photos = trace_photos(field, run.scene)
        middle = time.perf_counter()
        terrain = terrain_below(run.field, photos)
        seconds["rays of the photos"].append(middle - start)
        seconds["terrain"].append(time.perf_counter() - middle)
    if terrain is None:
        common.report("terrain", {"terrain": None})
        return
    results = {
        "seconds": {name: common.spread(values) for name, values in seconds.items()},
        "nodes": terrain.height.shape,
        "cell_m": terrain.cell,
        "cameras": below_cameras(terrain, run.scene),
        "frames": frames(run, terrain, options),
    }
    common.report("terrain and completed ground", results)


def below_cameras(terrain: Terrain, scene: Scene) -> dict[str, float]:
    """Return where ground is below the training photos' cameras, as fractions of the photos."""
    eyes = np.stack([scene.c2w_world(view)[:3, 3] for view in scene.of_split("train")])
    column, row = np.rint((eyes[:, :2] - terrain.origin) / terrain.cell).astype(int).T
    kinds = {"held": terrain.seen, "open": terrain.open, "completed": terrain.completed}
    return {name: float(kind[row, column].mean()) for name, kind in kinds.items()}


def frames(run: Any, terrain: Terrain, options: argparse.Namespace) -> dict[str, Any]:
    """Time a clean frame of the middle photo, turned down, of both fields in turns."""
    views = run.scene.of_split("train")
    path = still(run.scene, views[len(views) // 2].name, 1, parse_size(options.size))
    cosine, sine = np.cos(np.radians(options.pitch)), np.sin(np.radians(options.pitch))
    c2w = path.c2w[0].copy()
    c2w[:3, :3] = c2w[:3, :3] @ [[1, 0, 0], [0, cosine, sine], [0, -sine, cosine]]
    fields = {"fitted": run.field, "completed": CompletedField(run.field, terrain)}
    sessions = {
        name: RenderSession(field, run.scene, Weather(), c2w[None, :3, 3])
        for name, field in fields.items()
    }
    times: dict[str, list[float]] = {name: [] for name in sessions}
    completed = 0.0
    for turn in range(options.repeats + 1):
        for name, session in sessions.items():
            start = time.perf_counter()
            frame = session.frame(path.cameras[0], c2w)
            if turn:  # the first one compiles
                times[name].append(time.perf_counter() - start)
            completed = 1 - float(frame.layers["seen"].mean())
    return {
        "size": options.size,
        "completed_fraction": completed,
        "seconds": {name: common.spread(values) for name, values in times.items()},
    }


if __name__ == "__main__":
    main()
