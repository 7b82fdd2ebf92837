"""Weather from a file, changing over time: three moments of one place side by side.

    python examples/02_weather_file.py [RUN] [WEATHER.toml]

Needs the run of 01_fit_and_flood.py. Writes RUN/weather.jpg.
"""

import sys
from pathlib import Path

import numpy as np

from climatenerf.field.checkpoint import load_field
from climatenerf.output.contact_sheet import contact_sheet, write_jpeg
from climatenerf.paths.camera_path import camera_path
from climatenerf.render.frame import render_frame
from climatenerf.render.session import prepare
from climatenerf.scene import load_scene
from climatenerf.weather.description import read_weather

run = Path(sys.argv[1] if len(sys.argv) > 1 else "runs/example")
file = Path(sys.argv[2]) if len(sys.argv) > 2 else Path(__file__).parent / "weather.toml"
film = read_weather(file)
times = np.array([0.0, 2.0, 4.0])  # seconds into the movie

field, scene = load_field(run), load_scene(run)
path = camera_path("still:0020", scene, len(times), (192, 108))
stage = prepare(field, scene, film, path.c2w[:, :3, 3], times, lambda what, share: None)
frames = []
for time, camera, c2w in zip(times, path.cameras, path.c2w, strict=True):
    now = film.at(float(time))
    picture, layers = render_frame(stage.at(float(time)), camera, c2w)
    frames.append(picture)
    print(
        f"{time:.0f} s: water {now.flood.level:+.2f} m, visibility {now.smog.visibility:.0f} m;"
        f" water on {layers['mask_water'].mean():.0%} of the picture,"
        f" snow on {layers['mask_snow'].mean():.0%},"
        f" mean transmittance {layers['transmittance'].mean():.2f}"
    )
write_jpeg(run / "weather.jpg", contact_sheet([(file.stem, frames)]))
print(f"wrote {run / 'weather.jpg'}")
