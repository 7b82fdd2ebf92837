"""Time the checks of a capture: `climatenerf check` against the time that reading alone takes.

python benchmarks/check_capture.py
python benchmarks/check_capture.py --photos 100 1000 --points 20000

Captures are made from the photos of the embedded street: COLMAP models with as many photos as
requested, each with a label, a mask and the points that it shows; and the same as transforms.json
without points, whose photos are matched.
"""

import argparse
import json
import os
import tempfile
import time
from pathlib import Path
from typing import Any

import common
import numpy as np
from PIL import Image

from climatenerf.scene import Scene, load_scene, read_scene
from climatenerf.scene.checks.check import corrected
from climatenerf.scene.checks.sidecars import sidecar_findings, unused_findings
from climatenerf.scene.export import export_colmap, export_transforms
from climatenerf.scene.scene import View

STREET = Path(__file__).resolve().parents[1] / "src" / "climatenerf" / "assets" / "street"


def capture(folder: Path, photos: int, points: int, model: bool) -> Path:
    """Make a capture of the street with many photos, by links to its own."""
    street = load_scene(STREET)
    random = np.random.default_rng(0)
    cloud = street.points
    assert cloud is not None
    cloud = cloud[random.integers(len(cloud), size=points)] + random.normal(0, 1e-3, (points, 3))
    for name in ("images", "labels", "masks"):
        (folder / name).mkdir(parents=True)
    views = []
    for i in range(photos):
        source = street.views[i % len(street.views)]
        path = folder / "images" / f"{i:04}{source.path.suffix}"
        os.link(source.path, path) if _same_device(source.path, folder) else _copy(source, path)
        c2w = source.c2w.copy()
        c2w[:3, 3] += random.normal(0, 1e-3, 3)
        local = (cloud - c2w[:3, 3]) @ c2w[:3, :3]
        camera = street.cameras[source.camera]
        pixel = np.nan_to_num(camera.project(local), nan=-1)
        inside = ((pixel >= 0) & (pixel < (camera.width, camera.height))).all(axis=1)
        views.append(View(path.name, path, source.camera, c2w, seen=np.flatnonzero(inside)[:2000]))
        if source.label_path is not None:
            (folder / "labels" / f"{i:04}.png").write_bytes(source.label_path.read_bytes())
        mask = np.full((camera.height, camera.width), 255, np.uint8)
        mask[: 1 + i % 9] = 0
        Image.fromarray(mask).save(folder / "masks" / f"{i:04}.png")
    scene = Scene(folder, "street", street.cameras, tuple(views), cloud if model else None)
    (export_colmap if model else export_transforms)(scene, folder)
    return folder


def _same_device(path: Path, folder: Path) -> bool:
    return path.stat().st_dev == folder.stat().st_dev


def _copy(source: View, path: Path) -> None:
    path.write_bytes(source.path.read_bytes())


def seconds_of(folder: Path, repeats: int) -> dict[str, Any]:
    """Time the whole reading of a capture, and the checks alone."""
    scene = read_scene(folder)

    def checks() -> None:
        found = corrected(scene)
        sidecar_findings(found)
        unused_findings(found, found.views)

    codes = [each.code for each in scene.findings]
    return {
        "checks": common.measure(checks, repeats),
        "reading_with_checks": common.measure(lambda: read_scene(folder), repeats, 0),
        "findings": codes,
    }


def main() -> None:
    """Time each size of capture and print the result."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--photos", type=int, nargs="+", default=[100, 1000])
    parser.add_argument("--points", type=int, default=20000)
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    rows = []
    for photos in options.photos:
        for model in (True, False):
            with tempfile.TemporaryDirectory() as folder:
                start = time.perf_counter()
                made = capture(Path(folder), photos, options.points, model)
                size = sum(path.stat().st_size for path in (made / "images").iterdir())
                row = {"photos": photos, "points": options.points if model else 0}
                row |= {"megabytes": size / 1e6, "made_in_s": time.perf_counter() - start}
                rows.append(row | seconds_of(made, options.repeats))
    common.report("seconds to check a capture", json.loads(json.dumps({"captures": rows})), 0)


if __name__ == "__main__":
    main()
