"""From a scene to a run folder: reading photos, fitting, previews, checkpoints, measuring."""

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image

import climatenerf
from climatenerf.core.cameras import Camera
from climatenerf.core.device import to_device, to_numpy
from climatenerf.core.errors import UserError
from climatenerf.core.storage import (
    atomic_path,
    make_folder,
    read_safetensors,
    write_json,
    write_safetensors,
)
from climatenerf.evaluation.metrics import psnr, psnr_cc, ssim
from climatenerf.field.checkpoint import load_field, save_field
from climatenerf.field.hash_field import Field
from climatenerf.field.normalisation import find_extent
from climatenerf.render.appearance import nearby_appearance
from climatenerf.render.volume import render_view
from climatenerf.scene.images import (
    downscaled_camera,
    load_image,
    load_labels,
    load_mask,
    load_relative_depth,
)
from climatenerf.scene.scene import Scene, load_scene, save_scene
from climatenerf.training.dataset import TrainingPixels
from climatenerf.training.evidence.multiview_stereo import plane_sweep_depth
from climatenerf.training.evidence.sparse_depth import unmasked_sparse_depth
from climatenerf.training.folder import (
    OPTIMISER,
    SCHEMA_VERSION,
    check_config,
    check_folder,
    check_resumable,
)
from climatenerf.training.settings import FitSettings
from climatenerf.training.trainer import REFINE_AT, Fitting, Report

CHECKPOINT_EVERY = 60.0  # seconds
PREVIEW_EVERY = 20.0
PREVIEW_WIDTH = 240
SMALLEST = 16  # pixels; the structural similarity looks at windows of 11
ONE_SPOT = 1e-3  # m within which cameras are in one place,
ROUNDING = 1e-6  # or units of the poses as given
MIN_SHARE = 1e-3  # of the pixels that masks must leave


def load_pixels(scene: Scene, downscale: int) -> TrainingPixels:
    """All training pixels of a scene, reduced `downscale` times.

    Raises:
        UserError: pictures too small to measure, or masks that leave nothing to learn from.
    """
    views = scene.of_split("train")
    cameras = [downscaled_camera(camera, downscale) for camera in scene.cameras]
    least = min(min(camera.width, camera.height) for camera in cameras)
    if least < SMALLEST:
        raise UserError(
            f"the pictures are only {least} pixels wide or high at --downscale {downscale};"
            f" at least {SMALLEST} are needed"
        )
    pixels = TrainingPixels(
        cameras,
        [view.camera for view in views],
        np.stack([scene.c2w_world(view) for view in views]),
        (load_image(view, scene, downscale) for view in views),
        (load_labels(view, scene, downscale) for view in views),
        (load_mask(view, scene, downscale) for view in views),
        (load_relative_depth(view, scene, downscale) for view in views),
    )
    if pixels.share < MIN_SHARE:
        raise UserError(
            f"the masks of {scene.root} leave {pixels.share:.4%} of the pixels to learn from; what"
            " is to be ignored is black in them, the rest white"
        )
    return pixels


