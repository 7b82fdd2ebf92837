"""Run folders with random fields of every preset's layout, without a fit."""

import dataclasses
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from climatenerf.core.storage import write_json
from climatenerf.field.checkpoint import save_field
from climatenerf.field.hash_field import Field
from climatenerf.field.presets import PRESETS, FieldSize
from climatenerf.scene.scene import Scene, View, save_scene
from support.toy_scene import CAMERA, poses

VIEWS = 6


def small(preset: str) -> FieldSize:
    """The levels and widths of a preset with few rows and cells."""
    return dataclasses.replace(
        PRESETS[preset],
        geometry_log2_rows=9,
        appearance_log2_rows=9,
        surface_log2_rows=9,
        sky_log2_rows=9,
        occupancy_side=16,
        cascades=3,
    )


def opaque_field(size: FieldSize, seed: int = 0) -> Field:
    """A field with random matter in a fifth of its cells, most of it opaque, that knows classes."""
    generator = torch.Generator(device="cpu").manual_seed(seed)
    field = Field(size, VIEWS, np.zeros(3), unit=2.0, near=0.5, generator=generator)
    with torch.no_grad():
        for grid in (field.geometry_grid, field.appearance_grid, field.surface_grid):
            grid.copy_(torch.randn(grid.shape, generator=generator) * 0.5)
        field.geometry_net[-1].fill_(4.0)
        field.learned.fill_(True)
        shape = field.occupancy.occupied.shape
        inside = torch.rand(shape, generator=generator) < 0.2
        field.occupancy.occupied = inside.to(torch.uint8)
        field.occupancy.seen.fill_(1)
    return field.requires_grad_(False)


def random_run(folder: Path, size: FieldSize) -> Path:
    """Write a scene and a run folder with such a field; return the run folder."""
    views = []
    for index, c2w in enumerate(poses(VIEWS)):
        path = folder / "scene" / "images" / f"{index:02d}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (CAMERA.width, CAMERA.height), (90, 40 * index, 60)).save(path)
        views.append(View(path.name, path, 0, c2w, "train"))
    run = folder / "run"
    save_scene(Scene(folder / "scene", "toy", (CAMERA,), tuple(views)), run)
    save_field(opaque_field(size), run)
    write_json(run / "config.json", {"schema_version": 1, "field": dataclasses.asdict(size)})
    return run
