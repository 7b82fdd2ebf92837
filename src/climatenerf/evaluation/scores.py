"""All scores of a fitted run against the reference set, and the pictures that show them.

See docs/reference-scene.md for what each number means.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from climatenerf.core.errors import UserError
from climatenerf.core.samples import MIN_TAU
from climatenerf.core.srgb import to_display
from climatenerf.evaluation import baselines, geometry, weather_scores
from climatenerf.evaluation.baselines import Dry
from climatenerf.evaluation.consistency import Frame, warp_error
from climatenerf.evaluation.metrics import psnr, ssim
from climatenerf.evaluation.painting import painted, tune
from climatenerf.evaluation.reference import Reference, Truth, WeatherTruth, world_rays
from climatenerf.field.hash_field import Field
from climatenerf.ops import compositing
from climatenerf.paths.camera_path import camera_path
from climatenerf.render.frame import see_frame
from climatenerf.render.heads import see_surface
from climatenerf.render.session import Stage, prepare
from climatenerf.render.volume import RENDER_STEP, camera_rays
from climatenerf.scene import Camera, Scene, View
from climatenerf.weather.description import KeyframedWeather
from climatenerf.weather.parameters import Flood, Weather
from climatenerf.weather.world import World

Picture = UInt8[np.ndarray, "h w 3"]
Tell = Callable[[str], None]
FOLLOWED = {"smog": "smog-mid", "flood": "flood-waves", "snow": "snow-deep"}
PATH_FRAMES, STARTS, FAR = 400, (60, 180, 300), 8  # of the path over which frames are compared
LIFTED = 0.3  # m
SMALL = 2  # frames are compared at this part of the photos' size


@dataclass
class Scores:
    """What was measured.

    Attributes:
        table: nested scores; the keys are told in docs/reference-scene.md.
        pictures: for "clean" and each weather the rows ours, truth of the views.
    """

    table: dict[str, Any]
    pictures: dict[str, list[tuple[str, Picture, Picture]]] = field(default_factory=dict)


@dataclass(frozen=True)
class Place:
    """What is evaluated: a fitted field, its scene, and the truth of it."""

    fitted: Field
    scene: Scene
    reference: Reference

    def view(self, truth: Truth) -> View | None:
        """The run's view of that name."""
        return find_view(self.scene, truth)

    def pose(self, truth: Truth) -> tuple[Camera, Float[np.ndarray, "4 4"]]:
        """Camera and pose, in the run's own world, of a view that is measured."""
        view = self.view(truth)
        assert view is not None
        return self.scene.cameras[view.camera], self.scene.c2w_world(view)


def find_view(scene: Scene, truth: Truth) -> View | None:
    """A scene's view of a truth's name; poses from elsewhere may call it `images/NAME`."""
    return {Path(view.name).name: view for view in scene.views}.get(truth.name)


def evaluate(place: Place, tell: Tell) -> Scores:
    """Measures a run.

    Args:
        place: of the run and its truth.
        tell: told what is being done.

    Raises:
        UserError: the run lacks a test view, was fitted to it, or has it in another size.
    """
    check_views(place.scene, place.reference)
    truths = place.reference.truths
    tell("clean views")
    dry = [dry_view(place, truth) for truth in truths]
    clean = [display_8bit(each.linear) for each in dry]
    real = [display_8bit(truth.clean) for truth in truths]
    scores = Scores({"clean": picture_scores(clean, real)})
    scores.pictures["clean"] = _rows(truths, clean, real)
    tell("geometry")
    scores.table["frame"] = frame_scores(place)
    scores.table["geometry"] = geometry_scores(place, dry, scores.table["frame"]["scale"])
    tell("classes")
    scores.table["labels"] = label_scores(place)
    tell("mirrored cameras")
    scores.table["completeness"] = mirror_scores(place)
    scores.table["weather"], scores.table["baselines"] = {}, {}
    tuned: dict[str, dict[str, Any]] = {}
    for kind in place.reference.weathers:
        tell(kind.name)
        one_weather(place, kind, dry, scores, tuned)
    tell("consistency")
    scores.table["consistency"] = consistency(place, tuned, tell)
    return scores


