"""From a scene to a run folder: photos, fit, previews, checkpoints, metrics."""

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image

import climatenerf
from climatenerf.core.device import CPU, to_device, to_numpy
from climatenerf.core.errors import UserError
from climatenerf.core.storage import atomic_path, make_folder, write_json
from climatenerf.evaluation.heldout import evaluate
from climatenerf.evaluation.no_reference import no_reference_scores, no_scores
from climatenerf.field.capabilities import CLASSES, NORMALS
from climatenerf.field.hash_field import Field
from climatenerf.field.normalisation import find_extent
from climatenerf.render.ground_evidence import terrain_below
from climatenerf.render.photo_rays import trace_photos
from climatenerf.render.volume import render_view
from climatenerf.scene.datum import with_datum
from climatenerf.scene.images import (
    downscaled_camera,
    load_image,
    load_labels,
    load_mask,
    load_relative_depth,
)
from climatenerf.scene.photo_rays import PhotoRays
from climatenerf.scene.scene import Scene
from climatenerf.scene.terrain import Terrain, save_terrain
from climatenerf.training.checkpoint import checkpoint, in_frame_of, restore
from climatenerf.training.dataset import TrainingPixels
from climatenerf.training.evidence.multiview_stereo import plane_sweep_depth
from climatenerf.training.evidence.sparse_depth import unmasked_sparse_depth
from climatenerf.training.floaters import remove_floaters
from climatenerf.training.folder import (
    SCHEMA_VERSION,
    check_folder,
    check_resumable,
)
from climatenerf.training.optimiser import Diverged
from climatenerf.training.progress import Report
from climatenerf.training.settings import FitSettings, as_config
from climatenerf.training.setup import compile_kernels, make_trainer
from climatenerf.training.snapshot import FIELD, METRICS, identity_of, writing_run
from climatenerf.training.trainer import Trainer

CHECKPOINT_INTERVAL = 60.0  # seconds
PREVIEW_INTERVAL = 20.0  # seconds
PREVIEW_WIDTH = 240  # pixels
MIN_PICTURE = 16  # pixels along each side; windows of the structural similarity have 11
MIN_SPREAD = 1e-3  # m between cameras and their mean; nearer ones are in one position,
MIN_INPUT_SPREAD = 1e-6  # as they are below this in units of the poses as given
MAX_PIXELS_AFTER_STOP = 1_000_000  # that are rendered before a stopped fit ends: 3 s on two cores
MIN_USABLE_FRACTION = 1e-3  # of the pixels that masks must leave


def load_pixels(scene: Scene, downscale: int, device: torch.device = CPU) -> TrainingPixels:
    """Return all training pixels of a scene, its photos reduced by a factor `downscale`.

    A fit to them computes on `device`.

    Raises:
        UserError: pictures are too small to measure, or masks leave no pixels to learn from.
    """
    views = scene.of_split("train")
    cameras = [downscaled_camera(camera, downscale) for camera in scene.cameras]
    smallest = min(min(camera.width, camera.height) for camera in cameras)
    if smallest < MIN_PICTURE:
        raise UserError(
            f"the pictures are only {smallest} pixels wide or high at --downscale {downscale};"
            f" at least {MIN_PICTURE} are needed"
        )
    pixels = TrainingPixels(
        cameras,
        [view.camera for view in views],
        np.stack([scene.c2w_world(view) for view in views]),
        (load_image(view, scene, downscale) for view in views),
        (load_labels(view, scene, downscale) for view in views),
        (load_mask(view, scene, downscale) for view in views),
        (load_relative_depth(view, scene, downscale) for view in views),
        device,
    )
    if pixels.usable_fraction < MIN_USABLE_FRACTION:
        raise UserError(
            f"the masks of {scene.root} leave {pixels.usable_fraction:.4%} of the pixels to learn"
            " from; make pixels to be ignored black in them, and the rest white"
        )
    return pixels


def fit_scene(
    scene: Scene,
    run: Path,
    settings: FitSettings,
    downscale: int,
    resume: bool,
    after_step: Callable[[Report], None],
    after_view: Callable[[int, int], None],
    device: torch.device = CPU,
) -> dict:
    """Fit a field to a scene, write a run folder, and return the metrics.

    Ctrl-C ends the fit early; the field learned so far is saved, and measured if that is quick. The
    folder is locked against other writers; those who read it see the files of one checkpoint.

    Args:
        scene: the capture.
        run: the run folder, made if absent.
        settings: of the fit.
        downscale: factor by which the photos are reduced.
        resume: continue from the folder's checkpoint.
        after_step: called with the state of the fit after each step.
        after_view: called with (views done, views) while the held-out views are measured.
        device: where to compute.

    Raises:
        UserError: the folder already holds a run (without resume) or none (with it), or another
            process writes into it.
    """
    check_folder(scene, run, resume)
    with writing_run(run):
        check_folder(scene, run, resume)  # again: the other process may just have ended
        return _fit(scene, run, settings, downscale, resume, (after_step, after_view), device)


