"""Score the antialiasing of waves against 64 samples a pixel.

python benchmarks/water_aliasing.py RUN
python benchmarks/water_aliasing.py RUN --level "-1 m" --size 320x180 --views 2

"filtered" is what `render` does: waves are filtered over the parts of a pixel. "filtered 2x2" is
`--supersample 2`. "unfiltered" and "unfiltered 2x2" have waves as sharp as they are computed; the
second is the paper's way. The truth has 8x8 unfiltered samples. `psnr` is over pixels of water in
dB, by distance; `change` compares what changes within 1/24 s with the true change: their
correlation, and the ratio of their sizes (more than 1: sparkle).
"""

import argparse
from pathlib import Path
from typing import Any

import common
import numpy as np
import torch

from climatenerf.cli.render import parse_size
from climatenerf.core.cameras import Camera
from climatenerf.core.srgb import to_display
from climatenerf.field.checkpoint import load_field
from climatenerf.paths.camera_path import camera_path
from climatenerf.render.frame import traced_rays
from climatenerf.render.integrator import trace
from climatenerf.render.session import RenderSession
from climatenerf.scene import load_scene
from climatenerf.weather.flood.parameters import Flood
from climatenerf.weather.units import LENGTH, SPEED, parse_quantity
from climatenerf.weather.weather import Weather
from climatenerf.weather.world import World

NEAR, FAR = 5.0, 15.0  # m
ROWS = {
    "filtered": (1, True),
    "filtered 2x2": (2, True),
    "unfiltered": (1, False),
    "unfiltered 2x2": (2, False),
}
TRUE = (8, False)
STEP = 1 / 24  # s


def picture(
    world: World, camera: Camera, c2w: np.ndarray, samples: int, filtered: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the frame in sRGB, its depth (m) and its fraction of water.

    Args:
        world: what is rendered.
        camera: of the frame.
        c2w: its pose.
        samples: along each side of a pixel.
        filtered: whether waves are filtered over a sample's footprint.
    """
    fine = camera.resized(camera.width * samples, camera.height * samples)
    o, d, angle = traced_rays(fine, c2w)
    seen = trace(world, o, d, angle if filtered else torch.full_like(angle, 1e-6))

    def mean(values: torch.Tensor) -> np.ndarray:
        blocks = values.view(camera.height, samples, camera.width, samples, -1)
        return blocks.mean((1, 3)).numpy()

    depth = seen.depth.nan_to_num(posinf=1e6)
    srgb = to_display(mean(seen.rgb))
    return srgb, mean(depth)[..., 0], mean(seen.layers["mask_water"])[..., 0]


def bands(depth: np.ndarray, water: np.ndarray) -> dict[str, np.ndarray]:
    """Return the pixels of water by distance."""
    wet = water > 0.99
    return {
        "near": wet & (depth < NEAR),
        "middle": wet & (depth >= NEAR) & (depth < FAR),
        "far": wet & (depth >= FAR),
        "all": wet,
    }


def score(run: Path, size: str, views: int, flood: Flood, seed: int) -> dict[str, Any]:
    """Render each view at two moments by each row and by the truth; compare."""
    field, scene = load_field(run), load_scene(run)
    path = camera_path("training", scene, views, parse_size(size))
    session = RenderSession(field, scene, Weather(flood=flood, seed=seed), path.c2w[:, :3, 3])
    error: dict[str, dict[str, list[float]]] = {name: {} for name in ROWS}
    change: dict[str, list[np.ndarray]] = {name: [] for name in (*ROWS, "true")}
    for camera, c2w in zip(path.cameras, path.c2w, strict=True):
        moments = [session.world(time) for time in (1.0, 1.0 + STEP)]
        true, depth, water = picture(moments[0], camera, c2w, *TRUE)
        later = picture(moments[1], camera, c2w, *TRUE)[0]
        wet = bands(depth, water)
        change["true"].append((later - true)[wet["all"]])
        for name, how in ROWS.items():
            own, after = (picture(world, camera, c2w, *how)[0] for world in moments)
            change[name].append((after - own)[wet["all"]])
            for band, pixels in wet.items():
                squared = ((own - true)[pixels] ** 2).ravel()
                error[name].setdefault(band, []).extend(squared)
    rows = {}
    moved = np.concatenate(change["true"]).ravel()
    for name in ROWS:
        own = np.concatenate(change[name]).ravel()
        rows[name] = {
            "psnr": {
                band: float(-10 * np.log10(np.mean(each))) if each else None
                for band, each in error[name].items()
            },
            "change": {
                "correlation": float(np.corrcoef(own, moved)[0, 1]),
                "size": float(own.std() / moved.std()),
            },
        }
    return {"run": run.name, "size": size, "views": views, "rows": rows}


def main() -> None:
    """Score and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("--size", default="320x180")
    parser.add_argument("--views", type=int, default=2)
    parser.add_argument("--level", default="0.5 m")
    parser.add_argument("--wind", default="2 m/s")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    level, wind = parse_quantity(options.level, LENGTH), parse_quantity(options.wind, SPEED)
    flood = Flood(level=level, wind_speed=wind)
    found = score(options.run, options.size, options.views, flood, options.seed)
    common.report("antialiasing of waves", {"level_m": level, "wind_m_s": wind} | found)


if __name__ == "__main__":
    main()
