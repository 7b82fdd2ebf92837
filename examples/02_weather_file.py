"""Weather that changes over time, from a file: three moments of one view, side by side.

    python examples/02_weather_file.py [RUN] [WEATHER.toml]

Needs the run of 01_fit_and_flood.py. Writes RUN/weather and RUN/weather.jpg.
"""

import json
import sys
from pathlib import Path

import numpy as np
from PIL import Image

import climatenerf

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "runs/example")
file = Path(sys.argv[2]) if len(sys.argv) > 2 else Path(__file__).parent / "weather.toml"

out = folder / "weather"
fps = 0.5  # one frame every two seconds
climatenerf.render_movie(folder, out, file, path="still:0020", frames=3, fps=fps, size=(192, 108))
frames = json.loads((out / "movie.json").read_text())["frames"]
for frame in frames:
    weather, measured = frame["weather"], frame["measured"]
    print(
        f"{frame['time']:.0f} s: water {weather['flood']['level']}, visibility"
        f" {weather['smog']['visibility']}; water on {measured['water_share']:.0%} of the picture,"
        f" snow on {measured['snow_share']:.0%},"
        f" mean transmittance {measured['mean_transmittance']:.2f}"
    )
pictures = [np.asarray(Image.open(out / frame["file"])) for frame in frames]
Image.fromarray(np.hstack(pictures)).save(folder / "weather.jpg", comment=b"simulated")
print(f"wrote {folder / 'weather.jpg'}")
