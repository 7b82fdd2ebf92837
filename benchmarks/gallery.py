"""Makes the contact sheets of docs/gallery from fitted runs.

python benchmarks/gallery.py street RUN
python benchmarks/gallery.py ditch RUN --level "-1.5 m" --visibility "60 m" --snow "15 cm"

A sheet NAME.jpg of at most 150 KB, marked as simulated: rows clean, flood, smog, snow and all at
once, columns along the camera path.
"""

import argparse
import tempfile
from pathlib import Path

import common
import numpy as np
from PIL import Image

from climatenerf.render.contact_sheet import contact_sheet, write_jpeg

GALLERY = Path(__file__).resolve().parents[1] / "docs" / "gallery"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name")
    parser.add_argument("run", type=Path)
    parser.add_argument("--level", default="0.5 m")
    parser.add_argument("--visibility", default="40 m")
    parser.add_argument("--snow", default="15 cm")
    parser.add_argument("--size", default="384x216")
    parser.add_argument("--path", default="training")
    parser.add_argument("--columns", type=int, default=4)
    parser.add_argument("--supersample", type=int, default=2)
    parser.add_argument("--out", type=Path, default=GALLERY)
    options = parser.parse_args()
    flood = ["--flood.level", options.level]
    smog = ["--smog.visibility", options.visibility]
    snow = ["--snow.depth", options.snow]
    weathers = {"clean": [], "flood": flood, "smog": smog, "snow": snow}
    weathers["all"] = [*flood, *smog, *snow]
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        for label, flags in weathers.items():
            out = Path(temporary) / label
            words = ["render", str(options.run), "-o", str(out), "--path", options.path]
            words += ["--frames", str(options.columns), "--size", options.size]
            common.command(*words, "--supersample", str(options.supersample), *flags)
            frames = sorted((out / "frames").glob("*.png"))
            rows.append((label, [np.asarray(Image.open(path)) for path in frames]))
    sheet = contact_sheet(rows, options.columns, cell_width=320)
    path = options.out / f"{options.name}.jpg"
    size = write_jpeg(path, sheet, max_bytes=150_000)
    common.report("contact sheet", {"file": path.name, "bytes": size})


if __name__ == "__main__":
    main()