def check_views(scene: Scene, reference: Reference) -> None:
    """Refuses a run that cannot be measured honestly."""
    for truth in reference.truths:
        view = find_view(scene, truth)
        if view is None:
            raise UserError(
                f"the run does not know the test view {truth.name}; fit the whole reference set"
            )
        if view.split == "train":
            raise UserError(
                f"the run was fitted to the test view {truth.name}, so it cannot be measured by it;"
                " fit without --holdout"
            )
        camera = scene.cameras[view.camera]
        if (camera.height, camera.width) != truth.depth.shape:
            raise UserError(
                f"the run has {truth.name} at {camera.width}x{camera.height} pixels, the reference"
                f" set at {truth.depth.shape[1]}x{truth.depth.shape[0]}; fit its own pictures"
            )


def picture_scores(ours: list[Picture], real: list[Picture]) -> dict[str, float]:
    """Means over the views of PSNR, dB, and SSIM."""
    pairs = list(zip(ours, real, strict=True))
    return {
        "psnr": float(np.mean([psnr(a, b) for a, b in pairs])),
        "ssim": float(np.mean([ssim(a, b) for a, b in pairs])),
    }


def display_8bit(linear: Float[np.ndarray, "h w 3"]) -> Picture:
    """8-bit display values."""
    return (to_display(linear) * 255 + 0.5).astype(np.uint8)


def dry_view(place: Place, truth: Truth) -> Dry:
    """Our clean view of a test view's camera."""
    return dry_from(place, *place.pose(truth))


def dry_from(place: Place, camera: Camera, c2w: Float[np.ndarray, "4 4"]) -> Dry:
    """Our clean view from any camera."""
    world = World(place.fitted)
    linear, layers = see_frame(world, camera, c2w, normals=True)
    rays_d = world_rays(camera, c2w)
    return Dry(linear.double().numpy(), layers["depth"], layers["normal"], rays_d, c2w, camera)


def geometry_scores(place: Place, dry: list[Dry], scale: float) -> dict[str, float]:
    """Depth, normals, floaters and sky; `scale` is that of the run's metres, see `frame_scores`."""
    truths = place.reference.truths
    normals = [each.normal @ each.c2w[:3, :3] for each in dry]
    absorbed, skyward, spread = [], [], []
    for truth in truths:
        camera, c2w = place.pose(truth)
        free = torch.from_numpy((scale * geometry.free_space(truth)).astype(np.float32).ravel())
        lost = 1 - passing(place.fitted, camera, c2w, free.clamp_max(1e9))
        absorbed.append(lost.view(truth.depth.shape).numpy())
        whole = passing(place.fitted, camera, c2w, torch.full_like(free, 1e9))
        skyward.append(whole.view(truth.depth.shape).numpy())
        own = depth_spread(place.fitted, camera, c2w).numpy()
        spread.append(own[~truth.sky.ravel() & np.isfinite(own)])
    return {
        "open_sky": open_sky(place),
        **geometry.depth_scores([each.depth for each in dry], truths),
        "depth_spread": float(np.concatenate(spread).mean()),
        **geometry.normal_scores(normals, truths),
        **geometry.emptiness_scores(absorbed, skyward, truths),
    }


@torch.no_grad()
def passing(
    fitted: Field, camera: Camera, c2w: Float[np.ndarray, "4 4"], t_max: torch.Tensor
) -> torch.Tensor:
    """Transmittance of each pixel's ray up to a ray length, m."""
    rays_o, rays_d = camera_rays(camera, c2w)
    start = torch.full_like(t_max, fitted.near)
    samples = fitted.march(rays_o, rays_d, start, t_max.clamp_min(fitted.near), RENDER_STEP)
    _, left = compositing.render_weights(samples.sigma * samples.dt, samples.offsets)
    return left


