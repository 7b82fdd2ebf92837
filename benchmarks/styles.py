"""Score seasons on a run: what they change, what they keep, and what a frame costs.

python benchmarks/styles.py RUN
python benchmarks/styles.py RUN --size 480x270 --pairs 4

Vegetation: mean turn of hue (degrees), and chroma (over lightness) and luminance over those of
the clean frame, of pixels labelled so and green. Kept: mean change of roads and buildings, 8-bit
values.
Halo: mean change of the sky within 5 pixels of vegetation, and of the sky farther than 15 pixels,
8-bit values. Edges: structural similarity and gain of the magnitude of edges. Warp: error between
neighbouring frames over the clean one's. Frames are timed in turns, clean and styled.
"""

import argparse
import time
from pathlib import Path

import common
import numpy as np
import torch
from scipy.ndimage import distance_transform_edt

import climatenerf
from climatenerf.cli.render import parse_size
from climatenerf.core.classes import BUILDING, ROAD, SKY, VEGETATION
from climatenerf.core.srgb import LUMA, to_linear
from climatenerf.evaluation.consistency import Frame, warp_error
from climatenerf.evaluation.edit_scores import edge_ssim
from climatenerf.ops.recolouring import CONES, OKLAB, green
from climatenerf.paths.camera_path import camera_path
from climatenerf.render.session import RenderSession
from climatenerf.weather.season.palettes import SEASONS
from climatenerf.weather.season.parameters import Season
from climatenerf.weather.weather import Weather

GREEN = 0.5  # from which on a pixel counts as green leaves
FRAMES = 48  # of the path whose neighbours are compared
REPEATS = 5


def oklab(linear):
    """Return lightness, a and b of linear colours."""
    return np.cbrt(linear.clip(0) @ np.array(CONES).T) @ np.array(OKLAB).T


def vegetation(clean, styled):
    """Return turn of hue, and chroma and luminance over those of the clean colours."""
    before, after = oklab(clean), oklab(styled)
    hues = [np.arctan2(lab[:, 2], lab[:, 1]) for lab in (before, after)]
    chroma = [np.hypot(lab[:, 1], lab[:, 2]) / lab[:, 0].clip(1e-6) for lab in (before, after)]
    turn = np.angle(np.exp(1j * (hues[1] - hues[0])).mean(), deg=True)
    return {
        "hue_turn_deg": float(turn),
        "hue_deg": float(np.angle(np.exp(1j * hues[1]).mean(), deg=True)),
        "chroma_ratio": float(chroma[1].mean() / chroma[0].mean()),
        "luminance_ratio": float(
            (styled @ np.array(LUMA)).mean() / (clean @ np.array(LUMA)).mean()
        ),
    }


def gain(styled, clean):
    """Return the mean step between neighbouring pixels over that of the clean picture."""
    steps = [np.abs(np.diff(p @ np.array(LUMA), axis=1)).mean() for p in (styled, clean)]
    return float(steps[0] / steps[1])


def halo(styled, clean, label):
    """Return the mean change of the sky near vegetation, and far from it, 8-bit values."""
    near, far = [], []
    for a, b, classes in zip(styled, clean, label, strict=True):
        away = distance_transform_edt(classes != VEGETATION)
        change, sky = 255 * np.abs(a - b).mean(-1), classes == SKY
        near.append(change[sky & (away <= 5)])
        far.append(change[sky & (away > 15)])
    return {"near": float(np.concatenate(near).mean()), "far": float(np.concatenate(far).mean())}


def score(folder: Path, size: str, pairs: int) -> dict[str, object]:
    """Render neighbouring frames clean and in each season, and score them."""
    run = climatenerf.load_run(folder)
    field = run.completed()
    path = camera_path("training", run.scene, FRAMES, parse_size(size))
    firsts = np.linspace(0, FRAMES - 2, pairs).round().astype(int)
    shown = [int(i) for first in firsts for i in (first, first + 1)]
    sessions = {
        name: RenderSession(field, run.scene, Weather(season=Season(kind=name)))
        for name in ("captured", *SEASONS)
    }

    def render(name, index):
        return sessions[name].frame(path.cameras[index], path.c2w[index], layers=("label",))

    frames = {name: [render(name, index) for index in shown] for name in sessions}

    def warp(name):
        found = [
            Frame(
                f.picture / 255,
                f.layers["depth"],
                f.layers["depth"] < 0,
                path.c2w[i],
                path.cameras[i],
            )
            for f, i in zip(frames[name], shown, strict=True)
        ]
        return np.nanmean([warp_error(a, b) for a, b in zip(found[::2], found[1::2], strict=True)])

    seconds: dict[str, list[float]] = {name: [] for name in sessions}
    for _ in range(REPEATS):
        for name in sessions:
            start = time.perf_counter()
            sessions[name].frame(path.cameras[shown[0]], path.c2w[shown[0]])
            seconds[name].append(time.perf_counter() - start)

    clean = np.stack([f.picture for f in frames["captured"]]) / 255
    label = np.stack([f.layers["label"] for f in frames["captured"]])
    linear = to_linear(clean)
    leaf = green(torch.from_numpy(linear.reshape(-1, 3))).numpy().reshape(label.shape) > GREEN
    leaf &= label == VEGETATION
    kept = (label == ROAD) | (label == BUILDING)
    rows = {}
    for name in SEASONS:
        styled = np.stack([f.picture for f in frames[name]]) / 255
        rows[name] = {
            "vegetation": vegetation(linear[leaf], to_linear(styled)[leaf]),
            "kept_change_255": float(255 * np.abs(styled - clean)[kept].mean()),
            "halo_255": halo(styled, clean, label),
            "edge_ssim": float(
                np.mean([edge_ssim(a, b) for a, b in zip(styled, clean, strict=True)])
            ),
            "edge_gain": float(np.mean([gain(a, b) for a, b in zip(styled, clean, strict=True)])),
            "warp_ratio": float(warp(name) / warp("captured")),
            "frame_ratio": float(np.median(seconds[name]) / np.median(seconds["captured"])),
            "seconds": common.spread(seconds[name]),
        }
    return {
        "run": folder.name,
        "size": size,
        "green_pixels": int(leaf.sum()),
        "clean_seconds": common.spread(seconds["captured"]),
        "seasons": rows,
    }


def main() -> None:
    """Score and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("--size", default="320x180")
    parser.add_argument("--pairs", type=int, default=3)
    options = parser.parse_args()
    common.report("seasons", score(options.run, options.size, options.pairs))


if __name__ == "__main__":
    main()
