"""Measure the memory of a fit, and its growth with the number of photos.

python benchmarks/memory.py
python benchmarks/memory.py --photos 50 100 200 --size 1000x750 --steps 300

The photos are those of the embedded street, enlarged and repeated, each with a camera of its own
(the worst case). Every fit runs in a process of its own. Reported are peak resident memory in GB
(10^9 bytes), the growth per photo, and the size of a photo's 8-bit pixels.
"""

import argparse
import json
import tempfile
from pathlib import Path

import common
import numpy as np
from PIL import Image

from climatenerf.cli.render import parse_size
from climatenerf.scene import read_scene

STREET = Path(common.__file__).resolve().parents[1] / "src/climatenerf/assets/street"


def capture(folder: Path, photos: int, width: int, height: int, labels: bool) -> None:
    """Write a capture of some photos in nerfstudio's format."""
    scene = read_scene(STREET)
    (folder / "images").mkdir(parents=True)
    (folder / "labels").mkdir()
    frames = []
    for index in range(photos):
        view = scene.views[index % len(scene.views)]
        name = f"{index:04d}"
        with Image.open(view.path) as photo:
            photo.resize((width, height)).save(folder / f"images/{name}.jpg", quality=90)
        if labels:
            with Image.open(STREET / "labels" / f"{view.path.stem}.png") as label:
                nearest = label.resize((width, height), Image.Resampling.NEAREST)
                nearest.save(folder / f"labels/{name}.png")
        c2w = np.array(view.c2w) @ np.diag([1.0, -1.0, -1.0, 1.0])
        camera = scene.cameras[view.camera].resized(width, height)
        frames.append(
            {
                "file_path": f"images/{name}.jpg",
                "transform_matrix": c2w.tolist(),
                "w": width,
                "h": height,
                "fl_x": camera.fx + 1e-3 * index,
                "fl_y": camera.fy,
                "cx": camera.cx,
                "cy": camera.cy,
            }
        )
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))


def peak(scene: Path, run: Path, steps: int) -> float:
    """Return the peak resident memory of a fit, bytes."""
    args = ["-m", "climatenerf", "fit", str(scene), "-o", str(run)]
    return common.peak_bytes([*args, "--minutes", "60", "--steps", str(steps), "--metric-input"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--photos", type=int, nargs="+", default=[50, 200])
    parser.add_argument("--size", default="1000x750")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--no-labels", action="store_true")
    options = parser.parse_args()
    size = parse_size(options.size)
    if size is None:
        parser.error("--size must be WxH")
    width, height = size
    rows = []
    for photos in options.photos:
        with tempfile.TemporaryDirectory() as temporary:
            scene = Path(temporary) / "scene"
            capture(scene, photos, width, height, not options.no_labels)
            bytes_ = peak(scene, Path(temporary) / "run", options.steps)
        rows.append({"photos": photos, "peak_gb": bytes_ / 1e9})
    first, last = rows[0], rows[-1]
    grown = last["photos"] - first["photos"]
    results = {"size": options.size, "steps": options.steps, "fits": rows}
    if grown:
        results["mb_per_photo"] = 1e3 * (last["peak_gb"] - first["peak_gb"]) / grown
        results["pixels_mb_per_photo"] = 3e-6 * width * height
    common.report("peak memory of fitting", results)


if __name__ == "__main__":
    main()