def _fit(
    scene: Scene,
    run: Path,
    settings: FitSettings,
    downscale: int,
    resume: bool,
    callbacks: tuple[Callable[[Report], None], Callable[[int, int], None]],
    device: torch.device,
) -> dict:
    """Fit a field, with the folder locked; see `fit_scene`."""
    after_step, after_view = callbacks
    if resume:
        check_resumable(run, settings)
        scene = in_frame_of(scene, run, downscale)
    for view in scene.of_split("heldout"):
        # A damaged picture must be reported now, not after the fit.
        load_image(view, scene, downscale)
        load_mask(view, scene, downscale)
    trainer = begin(scene, settings, downscale, device)
    if resume:
        restore(trainer, run)
    make_folder(run / "previews")
    config = _config(settings, downscale, trainer.field)
    last = {"checkpoint": time.monotonic(), "preview": time.monotonic()}

    def save_sometimes(state: Report) -> None:
        after_step(state)
        now = time.monotonic()
        if now - last["preview"] > PREVIEW_INTERVAL:
            save_preview(trainer.field, with_corrections(scene, trainer), run, state.step)
            last["preview"] = time.monotonic()
        if now - last["checkpoint"] > CHECKPOINT_INTERVAL:
            checkpoint(trainer, run, with_corrections(scene, trainer), config)
            last["checkpoint"] = time.monotonic()

    interrupted = False
    try:
        compile_kernels(trainer)
        trainer.run(save_sometimes)
    except KeyboardInterrupt:
        interrupted = True
    except Diverged:
        checkpoint(trainer, run, with_corrections(scene, trainer), config)
        raise
    trainer.field.occupancy.update(trainer.field.grid_density, 1.0, 0.8, trainer.generator)
    scene = with_corrections(scene, trainer)
    checkpoint(trainer, run, scene, config)  # what follows takes seconds, and may be interrupted
    datum, traced = scene.ground_z, None
    if not interrupted and trainer.field.capabilities & {NORMALS, CLASSES}:
        removed, traced = _finish_geometry(trainer.field, scene, settings.free_space)
        scene = with_datum(scene, traced[1])
        if removed or scene.ground_z != datum:
            checkpoint(trainer, run, scene, config)
    save_preview(trainer.field, scene, run, trainer.steps)
    metrics = {
        "seconds": round(trainer.seconds, 3),
        "steps": trainer.steps,
        "samples": trainer.samples,
        "interrupted": interrupted,
        "downscale": downscale,
        "train_views": len(scene.of_split("train")),
        "masked_fraction": masked_fraction(trainer),
        "discarded_steps": trainer.discarded.total,
        "datum_moved_m": scene.ground_z - datum,
    }
    write_json(run / METRICS, metrics)
    if interrupted and heldout_pixels(scene, downscale) > MAX_PIXELS_AFTER_STOP:
        # The user waits for the end, and a resumed fit will be measured.
        metrics |= no_scores("the fit was interrupted")
        write_json(run / METRICS, metrics)
        return metrics | {"psnr": None, "ssim": None, "psnr_cc": None}
    metrics |= evaluate(trainer.field, scene, downscale, after_view)
    metrics |= _score_ground(trainer.field, scene, run, traced)
    write_json(run / METRICS, metrics)
    return metrics


def _finish_geometry(
    field: Field, scene: Scene, free_space: bool
) -> tuple[int, tuple[list[PhotoRays], Terrain | None]]:
    """Remove floaters from a fitted field.

    Returns:
        How many; and the rays of the photos on the field that is left, with its terrain.
    """
    photos = trace_photos(field.observed_only(), scene)
    terrain = terrain_below(field, photos)
    removed = remove_floaters(field, photos, terrain) if free_space else 0
    if removed:
        photos = trace_photos(field.observed_only(), scene)
        terrain = terrain_below(field, photos)
    return removed, (photos, terrain)


