"""The program as a library: fit the street that comes along for a few steps, render it flooded.

    python examples/01_fit_and_flood.py [STEPS] [RUN]

Leaves a run folder (default runs/example, which the other examples use) and RUN/flooded.png.
700 steps on small photos give a blurred street in some minutes (with 300 there is haze left that
keeps snow from the ground); `climatenerf fit` does it properly.
"""

import shutil
import sys
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np

from climatenerf.field.checkpoint import load_field
from climatenerf.output.layers import SIMULATED
from climatenerf.output.video import write_png
from climatenerf.paths.camera_path import camera_path
from climatenerf.render.frame import render_frame
from climatenerf.render.session import prepare
from climatenerf.scene import load_scene, read_scene
from climatenerf.training.run import fit_scene
from climatenerf.training.trainer import FitSettings, Report
from climatenerf.weather.description import KeyframedWeather
from climatenerf.weather.parameters import Flood, Weather

steps = int(sys.argv[1]) if len(sys.argv) > 1 else 700
run = Path(sys.argv[2] if len(sys.argv) > 2 else "runs/example")
shutil.rmtree(run, ignore_errors=True)  # a folder that holds a run is never overwritten


def told(state: Report) -> None:
    if state.step % 50 == 0:
        print(f"step {state.step}: {state.psnr:.1f} dB on the training pixels")


settings = FitSettings(minutes=None, steps=steps, samples_per_step=2**15)
with as_file(files("climatenerf") / "assets" / "street") as street:
    metrics = fit_scene(read_scene(street), run, settings, 4, False, told, lambda done, total: None)
print(f"held-out photos: {metrics['psnr']:.1f} dB")

# From here on only the run folder is needed. Library values are SI: metres, seconds, radians.
field, scene = load_field(run), load_scene(run)
weather = KeyframedWeather(Weather(flood=Flood(level=0.5, wind_speed=3.0)), keyframes={})
path = camera_path("still:0020", scene, frames=1, size=(192, 108))
places = path.c2w[:, :3, 3]
stage = prepare(field, scene, weather, places, np.zeros(1), lambda what, share: None)
picture, layers = render_frame(stage.at(0.0), path.cameras[0], path.c2w[0])
write_png(run / "flooded.png", picture, SIMULATED)
wet = layers["mask_water"] > 0.5
print(f"water on {wet.mean():.0%} of {run / 'flooded.png'}")
