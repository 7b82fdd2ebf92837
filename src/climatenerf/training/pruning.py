"""Which space a fit stops marching through: empty cells, and samples of little density."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.core.samples import MIN_TAU
from climatenerf.field.hash_field import Field
from climatenerf.training.evidence.free_space import FreeSpace
from climatenerf.training.settings import FitSettings
from climatenerf.training.static_shapes import Buffers


def raise_pruning_threshold(
    field: Field,
    tau: Float[Tensor, "s"],
    weights: Float[Tensor, "s"],
    settings: FitSettings,
    progress: float,
    buffers: Buffers,
) -> None:
    """Raise the optical depth below which samples count as empty, unless much light ends there.

    Once surfaces are found, samples of low density are veils, above all between leaves and the
    sky.

    Args:
        field: its `pruning_threshold` is raised, at most doubled.
        tau: optical depths of a step's samples.
        weights: their rendering weights.
        settings: with the threshold at the end.
        progress: training progress, [0,1].
        buffers: read-backs of the steps.
    """
    goal = settings.schedule.pruning_threshold(MIN_TAU, settings.pruning_threshold, progress)
    if goal <= field.pruning_threshold:
        return
    doubled = 2 * field.pruning_threshold
    fraction = (weights * (tau < doubled)).sum() / weights.sum()  # no light at all: NaN, not <
    # A name for each doubling: deferred read-back must not return a lower threshold's fraction.
    name = f"pruned light at {round(math.log2(doubled / MIN_TAU))}"
    if buffers.read(name, fraction, math.inf) < settings.schedule.max_pruned_light:
        field.pruning_threshold = min(goal, doubled)


def update_occupancy(
    field: Field, step: int, surfaces_found: bool, free_space: FreeSpace, generator: torch.Generator
) -> None:
    """Evaluate every cell of the occupancy grid in the first steps, a fraction later."""
    occupancy = field.occupancy
    if step in (16, 32, 64, 128):
        occupancy.update(field.grid_density, 1.0, 0.9, generator)
    elif step % 16 == 0 and step > 128:
        occupancy.update(field.grid_density, 0.04, 0.8, generator)
    if surfaces_found and step > 128 and occupancy.side < field.size.occupancy_side:
        occupancy.refine()
        free_space.force_empty(everywhere=False)