def _score_ground(
    field: Field, scene: Scene, run: Path, traced: tuple[list[PhotoRays], Terrain | None] | None
) -> dict:
    """Save the terrain of a finished fit, and return the scores that need no reference."""
    identity = identity_of(run / FIELD) or ""
    if not field.capabilities & {NORMALS, CLASSES}:
        save_terrain(None, run, identity)
        return no_scores("the field knows neither normals nor classes")
    photos, terrain = traced or _finish_geometry(field, scene, free_space=False)[1]
    save_terrain(terrain, run, identity)
    return no_reference_scores(field, scene, photos, terrain)


def heldout_pixels(scene: Scene, downscale: int) -> int:
    """Return the number of pixels that measuring the held-out views renders."""
    cameras = [scene.cameras[view.camera] for view in scene.of_split("heldout")]
    return sum((c.width // downscale) * (c.height // downscale) for c in cameras)


def begin(
    scene: Scene, settings: FitSettings, downscale: int, device: torch.device = CPU
) -> Trainer:
    """Return a trainer before its first step: read the photos and gather all evidence.

    Raises:
        UserError: a photo cannot be read, or all were taken from one position.
    """
    poses = np.stack([scene.c2w_world(view) for view in scene.of_split("train")])
    check_baseline(poses, scene.scale)
    pixels = load_pixels(scene, downscale, device)
    extent = find_extent(poses, scene.points_world())
    points = unmasked_sparse_depth(scene, pixels)
    matched = None
    if settings.multiview_stereo and settings.losses.sparse_depth:
        known = pixels if settings.sky_labels else pixels.without_sky()
        matched = plane_sweep_depth(known, points, (extent.near, extent.unit), settings.seed)
    return make_trainer(pixels, extent, settings, points, matched)


def check_baseline(c2w: Float[np.ndarray, "v 4 4"], scale: float) -> None:
    """Check that the cameras are not all in one position, where depth cannot be estimated.

    The metric scale may have been derived from the distances of the cameras, so their spread in the
    poses' own unit is checked as well.

    Args:
        c2w: poses, world m.
        scale: metres per unit of the poses as given.

    Raises:
        UserError: they are.
    """
    centres = c2w[:, :3, 3]
    spread = np.linalg.norm(centres - centres.mean(0), axis=-1).max()
    if spread < max(MIN_SPREAD, MIN_INPUT_SPREAD * scale):
        raise UserError(
            f"all {len(centres)} photos were taken from one spot (within {1000 * spread:.2g} mm),"
            " so depth cannot be estimated; walk while you take them"
        )


def masked_fraction(trainer: Trainer) -> float | None:
    """Return the fraction of the training pixels masked as transient; None without masks."""
    if not trainer.settings.losses.transient:
        return None
    return float(trainer.masks.masked_fractions().mean())


def with_corrections(scene: Scene, trainer: Trainer) -> Scene:
    """Return the scene with the poses of its training views as corrected by the fit, if any."""
    if not trainer.settings.refine_poses:
        return scene
    views = scene.of_split("train")
    given = np.stack([scene.c2w_world(view) for view in views])
    given = to_device(given, trainer.pixels.device).float()
    corrected = to_numpy(trainer.poses.corrected(given, trainer.field.unit).double())
    input_from_world = np.linalg.inv(scene.world_from_input)
    moved = {}
    for view, c2w in zip(views, corrected, strict=True):
        pose = input_from_world @ c2w
        pose[:3, :3] *= scene.scale
        moved[view.name] = dataclasses.replace(view, c2w=pose)
    return dataclasses.replace(
        scene, views=tuple(moved.get(view.name, view) for view in scene.views)
    )


def save_preview(field: Field, scene: Scene, run: Path, step: int) -> None:
    """Save a small picture of a run: a rendered training view next to its photo."""
    views = scene.of_split("train")
    view = views[len(views) // 2]
    camera = scene.cameras[view.camera]
    small = camera.resized(PREVIEW_WIDTH, round(PREVIEW_WIDTH * camera.height / camera.width))
    with torch.no_grad():
        picture = render_view(field, small, scene.c2w_world(view))
    photo = Image.fromarray(load_image(view, scene)).resize((small.width, small.height))
    pair = np.concatenate([(picture * 255 + 0.5).astype(np.uint8), np.asarray(photo)], axis=1)
    with atomic_path(run / "previews" / f"step_{step:06d}.jpg") as path:
        Image.fromarray(pair).save(path, quality=90)


def _config(settings: FitSettings, downscale: int, field: Field) -> dict:
    return {
        "schema_version": SCHEMA_VERSION,
        "climatenerf": climatenerf.__version__,
        "settings": as_config(settings),
        "downscale": downscale,
        "field": dataclasses.asdict(field.size),
        "metres_per_grid_unit": field.unit,
        "near_m": field.near,
    }
