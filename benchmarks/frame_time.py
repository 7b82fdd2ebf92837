"""Time a frame: clean, with water on about 40 % of it, with high waves, in smog, under snow.

python benchmarks/frame_time.py RUN
python benchmarks/frame_time.py RUN --size 480x270 --path still --repeats 5
python benchmarks/frame_time.py RUN --sizes 240x135 480x270 960x540 1920x1080
python benchmarks/frame_time.py RUN --bakes

The flood's level is chosen on a small picture so that water covers 35 to 45 % of the frame; the
coverage reached is reported. The preparation (light, waves, snowfall) is timed once, separately.
With --sizes a clean frame of each size is timed, and the exponent of seconds over pixels reported
(1 is linear). With --bakes the preparation of 10 cm of snow and of 2 m is timed.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import common
import numpy as np
import torch

from climatenerf.cli.render import parse_size
from climatenerf.core.device import CPU
from climatenerf.field.checkpoint import load_field
from climatenerf.field.protocol import observed
from climatenerf.paths.camera_path import CameraPath, camera_path
from climatenerf.render.frame import render_frame
from climatenerf.render.session import RenderSession
from climatenerf.scene import load_scene
from climatenerf.weather.flood.parameters import Flood
from climatenerf.weather.light.parameters import Sky
from climatenerf.weather.smog.parameters import Smog
from climatenerf.weather.snow.layer import bake_snow
from climatenerf.weather.snow.parameters import Snow
from climatenerf.weather.weather import Weather
from climatenerf.weather.world import World

# The waves of the reference street's flood-waves.
WAVES = Flood(wind_speed=3.0, wave_scale=4.0, attenuation=(1.2, 1.2, 1.2), colour=(0.0, 0.0, 0.0))


def water_level(field, scene, path: CameraPath, coverage: float = 0.4) -> float:
    """Return the level above the datum (m) at which water covers about `coverage` of the frame."""
    camera, c2w = path.cameras[0].resized(120, 68), path.c2w[0]
    _, layers = render_frame(World(field), camera, c2w)
    direction = camera.directions() @ c2w[:3, :3].T
    eye = c2w[2, 3]
    # A pixel is wet if the level is above its surface; sky below the horizon lies at 1000 km.
    height = eye + np.where(np.isfinite(layers["depth"]), layers["depth"], 1e6) * direction[..., 2]
    height = np.where(direction[..., 2] < 0, height, np.inf)
    return float(min(np.quantile(height, coverage), eye - 0.05)) - scene.ground_z


WEATHERS = ("clean", "flood", "flood-waves", "smog", "snow", "snow-overcast")


def frames(
    run: Path,
    size: str,
    view: str,
    repeats: int,
    seed: int,
    names: tuple[str, ...] = WEATHERS,
    device: torch.device = CPU,
) -> dict[str, Any]:
    """Time the first frame of the camera path `view` in each weather."""
    field, scene = load_field(run, device), load_scene(run)
    path = camera_path(view, scene, 1, parse_size(size))
    level = water_level(field, scene, path)
    weathers = {
        "clean": Weather(),
        "flood": Weather(flood=Flood(level=level), seed=seed),
        "flood-waves": Weather(flood=replace(WAVES, level=level), seed=seed),
        "smog": Weather(smog=Smog(visibility=100.0)),
        "snow": Weather(snow=Snow(depth=0.1), seed=seed),
        "snow-overcast": Weather(snow=Snow(depth=0.1), sky=Sky(kind="overcast"), seed=seed),
    }
    rows: dict[str, dict] = {}
    for name, weather in ((name, weathers[name]) for name in names):
        start = time.perf_counter()
        session = RenderSession(field, scene, weather, path.c2w[:, :3, 3])
        prepared = time.perf_counter() - start
        world = session.world(0.0)
        _, layers = render_frame(world, path.cameras[0], path.c2w[0])
        seconds = common.measure(
            lambda world=world: render_frame(world, path.cameras[0], path.c2w[0]),
            repeats,
            warm_up=0,
        )
        rows[name] = {
            "seconds": seconds,
            "prepare_seconds": prepared,
            "water_coverage": float(layers["mask_water"].mean()),
            "snow_coverage": float(layers["mask_snow"].mean()),
        }
    for row in rows.values():
        row["times_clean"] = row["seconds"]["median"] / rows["clean"]["seconds"]["median"]
    return {"run": run.name, "view": path.name, "size": size, "level_m": level, "frames": rows}


def scaling(run: Path, sizes: list[str], view: str, repeats: int) -> dict[str, Any]:
    """Time a clean frame in several sizes; fit the exponent of the number of pixels."""
    field, scene = load_field(run), load_scene(run)
    world = World(field)
    rows = []
    for size in sizes:
        path = camera_path(view, scene, 1, parse_size(size))
        camera, c2w = path.cameras[0], path.c2w[0]
        seconds = common.measure(
            lambda camera=camera, c2w=c2w: render_frame(world, camera, c2w), repeats
        )
        rows.append({"size": size, "pixels": camera.width * camera.height, "seconds": seconds})
    logs = np.log([[row["pixels"], row["seconds"]["median"]] for row in rows])
    exponent = float(np.polyfit(logs[:, 0], logs[:, 1], 1)[0])
    return {"run": run.name, "view": view, "frames": rows, "exponent": exponent}


def bakes(run: Path, view: str, repeats: int, seed: int) -> dict[str, Any]:
    """Time the snowfall alone, without light, of 10 cm and of 2 m."""
    field, scene = observed(load_field(run)), load_scene(run)
    cameras = camera_path(view, scene, 1, (480, 270)).c2w[:, :3, 3]
    rows = {}
    for depth in (0.1, 2.0):
        snow = Snow(depth=depth)
        rows[f"{depth:g} m"] = common.measure(
            lambda snow=snow: bake_snow(field, snow, cameras, np.ones(3), seed=seed), repeats
        )
    ratio = rows["2 m"]["median"] / rows["0.1 m"]["median"]
    return {"run": run.name, "bakes": rows, "deep_over_shallow": ratio}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--size", default="480x270")
    parser.add_argument("--path", default="still", help="camera path; its first frame is used")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--sizes", nargs="+")
    parser.add_argument("--bakes", action="store_true")
    options = parser.parse_args()
    if options.bakes:
        found = bakes(options.run, options.path, options.repeats, options.seed)
        common.report("seconds per snowfall", found, options.seed)
        return
    if options.sizes:
        found = scaling(options.run, options.sizes, options.path, options.repeats)
        common.report("seconds per frame over its pixels", found)
        return
    found = frames(options.run, options.size, options.path, options.repeats, options.seed)
    common.report("seconds per frame", found, options.seed)


if __name__ == "__main__":
    main()