@torch.no_grad()
def depth_spread(
    fitted: Field, camera: Camera, c2w: Float[np.ndarray, "4 4"]
) -> Float[torch.Tensor, "n"]:
    """Standard deviation of where a pixel's light comes from, over its mean; NaN: mostly sky.

    0 is a sharp surface; haze about it shows in no depth, but takes snow and smog.
    """
    rays_o, rays_d = camera_rays(camera, c2w)
    near = torch.full((rays_o.shape[0],), fitted.near)
    samples = fitted.march(rays_o, rays_d, near, torch.full_like(near, 1e9), RENDER_STEP)
    weights, left = compositing.render_weights(samples.sigma * samples.dt, samples.offsets)
    ray, opacity = samples.ray_index(), (1 - left).clamp_min(1e-6)  # nothing there: 0/0
    own = weights / opacity[ray]
    mean = torch.zeros_like(left).index_add(0, ray, own * samples.t)
    off = torch.zeros_like(left).index_add(0, ray, own * (samples.t - mean[ray]).square())
    return torch.where(opacity > 0.5, off.sqrt() / mean, torch.nan)


@torch.no_grad()
def open_sky(place: Place) -> float:
    """Mean transmittance straight up from open ground: what shelters from snow where nothing is.

    From `LIFTED` over the true ground, since ours may lie a little higher.
    """
    truth = place.reference.truths[0]
    found = geometry.open_ground(place.reference.truths)
    if not len(found):
        return float("nan")
    # Into the run's world by way of a camera that both know.
    _, c2w = place.pose(truth)
    local = (found - truth.c2w[:3, 3]) @ truth.c2w[:3, :3]
    ours = c2w[:3, 3] + frame_scores(place)["scale"] * local @ c2w[:3, :3].T
    rays_o = torch.from_numpy(ours.astype(np.float32))
    rays_o[:, 2] += LIFTED
    up = torch.tensor([0.0, 0.0, 1.0]).expand(len(found), 3).contiguous()
    start, end = torch.zeros(len(found)), torch.full((len(found),), 1e9)
    samples = place.fitted.march(rays_o, up, start, end, RENDER_STEP, pruning_threshold=MIN_TAU)
    _, left = compositing.render_weights(samples.sigma * samples.dt, samples.offsets)
    return float(left.mean())


def label_scores(place: Place) -> dict[str, float]:
    """Classes of the test views by the field, against the true ones; none if it learned none."""
    if not place.fitted.knows_classes:
        return {"miou": float("nan")}
    labels = []
    for truth in place.reference.truths:
        _, label = see_surface(place.fitted, *camera_rays(*place.pose(truth)))
        labels.append(label.view(truth.depth.shape).numpy())
    return geometry.label_scores(labels, place.reference.truths)


def mirror_scores(place: Place) -> dict[str, float]:
    """How complete the light field is: what a perfect mirror lying on the ground would show.

    Over the pixels in which the mirror is truly seen, ours or not.
    """
    reference = place.reference
    calm = Flood(level=reference.mirror_level, wind_speed=0.0)
    still = KeyframedWeather(Weather(flood=calm), {})
    stage = _stage(place, still, 0.0, [place.pose(t)[1] for t in reference.truths])
    world = stage.at(0.0)
    assert world.water is not None
    world = dataclasses.replace(world, water=dataclasses.replace(world.water, mirror_only=True))
    errors = []
    for truth in reference.truths:
        linear, _ = see_frame(world, *place.pose(truth))
        level = reference.scene.ground_z + reference.mirror_level
        there = weather_scores.plane_first(truth, level)
        ours = display_8bit(linear.double().numpy())[there] / 255.0
        errors.append(((ours - reference.mirrored(truth.name)[there] / 255.0) ** 2).ravel())
    mse = float(np.concatenate(errors).mean()) if sum(map(len, errors)) else float("nan")
    return {"mirror_psnr": float(-10 * np.log10(max(mse, 1e-12)))}  # equal ones: log 0


