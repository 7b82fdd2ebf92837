"""All scores of a fitted run against the reference set, and pictures for the report.

docs/reference-scene.md defines each number.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import ndimage

from climatenerf.core.samples import MIN_TAU
from climatenerf.core.srgb import to_display
from climatenerf.evaluation import baselines, geometry, weather_scores
from climatenerf.evaluation.baseline_rendering import (
    Constants,
    painted_snow,
    render_baseline,
    tune,
)
from climatenerf.evaluation.baselines import CleanView
from climatenerf.evaluation.consistency import Frame, warp_error
from climatenerf.evaluation.evaluated_run import (
    ENDLESS,
    EvaluatedRun,
    Picture,
    check_views,
    clean_view,
    depth_spread,
    display_8bit,
    prepare_weather,
    render_clean,
    render_world,
    transmittance_to,
    weather_world,
)
from climatenerf.evaluation.metrics import psnr, ssim
from climatenerf.evaluation.reference import Truth, WeatherTruth
from climatenerf.evaluation.relight_scores import relight_scores
from climatenerf.field.capabilities import CLASSES, NORMALS
from climatenerf.field.compositing import RENDER_STEP
from climatenerf.field.protocol import device_of, observed
from climatenerf.ops import compositing
from climatenerf.paths.camera_path import camera_path
from climatenerf.render.frame import see_frame
from climatenerf.render.heads import see_surface
from climatenerf.render.photo_rays import trace_photos
from climatenerf.render.volume import camera_rays
from climatenerf.weather.description import KeyframedWeather
from climatenerf.weather.flood.parameters import Flood
from climatenerf.weather.flood.surface import Water
from climatenerf.weather.light.captured import UnknownLight, open_sheet
from climatenerf.weather.light.file import light_of_photos_in
from climatenerf.weather.light.parameters import Sun
from climatenerf.weather.light.sun import sun_direction
from climatenerf.weather.smog.parameters import SMOG
from climatenerf.weather.weather import Weather

Progress = Callable[[str], None]
"""Called with the name of each step as it begins."""
CONSISTENCY_WEATHERS = {"smog": "smog-mid", "flood": "flood-waves", "snow": "snow-deep"}
PATH_FRAMES, STARTS, FAR = 400, (60, 180, 300), 8  # frames of the path, starts, longer interval
CONSISTENCY_DOWNSCALE = 2  # of the frames compared for consistency
START_HEIGHT = 0.3  # m above true ground; the fitted ground may lie a little higher


@dataclass
class Scores:
    """The result of an evaluation.

    Attributes:
        table: nested scores; docs/reference-scene.md lists the keys.
        pictures: for "clean" and each weather, rows of view name, rendered and true picture.
    """

    table: dict[str, Any]
    pictures: dict[str, list[tuple[str, Picture, Picture]]] = field(default_factory=dict)


def evaluate(run: EvaluatedRun, progress: Progress) -> Scores:
    """Compute all scores of a run.

    Args:
        run: the run and its truth.
        progress: called at the beginning of each step.

    Raises:
        UserError: the run lacks a test view, was fitted to it, or has it in another size.
    """
    check_views(run.scene, run.reference)
    truths = run.reference.truths
    progress("clean views")
    views = [clean_view(run, truth) for truth in truths]
    rendered = [display_8bit(view.linear) for view in views]
    true = [display_8bit(truth.clean) for truth in truths]
    scores = Scores({"clean": picture_scores(rendered, true)})
    scores.pictures["clean"] = _rows(truths, rendered, true)
    progress("geometry")
    scores.table["frame"] = frame_scores(run)
    scores.table["geometry"] = geometry_scores(run, views, scores.table["frame"]["scale"])
    progress("classes")
    scores.table["labels"] = label_scores(run)
    progress("mirrored cameras")
    scores.table["completeness"] = mirror_scores(run)
    scores.table |= {"weather": {}, "walls": {}, "baselines": {}}
    constants: dict[str, Constants] = {}
    for case in run.reference.weathers:
        progress(case.name)
        constants[case.name] = score_weather(run, case, views, scores)
    progress("light")
    scores.table["light"] = light_scores(run)
    scores.table["relight"] = relight_all(run)
    progress("consistency")
    scores.table["consistency"] = consistency(run, constants, progress)
    return scores


def picture_scores(rendered: list[Picture], true: list[Picture]) -> dict[str, float]:
    """Return the means over the views of PSNR, dB, and SSIM."""
    pairs = list(zip(rendered, true, strict=True))
    return {
        "psnr": float(np.mean([psnr(a, b) for a, b in pairs])),
        "ssim": float(np.mean([ssim(a, b) for a, b in pairs])),
    }


def geometry_scores(run: EvaluatedRun, views: list[CleanView], scale: float) -> dict[str, float]:
    """Score depth, ground, normals, floaters and sky of clean views.

    Args:
        run: the run and its truth.
        views: clean renders of the test views.
        scale: run metres per true metre, see `frame_scores`.
    """
    truths = run.reference.truths
    normals = [view.normal @ view.c2w[:3, :3] for view in views]
    absorbed, transmittance, spread = [], [], []
    for truth in truths:
        camera, c2w = run.camera(truth)
        shape = truth.depth.shape
        free = torch.from_numpy((scale * geometry.free_space(truth)).astype(np.float32).ravel())
        within = transmittance_to(run.field, camera, c2w, free.clamp_max(ENDLESS))
        absorbed.append((1 - within).view(shape).numpy())
        whole = transmittance_to(run.field, camera, c2w, torch.full_like(free, ENDLESS))
        transmittance.append(whole.view(shape).numpy())
        relative = depth_spread(run.field, camera, c2w).numpy()
        spread.append(relative[~truth.sky.ravel() & np.isfinite(relative)])
    return {
        "open_sky": open_sky(run),
        **geometry.depth_scores([view.depth for view in views], truths),
        **geometry.ground_scores([view.depth for view in views], truths),
        "depth_spread": float(np.concatenate(spread).mean()),
        **geometry.normal_scores(normals, truths),
        **geometry.emptiness_scores(absorbed, transmittance, truths),
    }


@torch.no_grad()
def open_sky(run: EvaluatedRun) -> float:
    """Return the mean transmittance straight up from open ground; NaN if no ground is open.

    Density above open ground would shelter it from snow. Rays begin `START_HEIGHT` above the true
    ground.
    """
    truth = run.reference.truths[0]
    ground = geometry.open_ground(run.reference.truths)
    if not len(ground):
        return float("nan")
    # From the true world into the run's by way of a camera that is known in both.
    _, c2w = run.camera(truth)
    local = (ground - truth.c2w[:3, 3]) @ truth.c2w[:3, :3]
    points = c2w[:3, 3] + frame_scores(run)["scale"] * local @ c2w[:3, :3].T
    rays_o = torch.from_numpy(points.astype(np.float32))
    rays_o[:, 2] += START_HEIGHT
    up = torch.zeros_like(rays_o)
    up[:, 2] = 1.0
    start = torch.zeros_like(rays_o[:, 0])
    end = torch.full_like(start, ENDLESS)
    samples = run.field.march(rays_o, up, start, end, RENDER_STEP, pruning_threshold=MIN_TAU)
    _, transmittance = compositing.render_weights(samples.sigma * samples.dt, samples.offsets)
    return float(transmittance.mean())


def label_scores(run: EvaluatedRun) -> dict[str, float]:
    """Score the field's classes in the test views; NaN if the field has no classes."""
    if CLASSES not in run.field.capabilities:
        return {"miou": float("nan")}
    labels = []
    for truth in run.reference.truths:
        _, label = see_surface(run.field, *camera_rays(*run.camera(truth), device_of(run.field)))
        labels.append(label.view(truth.depth.shape).numpy())
    return geometry.label_scores(labels, run.reference.truths)