def fit_scene(
    scene: Scene,
    run: Path,
    settings: FitSettings,
    downscale: int,
    resume: bool,
    report: Callable[[Report], None],
    evaluated: Callable[[int, int], None],
) -> dict:
    """Fits a field to a scene and leaves a run folder; returns the metrics.

    Ctrl-C ends the fit early; what was learned is kept and measured.

    Args:
        scene: the capture.
        run: the run folder, made if absent.
        settings: how to fit.
        downscale: photos are reduced this many times.
        resume: go on from the folder's checkpoint.
        report: told after each step.
        evaluated: told (views done, views) while measuring.

    Raises:
        UserError: the folder already holds a run (without resume) or none (with it).
    """
    check_folder(scene, run, resume)
    if resume:
        check_resumable(run, settings)
        scene = in_frame_of(scene, run, downscale)
    for view in scene.of_split("heldout"):
        # Damaged ones are to be known now, not after the fit.
        load_image(view, scene, downscale)
        load_mask(view, scene, downscale)
    fitting = begin(scene, settings, downscale)
    if resume:
        restore(fitting, run)
    make_folder(run / "previews")
    write_json(run / "config.json", _config(settings, downscale, fitting.field))
    save_scene(with_corrections(scene, fitting), run)

    last = {"checkpoint": time.monotonic(), "preview": time.monotonic()}

    def after_step(state: Report) -> None:
        report(state)
        now = time.monotonic()
        if now - last["preview"] > PREVIEW_EVERY:
            save_preview(fitting.field, with_corrections(scene, fitting), run, state.step)
            last["preview"] = time.monotonic()
        if now - last["checkpoint"] > CHECKPOINT_EVERY:
            checkpoint(fitting, run)
            save_scene(with_corrections(scene, fitting), run)
            last["checkpoint"] = time.monotonic()

    interrupted = False
    try:
        fitting.run(after_step)
    except KeyboardInterrupt:
        interrupted = True
    fitting.field.occupancy.update(fitting.field.grid_density, 1.0, 0.8, fitting.generator)
    checkpoint(fitting, run)
    scene = with_corrections(scene, fitting)
    save_scene(scene, run)
    save_preview(fitting.field, scene, run, fitting.steps)
    metrics = {
        "seconds": round(fitting.seconds, 3),
        "steps": fitting.steps,
        "samples": fitting.samples,
        "interrupted": interrupted,
        "downscale": downscale,
        "train_views": len(scene.of_split("train")),
        "masked_fraction": masked_fraction(fitting),
    }
    write_json(run / "metrics.json", metrics)
    metrics |= evaluate(fitting.field, scene, downscale, evaluated)
    write_json(run / "metrics.json", metrics)
    return metrics


def begin(scene: Scene, settings: FitSettings, downscale: int) -> Fitting:
    """A fit before its first step: photos are read, and matched with their neighbours.

    Raises:
        UserError: a photo cannot be read, or all are from one spot.
    """
    poses = np.stack([scene.c2w_world(view) for view in scene.of_split("train")])
    check_moves(poses, scene.scale)
    pixels = load_pixels(scene, downscale)
    extent = find_extent(poses, scene.points_world())
    points = unmasked_sparse_depth(scene, pixels)
    matched = None
    if settings.multiview_stereo and settings.losses.sparse_depth:
        known = pixels if settings.sky_labels else pixels.without_sky()
        matched = plane_sweep_depth(known, points, (extent.near, extent.unit), settings.seed)
    return Fitting(pixels, len(poses), extent, settings, points, matched)


def check_moves(c2w: Float[np.ndarray, "v 4 4"], scale: float) -> None:
    """Refuses cameras that all stand in one place: nothing can be told of depth there.

    Metres may be guessed from how far the cameras are apart, so the poses' own unit counts as well.

    Args:
        c2w: world, m.
        scale: metres per unit of the poses as they were given.
    """
    eyes = c2w[:, :3, 3]
    spread = np.linalg.norm(eyes - eyes.mean(0), axis=-1).max()
    if spread < max(ONE_SPOT, ROUNDING * scale):
        raise UserError(
            f"all {len(eyes)} photos were taken from one spot (within {1000 * spread:.2g} mm), and"
            " tell nothing of depth; walk while you take them"
        )


def masked_fraction(fitting: Fitting) -> float | None:
    """Share of the fitted pixels that is taken for passers-by; None if none was sought."""
    if not fitting.settings.losses.transient:
        return None
    return float(fitting.masks.shares().mean())


def evaluate(
    field: Field,
    scene: Scene,
    downscale: int,
    evaluated: Callable[[int, int], None],
    nearby: bool = True,
) -> dict:
    """PSNR, SSIM and colour-corrected PSNR of the held-out views.

    Each is shown in the appearance of the fitted photos taken from about there, or all in the mean;
    nothing is learned from the held-out photos themselves. Of the pixels that a view's mask leaves;
    in the windows of SSIM the photo stands for the others. A view that is masked as a whole is left
    out.
    """
    rows = {}
    views = scene.of_split("heldout")
    photos = np.stack([scene.c2w_world(view) for view in scene.of_split("train")])
    for index, view in enumerate(views):
        truth = load_image(view, scene, downscale).astype(np.float32) / 255
        usable = load_mask(view, scene, downscale)
        usable = np.ones(truth.shape[:2], bool) if usable is None else usable
        if usable.any():
            camera = downscaled_camera(scene.cameras[view.camera], downscale)
            c2w = scene.c2w_world(view)
            appearance = nearby_appearance(field, photos, c2w) if nearby else None
            picture = render_view(field, camera, c2w, appearance)
            shown, wanted = picture[usable][:, None], truth[usable][:, None]
            rows[view.name] = {
                "psnr": psnr(shown, wanted),
                "ssim": ssim(np.where(usable[..., None], picture, truth), truth),
                "psnr_cc": psnr_cc(shown, wanted),
            }
        evaluated(index + 1, len(views))
    if not rows:
        return {"psnr": None, "ssim": None, "psnr_cc": None, "views": {}}
    means: dict = {"heldout_appearance": "nearby" if nearby else "mean"}
    means |= {
        key: float(np.mean([row[key] for row in rows.values()]))
        for key in ("psnr", "ssim", "psnr_cc")
    }
    return means | {"views": rows}


