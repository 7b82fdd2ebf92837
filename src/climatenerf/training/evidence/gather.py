"""What photos, labels and points show of a scene, gathered once before a fit."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, UInt8
from torch import Tensor

from climatenerf.core.classes import SOLID_OF, UNKNOWN
from climatenerf.field.hash_field import Field
from climatenerf.training.dataset import TrainingPixels, is_ground
from climatenerf.training.evidence.free_space import FreeSpace
from climatenerf.training.evidence.sky_prior import SkyPrior, fit_sky_prior
from climatenerf.training.evidence.sparse_depth import SparseDepth
from climatenerf.training.settings import FitSettings
from climatenerf.training.transients import find_static_cells


@dataclass(frozen=True)
class Evidence:
    """What a fit knows of the scene besides the colours of its pixels."""

    free_space: FreeSpace
    """Cells forced empty, and the ground height map, in the field's grid units."""
    sky_prior: SkyPrior
    """The sky in directions that no photo shows."""
    depths: tuple[SparseDepth, ...]
    """Rays with measured depths: sparse points, then matches of multi-view stereo."""
    static_cells: Bool[Tensor, "images cells cells"]
    """Where points show that a movable object, such as a parked car, has not moved."""
    knows_sky: bool
    """Whether any pixel is labelled sky."""
    classes_learnable: bool
    """Whether labels hold enough classes to learn them."""


def gather_evidence(
    field: Field,
    pixels: TrainingPixels,
    settings: FitSettings,
    generator: torch.Generator,
    points: SparseDepth | None = None,
    matched: SparseDepth | None = None,
) -> Evidence:
    """Gather all evidence, and force the field's cells empty that hold none.

    Args:
        field: untrained; its occupancy grid is changed.
        pixels: the photos' pixels, without sky labels if they are not to be used.
        settings: of the fit.
        generator: source of the pixels that the sky prior is fitted to, on the CPU.
        points: rays to sparse points.
        matched: rays with depths from multi-view stereo, some of them wrong.
    """
    sky_prior = fit_sky_prior(pixels, generator)
    free_space = FreeSpace(field, pixels, points, settings, matched)
    if matched is not None and free_space.ground is not None:
        # On the ground the map is better: matched windows mix fences with the lawns behind.
        label = pixels.label_towards(matched.image, matched.rays_d)
        matched = matched.select(~is_ground(label))
    depths = tuple(each for each in (points, matched) if each is not None)
    return Evidence(
        free_space=free_space,
        sky_prior=sky_prior,
        depths=depths,
        static_cells=find_static_cells(pixels, depths, len(pixels.cameras)),
        knows_sky=pixels.knows_sky,
        classes_learnable=can_learn_classes(pixels.classes()),
    )


def can_learn_classes(labelled: UInt8[Tensor, "k"]) -> bool:
    """Return whether these merged classes can be learned.

    A classifier trained on one class alone, or on nothing but ground, predicts it everywhere.
    """
    solid_of = torch.from_numpy(SOLID_OF.astype(np.int64)).to(labelled.device)
    solid = labelled[solid_of[labelled.long()] != UNKNOWN]
    return solid.numel() > 1 and not bool(is_ground(solid).all())
