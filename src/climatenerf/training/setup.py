"""What happens before the first step: field, evidence and objective are made, kernels compiled."""

from dataclasses import replace

import numpy as np
import torch

from climatenerf.core.device import to_numpy
from climatenerf.field.hash_field import Field
from climatenerf.field.normalisation import Extent
from climatenerf.training.dataset import TrainingPixels
from climatenerf.training.evidence.gather import gather_evidence
from climatenerf.training.evidence.monocular_depth import DepthAlignment
from climatenerf.training.evidence.sparse_depth import SparseDepth
from climatenerf.training.objective import Objective
from climatenerf.training.settings import FitSettings
from climatenerf.training.static_shapes import buffers_for
from climatenerf.training.trainer import Trainer
from climatenerf.training.transients import TransientMasks


def make_trainer(
    pixels: TrainingPixels,
    extent: Extent,
    settings: FitSettings,
    points: SparseDepth | None = None,
    matched: SparseDepth | None = None,
) -> Trainer:
    """Return a trainer with an untrained field and all evidence.

    Args:
        pixels: of all training photos; the fit computes on their device.
        extent: centre (world m), unit (m per grid unit) and nearest distance of the scene.
        settings: of the fit, with the field's size.
        points: rays to sparse points.
        matched: rays with depths from multi-view stereo, some of them wrong.
    """
    images, device = len(pixels.cameras), pixels.device
    if not settings.sky_labels:
        pixels = pixels.without_sky()
    initial = torch.Generator(device="cpu").manual_seed(settings.seed)
    centre = np.array(extent.centre)
    field = Field(settings.size, images, centre, extent.unit, extent.near, initial).to(device)
    masks = TransientMasks(images, initial).to(device)
    generator = torch.Generator(device="cpu").manual_seed(settings.seed)
    evidence = gather_evidence(field, pixels, settings, generator, points, matched)
    learns_classes = settings.losses.classes > 0 and evidence.classes_learnable
    field.learned[1] = learns_classes  # normals: see `normals_at`
    field.sky_grid.requires_grad_(evidence.knows_sky)
    objective = Objective(
        settings=settings,
        evidence=evidence,
        pixels=pixels,
        masks=masks,
        depth_alignment=DepthAlignment(images, device),
        buffers=buffers_for(device),
        learns_classes=learns_classes,
        classes_used_from=settings.schedule.refine_at,
    )
    first_near = settings.schedule.first_near * extent.unit if settings.warm_up else 0.0
    if points is not None:  # along a street surfaces may be nearer than that
        nearest = float(np.quantile(to_numpy(points.depth), 0.02))
        first_near = min(first_near, nearest / 2)
    return Trainer(field, objective, extent, first_near, generator)


def compile_kernels(trainer: Trainer) -> None:
    """Run every kernel once on a few rays, so that compiling does not count as fitting."""
    small = replace(trainer.field.size, geometry_log2_rows=10, appearance_log2_rows=10)
    weights = replace(trainer.settings.losses, ground_height=0.0)
    settings = replace(trainer.settings, size=small, free_space=False, losses=weights)
    points = trainer.evidence.free_space.sparse
    twin = make_trainer(trainer.pixels, trainer.extent, settings, points)
    twin.step(twin.pixels.draw(16, twin.generator))
    q = torch.zeros(16, 3, device=twin.pixels.device)
    twin.field.grid_density(q)
    twin.field.density_normal(q)