def checkpoint(fitting: Fitting, run: Path) -> None:
    """Saves the field and all that continues the fit, each file atomically."""
    # What photos see changes as the field does; snow and light ask for it.
    fitting.field.occupancy.seen.zero_()
    looks = torch.Generator().manual_seed(fitting.settings.seed)
    for _ in range(4):
        batch = fitting.pixels.draw(16384, looks)
        rays = (batch.rays_o, batch.rays_d, batch.image)
        with torch.no_grad():  # no corrections leave rays as they are
            rays_o, rays_d = fitting.poses.rays(*rays, fitting.field.unit)
        fitting.field.sampler.mark_seen(rays_o, rays_d)
    save_field(fitting.field, run)
    state = {f"grid.{k}": v for k, v in fitting.grid_adam.state().items()}
    for index, moments in fitting.net_adam.state_dict()["state"].items():
        state |= {f"net.{index}.{k}": torch.as_tensor(v) for k, v in moments.items()}
    for name, module in (("masks", fitting.masks), ("poses", fitting.poses)):
        state |= {f"{name}.{k}": v.detach() for k, v in module.state_dict().items()}
    state["relative"] = fitting.relative.sums
    state["barred"] = torch.from_numpy(np.packbits(to_numpy(fitting.field.occupancy.forced_empty)))
    state["generator"] = fitting.generator.get_state()
    numbers = [fitting.steps, fitting.samples, fitting.rays]
    state["counters"] = torch.tensor(numbers)
    state["floats"] = torch.tensor(
        [fitting.seconds, fitting.step_scale, fitting.error, fitting.stage], dtype=torch.float64
    )
    write_safetensors(run / OPTIMISER, state, {})


def with_corrections(scene: Scene, fitting: Fitting) -> Scene:
    """The scene with its training views' poses as the fit has corrected them, if it was to."""
    if not fitting.settings.refine_poses:
        return scene
    views = scene.of_split("train")
    given = to_device(np.stack([scene.c2w_world(view) for view in views])).float()
    corrected = to_numpy(fitting.poses.corrected(given, fitting.field.unit).double())
    back = np.linalg.inv(scene.world_from_input)
    moved = {}
    for view, c2w in zip(views, corrected, strict=True):
        pose = back @ c2w
        pose[:3, :3] *= scene.scale
        moved[view.name] = dataclasses.replace(view, c2w=pose)
    return dataclasses.replace(
        scene, views=tuple(moved.get(view.name, view) for view in scene.views)
    )


def in_frame_of(scene: Scene, run: Path, downscale: int) -> Scene:
    """The scene in the metres of a run that is to be resumed: its field knows no others.

    Raises:
        UserError: the run is of other photos (appearance belongs to photos, and held-out ones must
            not have been trained on), of another size of them, or from a newer version.
    """
    config = check_config(run)
    if config.get("downscale") != downscale:
        raise UserError(
            f"{run} was fitted at --downscale {config.get('downscale')}; resume it with the same"
        )
    before = load_scene(run)
    names = [view.name for view in before.of_split("train")]
    if names != [view.name for view in scene.of_split("train")]:
        raise UserError(
            f"{run} was fitted to other photos; resume it with the same scene and --holdout"
        )
    return dataclasses.replace(
        scene,
        world_from_input=before.world_from_input,
        scale_source=before.scale_source,
        scale_error=before.scale_error,
        ground_z=before.ground_z,
        lowest_ground_z=before.lowest_ground_z,
        up_report=before.up_report,
        scale_report=before.scale_report,
        georeference=before.georeference,
    )


