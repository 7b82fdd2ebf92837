"""Importance sampling: which samples of a ray get colour and gradients.

Early in a fit rays cross haze, with hundreds of samples of small weight. A few of them a ray are
selected with probabilities proportional to their weights. Where surfaces are found, all samples of
any weight are selected.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from climatenerf.core.device import uniform
from climatenerf.training.schedule import Schedule
from climatenerf.training.static_shapes import Buffers


def select_samples(
    weights: Float[Tensor, "s"],
    valid: Bool[Tensor, "s"],
    schedule: Schedule,
    buffers: Buffers,
    generator: torch.Generator,
) -> tuple[Int[Tensor, "k"], Float[Tensor, "k"]]:
    """Return the indices of selected samples, and the inclusion probability of each.

    Args:
        weights: of all samples, [0,1].
        valid: False for the unused entries of a fixed-capacity buffer.
        schedule: number of samples a ray, and the smallest probability.
        buffers: for the list of indices.
        generator: source of random numbers, on the CPU.
    """
    least = schedule.min_inclusion_probability
    probability = (schedule.selected_per_ray * weights).clamp(least, 1.0) * valid
    # Systematic sampling: selected samples are spread evenly among those of similar weight.
    start = uniform(generator, 1, device=weights.device).double()
    passed = probability.double().cumsum(0) + start
    selected = buffers.indices("selected", passed.floor() > (passed - probability).floor())
    # Unused entries of a buffer have probability 0: 0/0.
    return selected, probability[selected].clamp_min(least)