def frame_scores(place: Place) -> dict[str, float]:
    """How the run's world lies in the true one: its metres, its up and its ground datum.

    Depths and levels are compared in the run's own metres, so what is wrong with them is in all
    scores that have a unit; this says how much it is.
    """
    truth = {Path(view.name).name: view for view in place.reference.scene.views}
    both = [(v, truth[n]) for v in place.scene.views if (n := Path(v.name).name) in truth]
    ours = np.stack([place.scene.c2w_world(v) for v, _ in both])
    real = np.stack([place.reference.scene.c2w_world(v) for _, v in both])
    spread = [np.sqrt(((p[:, :3, 3] - p[:, :3, 3].mean(0)) ** 2).sum()) for p in (ours, real)]
    # Up of the run, in the true world, by each camera; they agree unless poses are refined.
    up = np.einsum("nij,nj->ni", real[:, :3, :3], ours[:, 2, :3]).mean(0)
    heights = [
        (p[:, 2, 3] - scene.ground_z).mean()
        for p, scene in ((ours, place.scene), (real, place.reference.scene))
    ]
    return {
        "scale": float(spread[0] / spread[1]),
        "up_deg": float(np.degrees(np.arccos(np.clip(up[2] / np.linalg.norm(up), -1, 1)))),
        "datum_cm": float(100 * (heights[1] - heights[0])),
    }


def weather_views(
    place: Place, kind: WeatherTruth
) -> list[tuple[Float[np.ndarray, "h w 3"], dict[str, np.ndarray]]]:
    """Our pictures (linear) and layers of the test views in one weather."""
    poses = [place.pose(truth) for truth in place.reference.truths]
    stage = _stage(place, kind.weather, kind.time, [c2w for _, c2w in poses])
    world = stage.at(kind.time)
    seen = [see_frame(world, camera, c2w) for camera, c2w in poses]
    return [(linear.double().numpy(), layers) for linear, layers in seen]


def one_weather(
    place: Place, kind: WeatherTruth, dry: list[Dry], scores: Scores, tuned: dict
) -> None:
    """Renders one weather in all views, scores it, and does the same with the baselines."""
    truths = place.reference.truths
    poses = [place.pose(truth) for truth in truths]
    seen = weather_views(place, kind)
    ours = [display_8bit(linear) for linear, _ in seen]
    layers = [found for _, found in seen]
    real = [kind.picture(truth.name) for truth in truths]
    own: dict[str, float] = picture_scores(ours, real)
    weather = kind.weather.at(kind.time)
    if weather.flood.level is not None:
        level, scene = weather.flood.level, place.reference.scene
        eyes = [c2w for _, c2w in poses]
        own |= weather_scores.waterline_scores(
            [each.depth for each in dry],
            [found["mask_water"] for found in layers],
            eyes,
            place.scene.ground_z + level,
            truths,
            scene.ground_z + level,
            1.0 / poses[0][0].fx,
        )
    if weather.snow.depth is not None:
        snow = [kind.layers(truth.name) for truth in truths]
        own |= weather_scores.snow_scores(layers, truths, snow, 1.0 / poses[0][0].fx)
    if weather.smog.present:
        passed = [found["transmittance"] for found in layers]
        own |= weather_scores.transmittance_scores(
            passed, [kind.layers(truth.name)["transmittance"] for truth in truths]
        )
    scores.table["weather"][kind.name] = own
    scores.pictures[kind.name] = _rows(truths, ours, real)
    tuned[kind.name] = tune(kind, place.scene.ground_z, dry, real)
    for name in baselines.NAMES:
        pictures = [
            painted(kind, place.scene.ground_z, each, tuned[kind.name], name, seed)
            for seed, each in enumerate(dry)
        ]
        if all(picture is not None for picture in pictures):
            kept = [picture for picture in pictures if picture is not None]
            each_score = picture_scores([(255 * p + 0.5).astype(np.uint8) for p in kept], real)
            scores.table["baselines"].setdefault(name, {})[kind.name] = each_score


