"""How long does a frame take: clean, with water on about 40 % of it, in smog, under snow?

python benchmarks/frame_time.py RUN
python benchmarks/frame_time.py RUN --size 480x270 --path still --repeats 5

The flood's level is searched for (on a small picture) so that water shows on 35 to 45 % of the
frame; the share reached is reported. Preparing (light, waves, snowfall) is timed once, apart.
"""

import argparse
import time
from pathlib import Path

import common
import numpy as np

from climatenerf.cli.render import parse_size
from climatenerf.field.checkpoint import load_field
from climatenerf.render.camera_path import CameraPath, camera_path
from climatenerf.render.frame import render_frame
from climatenerf.render.stage import prepare
from climatenerf.scene import load_scene
from climatenerf.weather.description import KeyframedWeather
from climatenerf.weather.parameters import Flood, Smog, Snow, Weather


def water_level(field, scene, path: CameraPath, wanted: float = 0.4) -> float:
    """Level over the datum at which about `wanted` of the frame shows water, by its depth layer."""
    camera, c2w = path.cameras[0].resized(120, 68), path.c2w[0]
    stage = prepare(field, scene, KeyframedWeather(Weather(), {}), c2w[None, :3, 3], np.zeros(1),
                    lambda *_: None)  # fmt: skip
    _, layers = render_frame(stage.at(0.0), camera, c2w)
    direction = camera.directions() @ c2w[:3, :3].T
    eye = c2w[2, 3]
    # A pixel is wet once the level is above its surface, or above the horizon's foot for sky.
    height = eye + np.where(np.isfinite(layers["depth"]), layers["depth"], 1e6) * direction[..., 2]
    height = np.where(direction[..., 2] < 0, height, np.inf)
    return float(min(np.quantile(height, wanted), eye - 0.05)) - scene.ground_z


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--size", default="480x270")
    parser.add_argument("--path", default="still", help="camera path; its first frame is used")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    field, scene = load_field(options.run), load_scene(options.run)
    path = camera_path(options.path, scene, 1, parse_size(options.size))
    level = water_level(field, scene, path)
    weathers = {
        "clean": Weather(),
        "flood": Weather(flood=Flood(level=level), seed=options.seed),
        "smog": Weather(smog=Smog(visibility=100.0)),
        "snow": Weather(snow=Snow(depth=0.1), seed=options.seed),
    }
    rows: dict[str, dict] = {}
    for name, weather in weathers.items():
        start = time.perf_counter()
        stage = prepare(field, scene, KeyframedWeather(weather, {}), path.c2w[:, :3, 3],
                        np.zeros(1), lambda *_: None)  # fmt: skip
        prepared = time.perf_counter() - start
        world = stage.at(0.0)
        _, layers = render_frame(world, path.cameras[0], path.c2w[0])
        seconds = common.measure(
            lambda world=world: render_frame(world, path.cameras[0], path.c2w[0]),
            options.repeats,
            warm_up=0,
        )
        rows[name] = {
            "seconds": seconds,
            "prepare_seconds": prepared,
            "water_share": float(layers["mask_water"].mean()),
            "snow_share": float(layers["mask_snow"].mean()),
        }
    for row in rows.values():
        row["times_clean"] = row["seconds"]["median"] / rows["clean"]["seconds"]["median"]
    about = {"run": options.run.name, "view": path.name, "size": options.size, "level_m": level}
    common.report("seconds a frame", {**about, "frames": rows}, options.seed)


if __name__ == "__main__":
    main()
