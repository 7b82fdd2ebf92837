"""CPU kernels in Numba for single values and directions: radiance, density, harmonics.

The twins, and the choice between both, are in `field/activations.py` and
`field/spherical_harmonics.py`; they take a pass through memory for each operation. Numba calls the
system's `exp` and `pow` value by value. The short series here are plain arithmetic, which LLVM
vectorises. Arrays are float32 and C-contiguous.
"""

import numpy as np
from numba import njit, prange

from climatenerf.core.srgb import DISPLAY_TOE, EXPONENT, OFFSET, SCALE, TOE_SLOPE

SHARPNESS = 8.0  # of the softplus
MIN_SLOPE = 0.1  # of the softplus, for gradients that brighten
BLACK = -0.5  # input below which nothing darkens further: the display value is under 0.003
MAX_RAW = 15.0  # upper bound of the logarithm of a density: exp(15) is opaque at any step
# Without nnan: a fit that has diverged must show as NaN.
_FAST = {"contract", "reassoc", "arcp", "nsz"}
BLOCK = 2048  # values per task of a thread
LN2 = 0.6931471805599453
# exp2 over [-1/2, 1/2] by the series of exp; relative error 2e-7.
E1, E2, E3, E4, E5, E6 = (LN2**k / np.prod(np.arange(1.0, k + 1)) for k in range(1, 7))
L1, L3, L5, L7 = (2.0 / (k * LN2) for k in (1, 3, 5, 7))  # log2 by the series of atanh
P1, P3, P5, P7, P9, P11, P13 = (2.0 / (k * SHARPNESS) for k in range(1, 14, 2))  # softplus
# Slopes of `core.srgb`'s decoding curve: in its toe, and continued above 1.
SLOPE_IN_TOE, SLOPE_ABOVE = 1.0 / TOE_SLOPE, EXPONENT / SCALE


@njit(cache=True, fastmath=_FAST, inline="always")
def _exp2(y):
    """Return 2 to the power y, clamped to the range of normal float32 numbers."""
    y = min(max(y, np.float32(-126.0)), np.float32(126.0))
    whole = np.int32(np.floor(y + np.float32(0.5)))
    f = y - np.float32(whole)
    series = np.float32(E5) + f * np.float32(E6)
    series = np.float32(E3) + f * (np.float32(E4) + f * series)
    series = np.float32(1.0) + f * (np.float32(E1) + f * (np.float32(E2) + f * series))
    return series * np.int32((whole + np.int32(127)) << np.int32(23)).view(np.float32)


@njit(cache=True, fastmath=_FAST, inline="always")
def _log2(x):
    """Return the base-2 logarithm of a positive, normal float32."""
    bits = np.float32(x).view(np.int32)
    # Mantissas from sqrt(1/2) to sqrt(2): log2 is exactly 0 at 1, and accurate near it.
    whole = np.int32((bits - np.int32(0x3F3504F3)) >> np.int32(23))
    m = np.int32(bits - np.int32(whole << np.int32(23))).view(np.float32)
    s = (m - np.float32(1.0)) / (m + np.float32(1.0))
    square = s * s
    series = np.float32(L5) + square * np.float32(L7)
    series = np.float32(L1) + square * (np.float32(L3) + square * series)
    return np.float32(whole) + s * series


@njit(cache=True, fastmath=_FAST, inline="always")
def _display(x):
    """Return the softplus of x, and e^-|x·SHARPNESS|, which gives its slope."""
    e = _exp2(-abs(x) * np.float32(SHARPNESS / LN2))
    # log(1 + e) without the sum 1 + e, in which a small e would lose its digits.
    s = e / (np.float32(2.0) + e)
    square = s * s
    series = np.float32(P9) + square * (np.float32(P11) + square * np.float32(P13))
    series = np.float32(P5) + square * (np.float32(P7) + square * series)
    series = np.float32(P1) + square * (np.float32(P3) + square * series)
    return max(x, np.float32(0.0)) + s * series, e