def consistency(place: Place, tuned: dict[str, dict], tell: Tell) -> dict[str, Any]:
    """Errors of frames warped to t + 1 and t + 8, for the clean place, weathers and baselines."""
    camera = place.scene.cameras[place.scene.views[0].camera]
    size = (camera.width // SMALL, camera.height // SMALL)
    path = camera_path("training", place.scene, PATH_FRAMES, size)
    starts = [start for start in STARTS if start + FAR < len(path)]
    wanted = sorted({index for s in starts for index in (s, s + 1, s + FAR)})
    dry = {i: dry_from(place, path.cameras[i], path.c2w[i]) for i in wanted}
    plain = np.zeros(dry[wanted[0]].depth.shape, bool)

    def frame(index: int, picture: np.ndarray, depth: np.ndarray, excluded: np.ndarray) -> Frame:
        return Frame(picture, depth, excluded, path.c2w[index], path.cameras[index])

    clean = {i: frame(i, to_display(each.linear), each.depth, plain) for i, each in dry.items()}
    out: dict[str, Any] = {"clean": _pairs(clean, starts), "baselines": {}}
    kinds = {kind.name: kind for kind in place.reference.weathers}
    for short, name in FOLLOWED.items():
        if name not in kinds:
            continue
        tell(f"consistency, {short}")
        kind = kinds[name]
        stage = _stage(place, kind.weather, kind.time, [path.c2w[i] for i in wanted])
        world, frames = stage.at(kind.time), {}
        for i in wanted:
            linear, layers = see_frame(world, path.cameras[i], path.c2w[i])
            picture = to_display(linear.double().numpy())
            frames[i] = frame(i, picture, layers["depth"], grown(layers["mask_water"] > 0.5))
        out[short] = _pairs(frames, starts)
        for baseline in baselines.NAMES:
            if short == "flood" and baseline in ("flat-plane", "screen-reflection"):
                continue  # water is left out, and beside it they are the clean picture
            painted_frames = {}
            for i in wanted:
                picture = painted(kind, place.scene.ground_z, dry[i], tuned[name], baseline, i)
                if picture is None:
                    break
                painted_frames[i] = frame(i, picture, dry[i].depth, frames[i].excluded)
            else:
                out["baselines"].setdefault(baseline, {})[short] = _pairs(painted_frames, starts)
    return out


def grown(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """A mask and the pixels beside it."""
    out = mask.copy()
    out[1:] |= mask[:-1]
    out[:-1] |= mask[1:]
    out[:, 1:] |= mask[:, :-1]
    out[:, :-1] |= mask[:, 1:]
    return out


def _pairs(frames: dict[int, Frame], starts: list[int]) -> dict[str, float]:
    near = [warp_error(frames[s], frames[s + 1]) for s in starts]
    far = [warp_error(frames[s], frames[s + FAR]) for s in starts]
    return {"next": _mean(near), "far": _mean(far)}


def _mean(values: list[float]) -> float:
    known = [value for value in values if np.isfinite(value)]
    return float(np.mean(known)) if known else float("nan")


def _stage(place: Place, weather: KeyframedWeather, time: float, poses: list[np.ndarray]) -> Stage:
    places = np.stack([pose[:3, 3] for pose in poses])
    moment = np.array([time])
    return prepare(place.fitted, place.scene, weather, places, moment, lambda what, share: None)


def _rows(
    truths: tuple[Truth, ...], ours: list[Picture], real: list[Picture]
) -> list[tuple[str, Picture, Picture]]:
    return [(t.name, a, b) for t, a, b in zip(truths, ours, real, strict=True)]
