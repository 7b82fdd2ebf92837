"""What weather on the reference street would score if parts of a picture were the truth.

python benchmarks/ceilings.py
python benchmarks/ceilings.py --run RUN
python benchmarks/ceilings.py --reference FOLDER

Snow, from the truth alone: each row says what is known. `snow` has the true picture where snow lies
and the true dry one elsewhere; `snow and gains` multiplies the dry one by the best gain of each
class and channel. In the rows of vegetation all else is the truth, and vegetation is the dry
picture, the best mixture of it with white, or the truth blurred by some pixels. `no_vegetation`
leaves out vegetation's pixels. With a run `ours` is its picture, and in `ours, edges true` the
truth stands within some pixels of edges: of classes, of depth and of what is snowed on. In `ours,
true where the fit errs` it stands where the fit's clean depth is wrong, and within some pixels of
that. Floods have it with the dry part or the water from the truth too. All in dB of display
values, the mean of all views.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import common
import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from climatenerf.api import load_run
from climatenerf.core.classes import MERGED, VEGETATION
from climatenerf.core.srgb import to_linear
from climatenerf.evaluation.evaluated_run import EvaluatedRun, display_8bit, prepare_weather
from climatenerf.evaluation.reference import Reference, Truth, WeatherTruth, read_reference
from climatenerf.render.frame import see_frame
from climatenerf.weather.world import World

REFERENCE = Path(__file__).resolve().parents[1] / "reference" / "street"
BLURS = (2.0, 4.0)  # px
EDGES = (1, 2)  # px from an edge
DEPTH_ERROR = 0.03, 0.05  # of the depth and m, whichever is more
MIN_SNOW = 1e-3  # m of thickness
Picture = Float[np.ndarray, "h w 3"]


def main() -> None:
    """Compute and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--reference", type=Path, default=REFERENCE)
    parser.add_argument("--run", type=Path, help="a fit of the reference, for the floods")
    options = parser.parse_args()
    reference = read_reference(options.reference)
    found: dict[str, object] = {}
    for case in reference.weathers:
        if case.name.startswith("snow"):
            found[case.name] = snow_ceilings(reference, case, options.run)
        elif case.name.startswith("flood") and options.run is not None:
            found[case.name] = flood_ceilings(reference, case, options.run)
    common.report("ceilings of the reference street", found)


def snow_ceilings(
    reference: Reference, case: WeatherTruth, folder: Path | None
) -> dict[str, dict[str, float]]:
    """Scores of pictures made of the truth and of what is left unknown."""
    true = [to_linear(case.picture(view.name) / 255.0) for view in reference.truths]
    dry = [np.clip(view.clean, 0, 1).astype(float) for view in reference.truths]
    leaves = [MERGED[view.label] == VEGETATION for view in reference.truths]
    snowed = [case.layers(view.name)["thickness"] > MIN_SNOW for view in reference.truths]
    gained = gains(reference.truths, true, dry, snowed)
    white = mixture(true, dry, leaves)

    def scores(part: Callable[[int], Picture], unknown: list[Bool[np.ndarray, "h w"]]):
        made = [np.where(m[..., None], part(k), true[k]) for k, m in enumerate(unknown)]
        return {"psnr": psnr(made, true), "no_vegetation": psnr(made, true, leaves)}

    everywhere, bare = [np.ones_like(m) for m in leaves], [~m for m in snowed]
    rows = {
        "dry": scores(lambda k: dry[k], everywhere),
        "snow": scores(lambda k: dry[k], bare),
        "snow and gains": scores(lambda k: gained[k], bare),
        "vegetation dry": scores(lambda k: dry[k], leaves),
        "vegetation mixed with white": scores(lambda k: white[k], leaves),
    }
    if folder is not None:
        ours, _ = rendered(reference, case, folder)
        rows["ours"] = scores(lambda k: ours[k], everywhere)
        errs = wrong_depth(reference, folder)
        for reach in (0, *EDGES):
            wrong = [
                ndimage.binary_dilation(each, iterations=reach) if reach else each for each in errs
            ]
            right = [~each for each in wrong]
            rows[f"ours, true where the fit errs and within {reach} px"] = scores(
                lambda k: ours[k], right
            ) | {"pixels": float(np.mean(wrong))}
        for reach in EDGES:
            edges = [near_edges(view, case, reach) for view in reference.truths]
            inner = [~each for each in edges]
            rows[f"ours, edges true within {reach} px"] = scores(lambda k: ours[k], inner) | {
                "pixels": float(np.mean(edges))
            }
    for blur in BLURS:
        soft = [ndimage.gaussian_filter(each, (blur, blur, 0)) for each in true]
        rows[f"vegetation blurred by {blur:g} px"] = scores(lambda k, s=soft: s[k], leaves)
    return rows


def near_edges(view: Truth, case: WeatherTruth, reach: int) -> Bool[np.ndarray, "h w"]:
    """Pixels within `reach` of an edge between classes, depths or bare and snowed pixels."""
    layers = case.layers(view.name)
    depth = np.where(np.isfinite(layers["depth"]), layers["depth"], 1e3)
    edge = ndimage.maximum_filter(depth, 3) > 1.1 * ndimage.minimum_filter(depth, 3) + 0.1
    for kind in (MERGED[view.label], (layers["thickness"] > MIN_SNOW).astype(np.uint8)):
        edge |= ndimage.maximum_filter(kind, 3) != ndimage.minimum_filter(kind, 3)
    return ndimage.binary_dilation(edge, iterations=reach)