@njit(cache=True, fastmath=_FAST, parallel=True)
def radiance_forward(raw, out):
    """Write the linear radiance of network outputs raw [n]."""
    n = raw.shape[0]
    for block in prange((n + BLOCK - 1) // BLOCK):
        for i in range(block * BLOCK, min(n, block * BLOCK + BLOCK)):
            x, _ = _display(raw[i] + np.float32(0.5))
            base = (max(x, np.float32(DISPLAY_TOE)) + np.float32(OFFSET)) * np.float32(1.0 / SCALE)
            value = _exp2(np.float32(EXPONENT) * _log2(base))
            if x > np.float32(1.0):
                value = np.float32(1.0) + (x - np.float32(1.0)) * np.float32(SLOPE_ABOVE)
            if x <= np.float32(DISPLAY_TOE):
                value = x * np.float32(SLOPE_IN_TOE)
            out[i] = value if raw[i] == raw[i] else raw[i]


@njit(cache=True, fastmath=_FAST, parallel=True)
def radiance_backward(raw, value, grad_out, grad):
    """Write the gradient to raw [n]; value [n] is the output of `radiance_forward`."""
    n = raw.shape[0]
    for block in prange((n + BLOCK - 1) // BLOCK):
        for i in range(block * BLOCK, min(n, block * BLOCK + BLOCK)):
            x, e = _display(raw[i] + np.float32(0.5))
            shifted = max(x, np.float32(DISPLAY_TOE)) + np.float32(OFFSET)
            decoding = np.float32(EXPONENT) * value[i] / shifted
            if x > np.float32(1.0):
                decoding = np.float32(SLOPE_ABOVE)
            if x <= np.float32(DISPLAY_TOE):
                decoding = np.float32(SLOPE_IN_TOE)
            product = grad_out[i] * decoding
            slope = np.float32(1.0) / (np.float32(1.0) + e)  # the sigmoid; below 0 e times it
            at = raw[i] + np.float32(0.5)
            if at < np.float32(0.0):
                slope *= e
            if product < np.float32(0.0):
                slope = max(slope, np.float32(MIN_SLOPE))
            elif at <= np.float32(BLACK):
                slope = np.float32(0.0)
            grad[i] = product * slope


@njit(cache=True, fastmath=_FAST, parallel=True)
def density_forward(raw, u, out):
    """Write the density (1/grid unit) of network outputs raw [n] at unit-cube u [n,3]."""
    n = raw.shape[0]
    for block in prange((n + BLOCK - 1) // BLOCK):
        for i in range(block * BLOCK, min(n, block * BLOCK + BLOCK)):
            square = np.float32(0.0)
            for axis in range(3):
                side = np.float32(4.0) * u[i, axis] - np.float32(2.0)
                square += side * side
            shell = np.float32(2.0) - np.sqrt(square)
            shell = min(max(shell, np.float32(1e-4)), np.float32(1.0))
            y = min(raw[i], np.float32(MAX_RAW)) * np.float32(1.0 / LN2)
            out[i] = _exp2(y) * shell * shell


@njit(cache=True, fastmath=_FAST, parallel=True)
def density_backward(raw, sigma, grad_out, grad):
    """Write the gradient to raw [n]; sigma [n] is the output of `density_forward`."""
    n = raw.shape[0]
    for block in prange((n + BLOCK - 1) // BLOCK):
        for i in range(block * BLOCK, min(n, block * BLOCK + BLOCK)):
            product = grad_out[i] * sigma[i]
            grad[i] = product if raw[i] <= np.float32(MAX_RAW) else np.float32(0.0)


@njit(cache=True, fastmath=_FAST, parallel=True)
def harmonics(d, out):
    """Write the 16 spherical harmonics of unit directions d [n,3] → out [16,n]."""
    n = d.shape[0]
    for block in prange((n + BLOCK - 1) // BLOCK):
        for i in range(block * BLOCK, min(n, block * BLOCK + BLOCK)):
            x, y, z = d[i, 0], d[i, 1], d[i, 2]
            xx, yy, zz = x * x, y * y, z * z
            five = np.float32(5.0) * zz
            out[0, i] = np.float32(0.28209479177387814)
            out[1, i] = np.float32(-0.48860251190291987) * y
            out[2, i] = np.float32(0.48860251190291987) * z
            out[3, i] = np.float32(-0.48860251190291987) * x
            out[4, i] = np.float32(1.0925484305920792) * x * y
            out[5, i] = np.float32(-1.0925484305920792) * y * z
            out[6, i] = np.float32(0.94617469575755997) * zz - np.float32(0.31539156525252005)
            out[7, i] = np.float32(-1.0925484305920792) * x * z
            out[8, i] = np.float32(0.54627421529603959) * (xx - yy)
            out[9, i] = np.float32(0.59004358992664352) * y * (yy - np.float32(3.0) * xx)
            out[10, i] = np.float32(2.8906114426405538) * x * y * z
            out[11, i] = np.float32(0.45704579946446572) * y * (np.float32(1.0) - five)
            out[12, i] = np.float32(0.3731763325901154) * z * (five - np.float32(3.0))
            out[13, i] = np.float32(0.45704579946446572) * x * (np.float32(1.0) - five)
            out[14, i] = np.float32(1.4453057213202769) * z * (xx - yy)
            out[15, i] = np.float32(0.59004358992664352) * x * (np.float32(3.0) * yy - xx)
