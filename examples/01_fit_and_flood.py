"""The program as a library: fit the embedded street in few steps, and render it flooded.

    python examples/01_fit_and_flood.py [STEPS] [RUN]

Writes a run folder (default runs/example, which the other examples use) and a movie of one frame
in RUN/flood. 700 steps on small photos take some minutes and give a blurred street; after 300 steps
there is still haze, which keeps snow from the ground. `climatenerf fit` fits at full quality.
"""

import json
import shutil
import sys
from importlib.resources import as_file, files
from pathlib import Path

import climatenerf

steps = int(sys.argv[1]) if len(sys.argv) > 1 else 700
folder = Path(sys.argv[2] if len(sys.argv) > 2 else "runs/example")
shutil.rmtree(folder, ignore_errors=True)  # `fit` does not overwrite a run

printed = set()


def report(what: str, fraction: float) -> None:
    line = f"{what}: {10 * int(10 * fraction)} %"
    if line not in printed:
        printed.add(line)
        print(line)


with as_file(files("climatenerf") / "assets" / "street") as street:
    scene = climatenerf.open_scene(street)
    run = climatenerf.fit(
        scene, folder, steps=steps, downscale=4, samples_per_step=2**15, progress=report
    )
    print(f"held-out photos: {climatenerf.evaluate(run)['psnr']:.1f} dB")

# The run folder is sufficient from here on. All values are SI: metres, seconds, radians.
weather = climatenerf.Weather(flood=climatenerf.Flood(level=0.5, wind_speed=3.0))
out = folder / "flood"
movie = climatenerf.render_movie(
    run, out, weather, path="still:0020", frames=1, size=(192, 108), layers=["water_depth"]
)
frame = json.loads((out / "movie.json").read_text())["frames"][0]
print(f"water on {frame['measured']['water_share']:.0%} of {out / frame['file']}")
print(f"movie: {movie}")
