"""Render movies of a run in many weathers, and score how steady they are.

python benchmarks/movies.py RUN -o FOLDER
python benchmarks/movies.py RUN -o FOLDER --only overcast snow --level "-1 m" --size 480x270

FOLDER/NAME has the movie of each weather along the path of the photos, FOLDER/sun that of a sun
which moves over a still camera. `warp` is the RMS difference of neighbouring frames warped to one
another by depth, over their contrast, water and sky left out; `difference` is the same in display
values, and `over_clean` its ratio to the clean movie's. `step` is the largest relative change of
the mean luma from one frame to the next, and `jump` the largest change of that change: a sun that
moves evenly has a small one, exposure that pumps a large one. Finished frames are kept, so a
stopped run resumes.
"""

import argparse
from pathlib import Path
from typing import Any

import common
import numpy as np
from PIL import Image

import climatenerf
from climatenerf.api import Run
from climatenerf.cli.render import parse_size
from climatenerf.core.srgb import LUMA
from climatenerf.evaluation.consistency import Frame, warp_difference, warp_error
from climatenerf.paths.camera_path import camera_path
from climatenerf.weather.description import read_weather, weather_from_table

FRAMES = 48
SUN = """[sky]
kind = "clear"
[sun]
elevation = {{ "0 s" = "60 deg", "2 s" = "15 deg" }}
azimuth = {{ "0 s" = "{start} deg", "2 s" = "{end} deg" }}
"""


def weathers(level: str, azimuth: float) -> dict[str, dict[str, Any]]:
    """Return the weathers by name, as tables of a weather file."""
    overcast = {"sky": {"kind": "overcast"}}
    return {
        "clean": {},
        "overcast": overcast,
        "clear": {"sky": {"kind": "clear"}, "sun": sun(15, azimuth)},
        "storm": {"sky": {"kind": "storm"}},
        "dusk": {"sky": {"kind": "dusk", "ev": -2}},
        "fog": {"smog": {"visibility": "80 m", "kind": "fog"}},
        "fog, overcast": overcast | {"smog": {"visibility": "80 m", "kind": "fog"}},
        "snow": overcast | {"snow": {"depth": "10 cm"}},
        "flood": {"flood": {"level": level}},
        "autumn": {"season": {"kind": "autumn"}},
        "winter": {"season": {"kind": "winter"}},
        "drought": {"season": {"kind": "drought"}},
        "autumn, flood": {"season": {"kind": "autumn"}, "flood": {"level": level}},
        "winter, snow": {"season": {"kind": "winter"}, "snow": {"depth": "10 cm"}},
    }


def sun(elevation: float, azimuth: float) -> dict[str, str]:
    """Return the table of a sun, degrees."""
    return {"elevation": f"{elevation:g} deg", "azimuth": f"{azimuth:g} deg"}


def pictures(folder: Path) -> list[np.ndarray]:
    """Return the frames of a movie's folder as display values, [0, 1]."""
    return [np.asarray(Image.open(path)) / 255 for path in sorted(folder.glob("frames/*.png"))]


def layer(folder: Path, name: str, index: int) -> np.ndarray:
    """Return a layer of a frame."""
    return np.load(folder / name / f"{index:04d}.npz")[name]


def luma_changes(shown: list[np.ndarray]) -> dict[str, float]:
    """Return the largest relative change of the mean luma, and of that change."""
    mean = np.log([(picture @ np.array(LUMA)).mean() for picture in shown])
    return {
        "step": float(abs(np.diff(mean)).max()),
        "jump": float(abs(np.diff(mean, 2)).max()),
    }


def steadiness(folder: Path, run: Run, size: tuple[int, int]) -> dict[str, float]:
    """Score the movie in a folder, which has layers of depth."""
    shown = pictures(folder)
    path = camera_path("training", run.scene, FRAMES, size)
    frames = []
    for index, picture in enumerate(shown):
        depth = layer(folder, "depth", index)
        flooded = (folder / "mask_water").is_dir()
        water = layer(folder, "mask_water", index) > 0.5 if flooded else np.zeros_like(depth, bool)
        frames.append(Frame(picture, depth, water, path.c2w[index], path.cameras[index]))
    pairs = list(zip(frames, frames[1:], strict=False))
    found = {
        "warp": float(np.nanmean([warp_error(*pair) for pair in pairs])),
        "difference": float(np.nanmean([warp_difference(*pair) for pair in pairs])),
    }
    return found | luma_changes(shown)


def main() -> None:
    """Render, score and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--only", nargs="+", help="weathers, or sun; default: all")
    parser.add_argument("--size", default="480x270")
    parser.add_argument("--level", default="0.3 m")
    parser.add_argument("--azimuth", type=float, default=60.0, help="of the low sun, degrees")
    options = parser.parse_args()
    run, size = climatenerf.load_run(options.run), parse_size(options.size)
    chosen = weathers(options.level, options.azimuth)
    if options.only:
        chosen = {"clean": {}} | {n: t for n, t in chosen.items() if n in options.only}
    results: dict[str, Any] = {}
    for name, table in chosen.items():
        folder = options.out / name.replace(", ", "-")
        layers = ("depth", "mask_water") if "flood" in table else ("depth",)
        weather = weather_from_table(table)
        climatenerf.render_movie(run, folder, weather, frames=FRAMES, size=size, layers=layers)
        results[name] = steadiness(folder, run, size)
        ratio = results[name]["difference"] / results["clean"]["difference"]
        results[name]["over_clean"] = ratio
    if not options.only or "sun" in options.only:
        folder = options.out / "sun"
        file = options.out / "sun.toml"
        file.write_text(SUN.format(start=options.azimuth, end=options.azimuth + 60))
        weather = read_weather(file)
        climatenerf.render_movie(run, folder, weather, path="still", frames=FRAMES, size=size)
        results["sun"] = luma_changes(pictures(folder))
    common.report("steadiness of movies", results)


if __name__ == "__main__":
    main()
