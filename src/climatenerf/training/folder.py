"""Checks of run folders before a fit. Does not import torch: errors appear at once."""

import dataclasses
from pathlib import Path

from climatenerf.core import parsing
from climatenerf.core.errors import UserError, one_line
from climatenerf.core.storage import check_schema
from climatenerf.scene.scene import Scene
from climatenerf.training.settings import FitSettings, with_present_names
from climatenerf.training.snapshot import CONFIG, METRICS, OPTIMISER, finish_after_kill

SCHEMA_VERSION = 1  # of config.json


def check_folder(scene: Scene, run: Path, resume: bool) -> None:
    """Check that a fit would overwrite nothing in a folder, and could resume if it is to.

    If a killed fit was moving its files into the folder, the moves are finished.

    Raises:
        UserError: the folder cannot be used.
    """
    if run.resolve() == scene.root.resolve():
        raise UserError(f"{run} is the capture itself; give another folder for the run with -o")
    finish_after_kill(run)
    has_config = (run / CONFIG).is_file()
    if resume and not has_config:
        raise UserError(f"{run} holds no run to resume; leave --resume out to begin one")
    if resume and not (run / OPTIMISER).is_file():
        raise UserError(
            f"{run} holds no {OPTIMISER}, without which it can be rendered but not resumed; fit"
            " anew into another folder"
        )
    if not resume and (run / "scene.json").exists() and not has_config:
        raise UserError(f"{run} holds a scene, which would be overwritten; choose another -o")
    # The optimiser's file is the last that a checkpoint writes; without it nothing is lost.
    if not resume and ((run / OPTIMISER).exists() or (run / METRICS).exists()):
        raise UserError(
            f"{run} already holds a run; choose another -o, or continue it with --resume"
        )


def check_config(run: Path) -> dict:
    """Return the run's configuration, its settings by their present names.

    Raises:
        UserError: the file cannot be read, or a newer version wrote it.
    """
    where = str(run / CONFIG)
    config = parsing.read_json(run / CONFIG, "the run's configuration")
    check_schema(config.get("schema_version"), SCHEMA_VERSION, f"the run in {run}")
    config["settings"] = with_present_names(parsing.entries(config, "settings", where, {}))
    parsing.integer(config, "downscale", where, 1, 10_000, 1)
    parsing.entries(config, "field", where, {})
    return config


SCORES = (
    "ground.present",
    "ground.roughness_cm",
    "neighbours.psnr",
    "floating.components",
    "floating.share",
    "sky.empty",
    "points.abs_rel",
)
"""Scores of a run that need no reference; see `evaluation.no_reference`."""


def checked_metrics(path: Path) -> dict:
    """Return the content of a run's `metrics.json`, with the types that `fit` writes.

    Raises:
        UserError: the file cannot be read, or a value has another type.
    """
    metrics, where = parsing.read_json(path, "the run's metrics"), str(path)
    metrics["interrupted"] = parsing.flag(metrics, "interrupted", where, False)
    metrics["steps"] = parsing.integer(metrics, "steps", where, 0, 2**53, 0)
    for name in ("seconds", "masked_fraction", "psnr", "psnr_cc", "ssim"):
        if metrics.get(name) is not None:
            parsing.number(metrics, name, where)
    if metrics.get("psnr") is not None:  # all three are written together
        metrics |= {name: parsing.number(metrics, name, where) for name in ("psnr_cc", "ssim")}
    for name in SCORES:
        if metrics.get(name) is not None:
            parsing.number(metrics, name, where)
    return metrics


def check_resumable(run: Path, settings: FitSettings) -> None:
    """Check that the settings can resume a run, before photos are read.

    Raises:
        UserError: the run was begun with settings that cannot be changed.
    """
    config = check_config(run)
    before, size = config["settings"], settings.size
    if "losses" in before and before.get("preset", settings.preset) != settings.preset:
        preset = one_line(str(before["preset"]), 40)
        raise UserError(f"{run} was fitted with --preset {preset}; resume it with the same")
    if "losses" not in before or config.get("field") != dataclasses.asdict(size):
        raise UserError(
            f"{run} was fitted by an earlier version; it can be rendered but not resumed, fit anew"
            " into another folder"
        )
    if before.get("refine_poses") and not settings.refine_poses:
        raise UserError(
            f"{run} was fitted with --refine-poses; resume it with that, or its cameras would move"
            " back"
        )
