"""Initial values of hash grids and of their fully connected networks."""

import math

import torch
from jaxtyping import Int
from torch import Tensor, nn


def level_resolutions(coarsest: int, finest: int, levels: int) -> Int[Tensor, "levels"]:
    """Return the cells per side of each level, in geometric progression."""
    growth = math.log(finest / coarsest) / max(levels - 1, 1)
    return torch.tensor([int(coarsest * math.exp(growth * i) + 1e-6) for i in range(levels)])


def uniform_parameter(
    shape: tuple[int, ...], bound: float, generator: torch.Generator | None
) -> nn.Parameter:
    """Return a parameter drawn from (-bound, bound).

    It is drawn on the CPU, so that a seed gives the same values on every device.
    """
    device = torch.get_default_device()
    if device.type == "meta":  # shapes without memory
        return nn.Parameter(torch.empty(shape, device=device))
    drawn = torch.empty(shape, device="cpu").uniform_(-bound, bound, generator=generator)
    return nn.Parameter(drawn.to(device))


def dense_layers(generator: torch.Generator | None, *widths: int) -> nn.ParameterList:
    """Return weights [in, out] and biases [out] in turn, with He's initialisation."""
    parameters = []
    for i, o in zip(widths[:-1], widths[1:], strict=True):
        parameters += [uniform_parameter((i, o), math.sqrt(6.0 / i), generator)]
        parameters += [nn.Parameter(torch.zeros(o))]
    return nn.ParameterList(parameters)


def weights_and_biases(parameters: nn.ParameterList) -> list[tuple[Tensor, Tensor]]:
    """Return the (weight, bias) of each layer."""
    return list(zip(parameters[::2], parameters[1::2], strict=True))