def mirror_scores(run: EvaluatedRun) -> dict[str, float]:
    """Score the reflections in a perfect horizontal mirror: how complete the light field is.

    Pixels count where the mirror is visible in the true picture.

    Returns:
        `mirror_psnr`, dB; NaN without pictures of the mirror.
    """
    reference = run.reference
    if reference.mirror_level is None:
        return {"mirror_psnr": float("nan")}
    calm = Flood(level=reference.mirror_level, wind_speed=0.0)
    weather = KeyframedWeather(Weather(flood=calm), {})
    prepared = prepare_weather(run, weather, 0.0, [run.camera(t)[1] for t in reference.truths])
    world = prepared.world(0.0)
    (water,) = world.surfaces
    assert isinstance(water, Water)
    world = dataclasses.replace(world, surfaces=(dataclasses.replace(water, mirror_only=True),))
    level = reference.scene.ground_z + reference.mirror_level
    errors = []
    for truth in reference.truths:
        linear, _ = see_frame(world, *run.camera(truth))
        visible = weather_scores.water_visible(truth, level)
        rendered = to_display(linear.double().numpy())[visible]
        true = to_display(reference.mirrored(truth.name))[visible]
        errors.append(((rendered - true) ** 2).ravel())
    mse = float(np.concatenate(errors).mean()) if sum(map(len, errors)) else float("nan")
    return {"mirror_psnr": float(-10 * np.log10(max(mse, 1e-12)))}  # 1e-12: equal pictures, log 0


