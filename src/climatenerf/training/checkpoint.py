"""Checkpoints of a fit: the field, and in `optimiser.safetensors` all else that continues it."""

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from climatenerf.core import parsing
from climatenerf.core.device import to_numpy
from climatenerf.core.errors import UserError, one_line
from climatenerf.core.storage import (
    check_finite,
    digest,
    read_safetensors,
    write_json,
    write_safetensors,
)
from climatenerf.field.checkpoint import MAX_VALUE, load_field, save_field
from climatenerf.scene.scene import Scene, load_scene
from climatenerf.training.folder import check_config
from climatenerf.training.snapshot import (
    CONFIG,
    FIELD,
    OPTIMISER,
    identity_of,
    new_checkpoint,
    stage_scene,
)
from climatenerf.training.trainer import Trainer

RENAMED_CORRECTIONS = {"turn": "rotation", "shift": "translation"}
"""Parameters of `PoseCorrections` by their names in files of earlier versions."""
OBSERVED_BATCHES, OBSERVED_RAYS = 4, 16384  # that find the cells which training photos show


def checkpoint(
    trainer: Trainer,
    run: Path,
    scene: Scene | None = None,
    config: Mapping[str, Any] | None = None,
) -> None:
    """Save the field and all that continues the fit; the files replace the earlier ones as one.

    Args:
        trainer: the fit.
        run: the run folder.
        scene: the scene as it is fitted; None keeps the one in the folder.
        config: content of `config.json`; None keeps the file in the folder.
    """
    mark_observed_cells(trainer)
    identity = _identity(trainer)
    with new_checkpoint(run) as staging:
        save_field(trainer.field, staging, identity)
        state = _state(trainer)
        about = {"checkpoint": identity, "climatenerf": json.dumps({"digest": digest(state)})}
        write_safetensors(staging / OPTIMISER, state, about)
        if config is not None:
            write_json(staging / CONFIG, {**config, "checkpoint": identity})
        if scene is not None:
            stage_scene(scene, run, staging, identity)


def _identity(trainer: Trainer) -> str:
    """Return a name for the state of a fit, the same in equal fits."""
    counters = f"{trainer.settings.seed} {trainer.steps} {trainer.samples} {trainer.rays}"
    digest = hashlib.sha256(counters.encode())
    digest.update(trainer.generator.get_state().numpy().tobytes())
    return digest.hexdigest()[:16]


def _state(trainer: Trainer) -> dict[str, torch.Tensor]:
    """Return all but the field that continues a fit."""
    state = {f"grid.{k}": v for k, v in trainer.grid_adam.state().items()}
    for index, moments in trainer.net_adam.state_dict()["state"].items():
        state |= {f"net.{index}.{k}": torch.as_tensor(v, device="cpu") for k, v in moments.items()}
    for name, module in (("masks", trainer.masks), ("poses", trainer.poses)):
        state |= {f"{name}.{k}": v.detach() for k, v in module.state_dict().items()}
    state["relative"] = trainer.objective.depth_alignment.sums
    state["barred"] = torch.from_numpy(np.packbits(to_numpy(trainer.field.occupancy.forced_empty)))
    state["generator"] = trainer.generator.get_state()
    counters = [trainer.steps, trainer.samples, trainer.rays]
    state["counters"] = torch.tensor(counters, device="cpu")
    floats = [trainer.seconds, trainer.step_scale, trainer.error, trainer.progress]
    state["floats"] = torch.tensor(floats, dtype=torch.float64, device="cpu")
    return state


def mark_observed_cells(trainer: Trainer) -> None:
    """Mark the cells in which training photos show matter now; snow and light ask for them."""
    field = trainer.field
    field.occupancy.seen.zero_()
    generator = torch.Generator(device="cpu").manual_seed(trainer.settings.seed)
    for _ in range(OBSERVED_BATCHES):
        batch = trainer.pixels.draw(OBSERVED_RAYS, generator)
        with torch.no_grad():
            rays = trainer.poses.rays(batch.rays_o, batch.rays_d, batch.image, field.unit)
        field.sampler.mark_seen(*rays)


