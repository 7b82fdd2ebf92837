"""The step of Adam for large tables whose gradients are mostly zero."""

import numpy as np
import torch
from torch import Tensor

from climatenerf.ops import dispatch


@torch.no_grad()
def adam(
    parameter: Tensor,
    gradient: Tensor,
    moments: tuple[Tensor, Tensor],
    rate: float,
    betas: tuple[float, float],
    epsilon: float,
    step: int,
) -> None:
    """Take one step of Adam (Kingma & Ba 2015) in place, and clear the gradient.

    Entries whose gradient is zero keep their value and moments.

    Raises:
        TypeError: the tensors are not float32 on one device, a CPU or an NVIDIA GPU.
    """
    kernels = dispatch.kernels("optimiser", parameter, gradient, *moments)
    if kernels is None:
        raise TypeError("a table and its moments must be float32 and on one device")
    corrections = (1.0 - beta**step for beta in betas)
    scalars = map(np.float32, (rate, *betas, epsilon, *corrections))
    flat = (each.view(-1) for each in (parameter, gradient, *moments))
    kernels.adam(*dispatch.kernel_arrays(*flat), *scalars)