def light_scores(run: EvaluatedRun) -> dict[str, float]:
    """Score the light that is found in the photos.

    Returns:
        `sheet_error`: relative error of a white sheet on open level ground, the largest of three
        channels; `sun_deg`: angle between the found sun and the true one. NaN where there is none.
    """
    true, nothing = run.reference.light, float("nan")
    if true is None or NORMALS not in run.field.capabilities:
        return {"sheet_error": nothing, "sun_deg": nothing}
    light = light_of_photos_in(
        run.kept, run.scene, run.field, lambda: trace_photos(observed(run.field), run.scene)
    )
    if isinstance(light, UnknownLight):
        return {"sheet_error": nothing, "sun_deg": nothing}
    sheet = open_sheet(light, run.field)
    angle = nothing
    if true.sun is not None and light.sun is not None:
        given = sun_direction(Sun(*true.sun))
        angle = float(np.degrees(np.arccos(np.clip(light.sun @ given, -1, 1))))
    return {"sheet_error": float(np.abs(sheet / true.sheet - 1).max()), "sun_deg": angle}


def relight_all(run: EvaluatedRun) -> dict[str, Any]:
    """Render the test views under another sky and compare; empty without its truth."""
    other = run.reference.relight
    if other is None or NORMALS not in run.field.capabilities:
        return {}
    cameras = [run.camera(truth) for truth in other.truths]
    world = prepare_weather(run, other.weather, 0.0, [c2w for _, c2w in cameras]).world(0.0)
    pictures = [see_frame(world, *each)[0].double().numpy() for each in cameras]
    return {other.name: relight_scores(pictures, other.truths, run.reference.truths)}


def frame_scores(run: EvaluatedRun) -> dict[str, float]:
    """Compare the run's world frame with the true one by their cameras.

    Depths and levels are compared in the run's own metres, so errors of the frame are part of every
    score with a unit of length.

    Returns:
        `scale`, run metres per true metre; `up_deg`, the angle between the up directions;
        `datum_cm`, the height of the run's ground datum above the true one, from camera heights.
    """
    true_views = {Path(view.name).name: view for view in run.reference.scene.views}
    pairs = [
        (view, true_views[name])
        for view in run.scene.views
        if (name := Path(view.name).name) in true_views
    ]
    poses = np.stack([run.scene.c2w_world(view) for view, _ in pairs])
    true_poses = np.stack([run.reference.scene.c2w_world(view) for _, view in pairs])
    spread = [
        np.sqrt(((p[:, :3, 3] - p[:, :3, 3].mean(0)) ** 2).sum()) for p in (poses, true_poses)
    ]
    # The run's up in the true world by each camera; they agree unless poses were refined.
    up = np.einsum("nij,nj->ni", true_poses[:, :3, :3], poses[:, 2, :3]).mean(0)
    heights = [
        (p[:, 2, 3] - scene.ground_z).mean()
        for p, scene in ((poses, run.scene), (true_poses, run.reference.scene))
    ]
    return {
        "scale": float(spread[0] / spread[1]),
        "up_deg": float(np.degrees(np.arccos(np.clip(up[2] / np.linalg.norm(up), -1, 1)))),
        "datum_cm": float(100 * (heights[1] - heights[0])),
    }


def score_weather(
    run: EvaluatedRun, case: WeatherTruth, views: list[CleanView], scores: Scores
) -> Constants:
    """Render and score one weather in all test views, ours and the baselines'.

    Args:
        run: the run and its truth.
        case: the weather.
        views: clean renders of the test views.
        scores: filled in place.

    Returns:
        The tuned constants of the baselines.
    """
    truths = run.reference.truths
    cameras = [run.camera(truth) for truth in truths]
    world = weather_world(run, case)
    renders = render_world(run, world)
    rendered = [display_8bit(linear) for linear, _ in renders]
    layers = [each for _, each in renders]
    true = [case.picture(truth.name) for truth in truths]
    found: dict[str, float] = picture_scores(rendered, true)
    weather = case.weather.at(case.time)
    if weather.flood.level is not None:
        level = weather.flood.level
        found |= weather_scores.waterline_scores(
            [view.depth for view in views],
            [each["mask_water"] for each in layers],
            [c2w for _, c2w in cameras],
            run.scene.ground_z + level,
            truths,
            run.reference.scene.ground_z + level,
            1.0 / cameras[0][0].fx,
        )
        if weather.flood.wind_speed > 0:
            masks = [each["mask_water"] for each in layers]
            correlation = weather_scores.water_correlation(rendered, true, masks)
            found["water_correlation"] = correlation
    if weather.snow.depth is not None:
        snow = [case.layers(truth.name) for truth in truths]
        found |= weather_scores.snow_scores(layers, truths, snow, 1.0 / cameras[0][0].fx)
    found |= weather_scores.by_view(truths, rendered, true)
    if weather.snow.depth is not None:
        ours = [linear for linear, _ in renders]
        dry = [view.linear for view in views]
        scores.table["walls"][case.name] = weather_scores.wall_scores(ours, dry, true, truths)
        found |= weather_scores.ground_scores(ours, true, truths)
        bare = [each for each, _ in render_world(run, dataclasses.replace(world, matters=()))]
        painted = painted_snow(bare, [each["mask_snow"] for each in layers], true)
        found["psnr_painted"] = picture_scores(painted, true)["psnr"]
        of_paint = weather_scores.by_view(truths, painted, true)["psnr_no_vegetation"]
        found["psnr_painted_no_vegetation"] = of_paint
    if SMOG.present(weather.smog) and weather.smog.light == "paper":
        found |= weather_scores.transmittance_scores(
            [each["transmittance"] for each in layers],
            [case.layers(truth.name)["transmittance"] for truth in truths],
        )
    scores.table["weather"][case.name] = found
    scores.pictures[case.name] = _rows(truths, rendered, true)
    ground_z = run.scene.ground_z
    constants = tune(case, ground_z, views, true)
    for name in baselines.NAMES:
        pictures = [
            render_baseline(case, ground_z, view, constants, name, seed)
            for seed, view in enumerate(views)
        ]
        complete = [picture for picture in pictures if picture is not None]
        if len(complete) == len(pictures):
            scores.table["baselines"].setdefault(name, {})[case.name] = picture_scores(
                [(255 * picture + 0.5).astype(np.uint8) for picture in complete], true
            )
    return constants


