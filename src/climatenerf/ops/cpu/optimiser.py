"""CPU kernel in Numba: the step of Adam for tables whose gradients are mostly zero."""

import numpy as np
from numba import njit, prange

from climatenerf.ops.cpu import simd
from climatenerf.ops.cpu.simd import LANES

SIMD_DIGEST = "2210a987a87b"  # of `simd.py`, which explains why


@njit(cache=True, fastmath=True, parallel=True)
def adam(parameter, gradient, first, second, rate, beta1, beta2, epsilon, correction1, correction2):
    """Take one Adam step over flat arrays; entries without gradient stay as they are.

    Vectors of LANES entries without any gradient are skipped.
    """
    n, one = parameter.shape[0], np.float32(1.0)
    rates = (one - beta1, beta1, one - beta2, beta2, rate / correction1, one / correction2, epsilon)
    for block in prange((n + 4095) // 4096):
        end = min(n, block * 4096 + 4096)
        whole = end // LANES * LANES
        for start in range(block * 4096, whole, LANES):
            simd.adam(parameter, gradient, first, second, start, rates)
        for i in range(max(whole, block * 4096), end):
            g = gradient[i]
            if g != 0:
                first[i] = beta1 * first[i] + rates[0] * g
                second[i] = beta2 * second[i] + rates[2] * g * g
                parameter[i] -= rates[4] * first[i] / (np.sqrt(second[i] * rates[5]) + epsilon)
                gradient[i] = 0
