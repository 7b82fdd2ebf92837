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
    """One step of Adam (Kingma & Ba 2015) in place, for tables whose gradients are mostly zero.

    Entries without gradient are left alone with their moments; the gradient is cleared.
    """
    kernels = dispatch.kernels("optimiser", parameter, gradient, *moments)
    if kernels is None:
        raise TypeError("a table and its moments must be of 32 bits and on one device")
    corrections = (1.0 - beta**step for beta in betas)
    scalars = map(np.float32, (rate, *betas, epsilon, *corrections))
    kernels.adam(
        *(dispatch.kernel_array(each.view(-1)) for each in (parameter, gradient, *moments)),
        *scalars,
    )