def consistency(
    run: EvaluatedRun, constants: dict[str, Constants], progress: Progress
) -> dict[str, Any]:
    """Score the consistency of frames along the training path, clean and in weather.

    Args:
        run: the run and its truth.
        constants: of the baselines, by weather.
        progress: called at the beginning of each weather.

    Returns:
        Warp errors to the next frame and to the one `FAR` frames later, for "clean", each of
        `CONSISTENCY_WEATHERS` that was measured, and under "baselines" the same of each baseline.
    """
    camera = run.scene.cameras[run.scene.views[0].camera]
    size = (camera.width // CONSISTENCY_DOWNSCALE, camera.height // CONSISTENCY_DOWNSCALE)
    path = camera_path("training", run.scene, PATH_FRAMES, size)
    starts = [start for start in STARTS if start + FAR < len(path)]
    indices = sorted({index for s in starts for index in (s, s + 1, s + FAR)})
    views = {i: render_clean(run.field, path.cameras[i], path.c2w[i]) for i in indices}
    nothing = np.zeros(views[indices[0]].depth.shape, bool)

    def frame(index: int, picture: np.ndarray, depth: np.ndarray, excluded: np.ndarray) -> Frame:
        return Frame(picture, depth, excluded, path.c2w[index], path.cameras[index])

    clean = {i: frame(i, to_display(v.linear), v.depth, nothing) for i, v in views.items()}
    results: dict[str, Any] = {"clean": _warp_errors(clean, starts), "baselines": {}}
    cases = {case.name: case for case in run.reference.weathers}
    for short, name in CONSISTENCY_WEATHERS.items():
        if name not in cases:
            continue
        progress(f"consistency, {short}")
        case = cases[name]
        poses = [path.c2w[i] for i in indices]
        world = prepare_weather(run, case.weather, case.time, poses).world(case.time)
        frames = {}
        for i in indices:
            linear, layers = see_frame(world, path.cameras[i], path.c2w[i])
            picture = to_display(linear.double().numpy())
            water = ndimage.binary_dilation(layers["mask_water"] > 0.5)
            frames[i] = frame(i, picture, layers["depth"], water)
        results[short] = _warp_errors(frames, starts)
        for baseline in baselines.NAMES:
            if short == "flood" and baseline in ("flat-plane", "screen-reflection"):
                continue  # water is excluded, and outside it these equal the clean picture
            edited = {}
            for i in indices:
                picture = render_baseline(
                    case, run.scene.ground_z, views[i], constants[name], baseline, i
                )
                if picture is None:
                    break
                edited[i] = frame(i, picture, views[i].depth, frames[i].excluded)
            else:
                errors = _warp_errors(edited, starts)
                results["baselines"].setdefault(baseline, {})[short] = errors
    return results


def _warp_errors(frames: dict[int, Frame], starts: list[int]) -> dict[str, float]:
    near = [warp_error(frames[s], frames[s + 1]) for s in starts]
    far = [warp_error(frames[s], frames[s + FAR]) for s in starts]
    return {"next": _finite_mean(near), "far": _finite_mean(far)}


def _finite_mean(values: list[float]) -> float:
    finite = [value for value in values if np.isfinite(value)]
    return float(np.mean(finite)) if finite else float("nan")


def _rows(
    truths: tuple[Truth, ...], rendered: list[Picture], true: list[Picture]
) -> list[tuple[str, Picture, Picture]]:
    return [(t.name, a, b) for t, a, b in zip(truths, rendered, true, strict=True)]