def wrong_depth(reference: Reference, folder: Path) -> list[Bool[np.ndarray, "h w"]]:
    """Pixels of the test views in which a run's clean depth is wrong."""
    run = evaluated(reference, folder)
    found = []
    for view in reference.truths:
        _, layers = see_frame(World(run.completed or run.field), *run.camera(view))
        known = np.isfinite(view.depth)
        # Infinite depths are sky, which is right where both have it.
        error = np.abs(np.where(known, layers["depth"], 0) - np.where(known, view.depth, 0))
        wrong = error > np.maximum(DEPTH_ERROR[0] * np.where(known, view.depth, 1), DEPTH_ERROR[1])
        found.append(np.where(known, wrong, np.isfinite(layers["depth"])))
    return found


def evaluated(reference: Reference, folder: Path) -> EvaluatedRun:
    """A run with its completed ground."""
    run = load_run(folder)
    return EvaluatedRun(run.field, run.scene, reference, run.completed())


def gains(
    views: tuple[Truth, ...],
    true: list[Picture],
    dry: list[Picture],
    snowed: list[Bool[np.ndarray, "h w"]],
) -> list[Picture]:
    """The dry pictures, times the gain of each class and channel that fits bare pixels best."""
    labels = [MERGED[view.label] for view in views]
    made = [each.copy() for each in dry]
    for label in np.unique(np.concatenate([each.ravel() for each in labels])):
        masks = [(a == label) & ~b for a, b in zip(labels, snowed, strict=True)]
        x = np.concatenate([each[m] for each, m in zip(dry, masks, strict=True)])
        y = np.concatenate([each[m] for each, m in zip(true, masks, strict=True)])
        gain = (x * y).sum(0) / np.maximum((x * x).sum(0), 1e-12)  # 1e-12: a class that is black
        for each, before, mask in zip(made, dry, masks, strict=True):
            each[mask] = before[mask] * gain
    return made


def mixture(
    true: list[Picture], dry: list[Picture], leaves: list[Bool[np.ndarray, "h w"]]
) -> list[Picture]:
    """Vegetation as a factor times the dry picture plus one radiance, by least squares."""
    x = np.concatenate([each[m] for each, m in zip(dry, leaves, strict=True)])
    y = np.concatenate([each[m] for each, m in zip(true, leaves, strict=True)])
    made = [np.empty_like(each) for each in dry]
    for channel in range(3):
        design = np.stack([x[:, channel], np.ones(len(x))], axis=-1)
        factor, added = np.linalg.lstsq(design, y[:, channel], rcond=None)[0]
        for each, before in zip(made, dry, strict=True):
            each[..., channel] = factor * before[..., channel] + added
    return made


def flood_ceilings(reference: Reference, case: WeatherTruth, folder: Path) -> dict[str, float]:
    """Scores of a run's flood, and with its dry part or its water from the truth."""
    ours, layers = rendered(reference, case, folder)
    water = [np.asarray(each["mask_water"]) > 0.5 for each in layers]
    true = [to_linear(case.picture(view.name) / 255.0) for view in reference.truths]
    mixed = {
        "ours": ours,
        "dry part true": [
            np.where(m[..., None], a, b) for m, a, b in zip(water, ours, true, strict=True)
        ],
        "water true": [
            np.where(m[..., None], b, a) for m, a, b in zip(water, ours, true, strict=True)
        ],
    }
    return {name: psnr(pictures, true) for name, pictures in mixed.items()}


def rendered(
    reference: Reference, case: WeatherTruth, folder: Path
) -> tuple[list[Picture], list[dict[str, np.ndarray]]]:
    """A run's pictures of the test views in a weather, linear, and their layers."""
    run = evaluated(reference, folder)
    cameras = [run.camera(truth) for truth in reference.truths]
    session = prepare_weather(run, case.weather, case.time, [c2w for _, c2w in cameras])
    frames = [see_frame(session.world(case.time), *camera) for camera in cameras]
    pictures = [np.clip(linear.double().numpy(), 0, 1) for linear, _ in frames]
    return pictures, [layers for _, layers in frames]


def psnr(
    pictures: list[Picture],
    true: list[Picture],
    without: list[Bool[np.ndarray, "h w"]] | None = None,
) -> float:
    """Mean over views of the PSNR of display values, without some pixels."""
    scores = []
    for k, (a, b) in enumerate(zip(pictures, true, strict=True)):
        error = (display(a) - display(b)) ** 2
        error = error if without is None else error[~without[k]]
        scores.append(-10 * np.log10(max(float(error.mean()), 1e-12)))  # 1e-12: equal pictures
    return float(np.mean(scores))


def display(linear: Picture) -> Picture:
    """Display values in [0, 1]."""
    return display_8bit(linear).astype(float) / 255


if __name__ == "__main__":
    main()
