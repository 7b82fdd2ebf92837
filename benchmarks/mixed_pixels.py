"""How pure the reference street's pixels are: what a perfect field would score.

python benchmarks/mixed_pixels.py --rays 6

The truth of a pixel is that of the ray through its middle; its photo is the mean over its area.
Pixels of leaves against the sky are both. With `rays` times `rays` rays a pixel this tells which
share of the true sky pixels is sky over 99 % of its area, which share is so of those with sky all
around, and how much of the area lies before the surface of the middle. A field that shows the
photos' areas rightly can score no better than that. Needs `pip install ".[street]"`.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import common
import numpy as np
from jaxtyping import Float

from climatenerf.evaluation.geometry import emptiness_scores, free_space
from climatenerf.evaluation.reference import read_reference

ROOT = Path(__file__).resolve().parents[1]


def depths(scene, pose: Float[np.ndarray, "4 4"], size: tuple[int, int], rays: int):
    """Ray lengths at random places of each pixel's area, [h, w, rays²]; +inf in the sky."""
    import mitsuba as mi

    from street.render import render_view

    width, height = size
    asked = mi.load_dict({"type": "aov", "aovs": "t:depth"})
    t = render_view(scene, pose, width * rays, height * rays, 1, 0, asked)[..., -1]
    t = np.where(t > 0, t, np.inf).reshape(height, rays, width, rays)
    return t.transpose(0, 2, 1, 3).reshape(height, width, rays * rays)


def main() -> None:
    """Traces the test views and prints the scores of a perfect field."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rays", type=int, default=6)
    rays = parser.parse_args().rays
    sys.path.insert(0, str(ROOT))
    from street.layout import build_scene, measuring_poses
    from street.render import load

    truths = read_reference(ROOT / "reference" / "street").truths
    with tempfile.TemporaryDirectory() as scratch:
        scene = load(build_scene(), Path(scratch), threads=2)
    poses = dict(measuring_poses())
    absorbed, skyward = [], []
    for truth in truths:
        t = depths(scene, poses[truth.name], truth.depth.shape[::-1], rays)
        absorbed.append((t < free_space(truth)[..., None]).mean(-1))
        skyward.append(np.isinf(t).mean(-1))
    common.report("how pure pixels are", {"perfect": emptiness_scores(absorbed, skyward, truths)})


if __name__ == "__main__":
    main()
