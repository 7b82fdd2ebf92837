"""Count how many exchanged photos and wrong focal lengths the check of recorded points finds.

python benchmarks/exchanged_photos.py CAPTURE
python benchmarks/exchanged_photos.py CAPTURE --exchanges 24 --factors .5 .8 .9 1.1 1.2 1.5

The photos of two views are exchanged, the first one among those whose pixels are read; or all focal
lengths are multiplied. The capture must record which photos show a point. `correlation` has the
right capture's values, over pairs of photos.
"""

import argparse
import dataclasses
import time
from pathlib import Path
from typing import Any

import common
import numpy as np

from climatenerf.scene import Scene, read_scene
from climatenerf.scene.checks import appearance


def main() -> None:
    """Count and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("capture", type=Path)
    parser.add_argument("--exchanges", type=int, default=24)
    parser.add_argument(
        "--factors", type=float, nargs="*", default=[0.5, 0.7, 0.8, 0.9, 1.1, 1.2, 1.5, 2.0]
    )
    options = parser.parse_args()
    scene = read_scene(options.capture)
    start = time.perf_counter()
    right = codes(scene)
    seconds = time.perf_counter() - start
    read = sorted({index for pair in appearance.shared_pairs(scene.views) for index in pair})
    random, found = np.random.default_rng(0), 0
    for _ in range(options.exchanges):
        first = int(random.choice(read))
        second = int(random.choice([i for i in range(len(scene.views)) if i != first]))
        found += "photo-exchanged" in codes(exchanged(scene, first, second))
    results = {
        "capture": options.capture.name,
        "findings_of_the_right_capture": right,
        "seconds": seconds,
        "exchanges": options.exchanges,
        "exchanges_found": found,
        "focal_factors": {
            f"{factor:g}": "focal-disagrees" in codes(with_focal(scene, factor))
            for factor in options.factors
        },
        "correlation": correlations(scene),
    }
    common.report("exchanged photos and wrong focal lengths that are found", results, 0)


def codes(scene: Scene) -> list[str]:
    """Return the codes of the findings."""
    return [finding.code for finding in appearance.appearance_findings(scene) or []]


def exchanged(scene: Scene, first: int, second: int) -> Scene:
    """Return the scene with the pictures of two views exchanged."""
    views = list(scene.views)
    a, b = views[first], views[second]
    views[first] = dataclasses.replace(a, path=b.path)
    views[second] = dataclasses.replace(b, path=a.path)
    return dataclasses.replace(scene, views=tuple(views))


def with_focal(scene: Scene, factor: float) -> Scene:
    """Return the scene with all focal lengths multiplied."""
    cameras = [
        dataclasses.replace(each, fx=factor * each.fx, fy=factor * each.fy)
        for each in scene.cameras
    ]
    return dataclasses.replace(scene, cameras=tuple(cameras))


def correlations(scene: Scene) -> dict[str, Any]:
    """Return the smallest, median and largest correlation of the pairs that are compared."""
    pairs = appearance.shared_pairs(scene.views)
    photos = {
        i: appearance._reduced(scene, scene.views[i]) for i in sorted({i for p in pairs for i in p})
    }
    values = [appearance._correlation(scene, photos, *pair) for pair in pairs]
    known = sorted(value for value in values if value is not None)
    return {
        "pairs": len(known),
        "min": known[0],
        "median": known[len(known) // 2],
        "max": known[-1],
    }


if __name__ == "__main__":
    main()