def restore(fitting: Fitting, run: Path) -> None:
    """Puts a checkpoint back into a fit of the same scene and settings."""
    field = load_field(run)
    if field.embeddings.shape != fitting.field.embeddings.shape or field.size != fitting.field.size:
        raise UserError(
            f"{run / 'field.safetensors'} is of another fit than its config.json; fit anew into"
            " another folder"
        )
    fitting.field.occupancy = field.occupancy
    learned = fitting.field.learned.clone()
    with torch.no_grad():
        fitting.field.load_state_dict(field.state_dict())
    fitting.field.learned |= learned
    fitting.learns_classes = fitting.field.knows_classes
    fitting.field.unit, fitting.field.near, fitting.field.pruning_threshold = (
        field.unit,
        field.near,
        field.pruning_threshold,
    )
    arrays, _ = read_safetensors(run / OPTIMISER, "the optimiser's state")
    try:
        _restore_state(fitting, arrays)
    except (KeyError, ValueError, RuntimeError, TypeError) as error:
        raise UserError(
            f"{run / OPTIMISER} is damaged ({type(error).__name__}: {error}); the run can be"
            " rendered but not resumed, fit anew into another folder"
        ) from error
    if not field.knows_classes:  # labels are new: the head that learns them begins now
        fitting.classed_at = fitting.stage + REFINE_AT


def _restore_state(fitting: Fitting, arrays: dict) -> None:
    state = {k: torch.from_numpy(np.array(v)) for k, v in arrays.items()}
    fitting.grid_adam.load(
        {k.removeprefix("grid."): v for k, v in state.items() if k.startswith("grid.")}
    )
    moments: dict[int, dict] = {}
    for key, value in state.items():
        if key.startswith("net."):
            _, index, name = key.split(".")
            moments.setdefault(int(index), {})[name] = value
    groups = fitting.net_adam.state_dict()["param_groups"]
    fitting.net_adam.load_state_dict({"state": moments, "param_groups": groups})
    for name, module in (("masks", fitting.masks), ("poses", fitting.poses)):
        own = {k: v for k, v in state.items() if k.startswith(f"{name}.")}
        module.load_state_dict({k.removeprefix(f"{name}."): v for k, v in own.items()})
    fitting.relative.sums.copy_(state["relative"])
    barred = fitting.field.occupancy.forced_empty
    bits = np.unpackbits(state["barred"].numpy(), count=barred.numel())
    barred.copy_(torch.from_numpy(bits.astype(bool)).view(barred.shape))
    fitting.carving.fit_ground()  # in the units of the run
    fitting.carving.rasterise_points()
    fitting.generator.set_state(state["generator"])
    fitting.steps, fitting.samples, fitting.rays = state["counters"].tolist()
    floats = state["floats"].tolist()
    fitting.seconds, fitting.step_scale, fitting.error = floats[:3]
    fitting.reached = floats[3] if len(floats) > 3 else 0.0  # earlier versions did not keep it


def save_preview(field: Field, scene: Scene, run: Path, step: int) -> None:
    """A small picture of a run: the field's rendering beside a photo that it is fitted to."""
    views = scene.of_split("train")
    view = views[len(views) // 2]
    camera = scene.cameras[view.camera]
    small = camera.resized(PREVIEW_WIDTH, round(PREVIEW_WIDTH * camera.height / camera.width))
    with torch.no_grad():
        picture = render_view(field, small, scene.c2w_world(view))
    photo = _resized(load_image(view, scene), small)
    pair = np.concatenate([(picture * 255 + 0.5).astype(np.uint8), photo], axis=1)
    with atomic_path(run / "previews" / f"step_{step:06d}.jpg") as path:
        Image.fromarray(pair).save(path, quality=90)


def _resized(
    photo: UInt8[np.ndarray, "h w 3"], camera: Camera
) -> UInt8[np.ndarray, "height width 3"]:
    return np.asarray(Image.fromarray(photo).resize((camera.width, camera.height)))


def _config(settings: FitSettings, downscale: int, field: Field) -> dict:
    return {
        "schema_version": SCHEMA_VERSION,
        "climatenerf": climatenerf.__version__,
        "settings": dataclasses.asdict(settings),
        "downscale": downscale,
        "field": dataclasses.asdict(field.size),
        "metres_per_grid_unit": field.unit,
        "near_m": field.near,
    }
