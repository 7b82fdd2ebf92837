"""Which samples get colour and gradients.

Early on rays cross haze, with hundreds of samples that hardly weigh: about `CHOSEN` a ray are drawn
in proportion to their weights, each standing for those like it. Where surfaces are found all that
weigh are taken.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from climatenerf.core.device import uniform
from climatenerf.training.static_shapes import Rooms

CHOSEN = 32  # samples of a ray, about
MIN_CHANCE = 0.25  # of any sample; with less, the noise lets walls grow before the cameras


def choose(
    weights: Float[Tensor, "s"], there: Bool[Tensor, "s"], rooms: Rooms, generator: torch.Generator
) -> tuple[Int[Tensor, "k"], Float[Tensor, "k"]]:
    """Indices of the chosen samples, and the chance that each had.

    Args:
        weights: of all samples.
        there: which are samples, and not what fills a room.
        rooms: for the list.
        generator: of randomness.
    """
    chance = (CHOSEN * weights).clamp(MIN_CHANCE, 1.0) * there
    # Systematic sampling: drawn ones are spread evenly among those like them.
    passed = chance.double().cumsum(0) + uniform(generator, 1).double()
    kept = rooms.chosen("kept", passed.floor() > (passed - chance).floor())
    # What fills a room has no chance, 0/0.
    return kept, chance[kept].clamp_min(MIN_CHANCE)