def restore(trainer: Trainer, run: Path) -> None:
    """Load a checkpoint into a trainer of the same scene and settings.

    Raises:
        UserError: the checkpoint is of another fit, or damaged.
    """
    saved, field = load_field(run, trainer.pixels.device), trainer.field
    if saved.embeddings.shape != field.embeddings.shape or saved.size != field.size:
        raise UserError(
            f"{run / 'field.safetensors'} is of another fit than its config.json; fit anew into"
            " another folder"
        )
    field.occupancy = saved.occupancy
    learned = field.learned.clone()
    with torch.no_grad():
        field.load_state_dict(saved.state_dict())
    field.learned |= learned
    trainer.objective.learns_classes = field.knows_classes
    field.unit, field.near, field.pruning_threshold = (
        saved.unit,
        saved.near,
        saved.pruning_threshold,
    )
    arrays, metadata = read_safetensors(run / OPTIMISER, "the optimiser's state")
    if metadata.get("checkpoint", "") not in ("", identity_of(run / FIELD) or ""):
        raise UserError(
            f"{run / OPTIMISER} and {FIELD} are of different checkpoints; the run can be rendered"
            " but not resumed, copy both again or fit anew into another folder"
        )
    about = parsing.parse_json(metadata.get("climatenerf", "{}"), str(run / OPTIMISER))
    try:
        _check_state(arrays, about)
        _restore_state(trainer, arrays)
    except (KeyError, ValueError, RuntimeError, TypeError, IndexError) as error:
        raise UserError(
            f"{run / OPTIMISER} is damaged ({one_line(str(error), 120)}); the run can be rendered"
            " but not resumed, fit anew into another folder"
        ) from error
    if not saved.knows_classes:  # the labels are new, so the class head begins to learn now
        objective = trainer.objective
        objective.classes_used_from = trainer.progress + trainer.schedule.refine_at


def _check_state(arrays: dict[str, np.ndarray], about: object) -> None:
    """Refuse the state of an optimiser that would make NaN of a sound field.

    Raises:
        ValueError: its checksum is wrong, or a number is not finite, far too large, or negative
            where a square is expected.
    """
    expected = about.get("digest") if isinstance(about, dict) else None
    if expected is not None and expected != digest(arrays):  # absent in earlier versions
        raise ValueError("its checksum is another")
    check_finite(arrays, MAX_VALUE)
    for name, array in arrays.items():
        negative = name.endswith((".second", ".exp_avg_sq", ".step", "steps", "counters"))
        if negative and array.size and array.min() < 0:
            raise ValueError(f"{name} holds a negative number")


def _restore_state(trainer: Trainer, arrays: dict) -> None:
    state = {k: torch.from_numpy(np.array(v)) for k, v in arrays.items()}

    def part(prefix: str) -> dict[str, torch.Tensor]:
        return {k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)}

    trainer.grid_adam.load(part("grid."))
    moments: dict[int, dict] = {}
    for key, value in part("net.").items():
        index, name = key.split(".")
        moments.setdefault(int(index), {})[name] = value
    groups = trainer.net_adam.state_dict()["param_groups"]
    trainer.net_adam.load_state_dict({"state": moments, "param_groups": groups})
    trainer.masks.load_state_dict(part("masks."))
    poses = {RENAMED_CORRECTIONS.get(k, k): v for k, v in part("poses.").items()}
    trainer.poses.load_state_dict(poses)
    trainer.objective.depth_alignment.sums.copy_(state["relative"])
    barred = trainer.field.occupancy.forced_empty
    bits = np.unpackbits(state["barred"].numpy(), count=barred.numel())
    barred.copy_(torch.from_numpy(bits.astype(bool)).view(barred.shape))
    trainer.evidence.free_space.fit_ground()  # in the units of the run
    trainer.evidence.free_space.rasterise_points()
    trainer.generator.set_state(state["generator"])
    trainer.steps, trainer.samples, trainer.rays = state["counters"].tolist()
    floats = state["floats"].tolist()
    trainer.seconds, trainer.step_scale, trainer.error = floats[:3]
    trainer.resumed_progress = floats[3] if len(floats) > 3 else 0.0  # absent in earlier versions


def in_frame_of(scene: Scene, run: Path, downscale: int) -> Scene:
    """Return the scene in the metric frame of a run that is to be resumed.

    Raises:
        UserError: the run is of other photos (appearance belongs to photos, and held-out photos
            must not have been trained on), of another size of them, or from a newer version.
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
