"""What is worked out for each value or direction by itself: radiance, density, harmonics.

Their twins, and when they are asked, are in `field/activations.py` and
`field/spherical_harmonics.py`; these
take a pass through memory for every
operation. Numba calls the system's `exp` and `pow` value by value; the short series here are plain
arithmetic, of which LLVM makes vectors. Arrays are float32, C-contiguous.
"""

import numpy as np
from numba import njit, prange

SHARPNESS = 8.0  # of the softplus
MIN_SLOPE = 0.1  # upwards
BLACK = -0.5  # below it the display value is under .003, and nothing darkens further
LARGEST_RAW = 15.0  # logarithm of a density: beyond it a float32 would be infinite soon
# NaN keeps its meaning: what has diverged is to be seen.
_FAST = {"contract", "reassoc", "arcp", "nsz"}
BLOCK = 2048  # values that one thread takes at once
LN2 = 0.6931471805599453
# exp2 over [-1/2, 1/2]: the exponential's series, 2e-7 off.
E1, E2, E3, E4, E5, E6 = (LN2**k / np.prod(np.arange(1.0, k + 1)) for k in range(1, 7))
L1, L3, L5, L7 = (2.0 / (k * LN2) for k in (1, 3, 5, 7))  # log2 by atanh's series
P1, P3, P5, P7, P9, P11, P13 = (2.0 / (k * SHARPNESS) for k in range(1, 14, 2))  # softplus
TOE, TOE_SLOPE, ABOVE_SLOPE = 0.04045, 1.0 / 12.92, 2.4 / 1.055  # see `field.colour_space`


@njit(cache=True, fastmath=_FAST, inline="always")
def _exp2(y):
    """2 to the power of a float32, which is held within what one can be."""
    y = min(max(y, np.float32(-126.0)), np.float32(126.0))
    whole = np.int32(np.floor(y + np.float32(0.5)))
    f = y - np.float32(whole)
    series = np.float32(E5) + f * np.float32(E6)
    series = np.float32(E3) + f * (np.float32(E4) + f * series)
    series = np.float32(1.0) + f * (np.float32(E1) + f * (np.float32(E2) + f * series))
    return series * np.int32((whole + np.int32(127)) << np.int32(23)).view(np.float32)


@njit(cache=True, fastmath=_FAST, inline="always")
def _log2(x):
    """Logarithm of a positive, normal float32."""
    bits = np.float32(x).view(np.int32)
    # Mantissas from the root of a half to that of 2: log2 of 1 is 0, and small near it.
    whole = np.int32((bits - np.int32(0x3F3504F3)) >> np.int32(23))
    m = np.int32(bits - np.int32(whole << np.int32(23))).view(np.float32)
    s = (m - np.float32(1.0)) / (m + np.float32(1.0))
    square = s * s
    series = np.float32(L5) + square * np.float32(L7)
    series = np.float32(L1) + square * (np.float32(L3) + square * series)
    return np.float32(whole) + s * series


@njit(cache=True, fastmath=_FAST, inline="always")
def _display(x):
    """The softplus of x, and e^-|x·SHARPNESS|, of which its slope is made."""
    e = _exp2(-abs(x) * np.float32(SHARPNESS / LN2))
    # log(1 + e), without the sum in which a small e would lose its digits.
    s = e / (np.float32(2.0) + e)
    square = s * s
    series = np.float32(P9) + square * (np.float32(P11) + square * np.float32(P13))
    series = np.float32(P5) + square * (np.float32(P7) + square * series)
    series = np.float32(P1) + square * (np.float32(P3) + square * series)
    return max(x, np.float32(0.0)) + s * series, e


@njit(cache=True, fastmath=_FAST, parallel=True)
def radiance_forward(raw, out):
    """Linear radiance of network outputs raw [n]."""
    n = raw.shape[0]
    for block in prange((n + BLOCK - 1) // BLOCK):
        for i in range(block * BLOCK, min(n, block * BLOCK + BLOCK)):
            x, _ = _display(raw[i] + np.float32(0.5))
            base = (max(x, np.float32(TOE)) + np.float32(0.055)) * np.float32(1.0 / 1.055)
            value = _exp2(np.float32(2.4) * _log2(base))
            if x > np.float32(1.0):
                value = np.float32(1.0) + (x - np.float32(1.0)) * np.float32(ABOVE_SLOPE)
            if x <= np.float32(TOE):
                value = x * np.float32(TOE_SLOPE)
            out[i] = value if raw[i] == raw[i] else raw[i]


@njit(cache=True, fastmath=_FAST, parallel=True)
def radiance_backward(raw, value, grad_out, grad):
    """Gradient to raw [n]; `value` is what `radiance_forward` gave."""
    n = raw.shape[0]
    for block in prange((n + BLOCK - 1) // BLOCK):
        for i in range(block * BLOCK, min(n, block * BLOCK + BLOCK)):
            x, e = _display(raw[i] + np.float32(0.5))
            decoding = np.float32(2.4) * value[i] / (max(x, np.float32(TOE)) + np.float32(0.055))
            if x > np.float32(1.0):
                decoding = np.float32(ABOVE_SLOPE)
            if x <= np.float32(TOE):
                decoding = np.float32(TOE_SLOPE)
            own = grad_out[i] * decoding
            slope = np.float32(1.0) / (np.float32(1.0) + e)  # the sigmoid; from below e times it
            at = raw[i] + np.float32(0.5)
            if at < np.float32(0.0):
                slope *= e
            if own < np.float32(0.0):
                slope = max(slope, np.float32(MIN_SLOPE))
            elif at <= np.float32(BLACK):
                slope = np.float32(0.0)
            grad[i] = own * slope


@njit(cache=True, fastmath=_FAST, parallel=True)
def density_forward(raw, u, out):
    """Density (1/grid unit) of network outputs raw [n] at u [n,3]."""
    n = raw.shape[0]
    for block in prange((n + BLOCK - 1) // BLOCK):
        for i in range(block * BLOCK, min(n, block * BLOCK + BLOCK)):
            square = np.float32(0.0)
            for axis in range(3):
                side = np.float32(4.0) * u[i, axis] - np.float32(2.0)
                square += side * side
            shell = np.float32(2.0) - np.sqrt(square)
            shell = min(max(shell, np.float32(1e-4)), np.float32(1.0))
            y = min(raw[i], np.float32(LARGEST_RAW)) * np.float32(1.0 / LN2)
            out[i] = _exp2(y) * shell * shell


@njit(cache=True, fastmath=_FAST, parallel=True)
def density_backward(raw, sigma, grad_out, grad):
    """Gradient to raw [n]; `sigma` is what `density_forward` gave."""
    n = raw.shape[0]
    for block in prange((n + BLOCK - 1) // BLOCK):
        for i in range(block * BLOCK, min(n, block * BLOCK + BLOCK)):
            own = grad_out[i] * sigma[i]
            grad[i] = own if raw[i] <= np.float32(LARGEST_RAW) else np.float32(0.0)


@njit(cache=True, fastmath=_FAST, parallel=True)
def harmonics(d, out):
    """The 16 spherical harmonics of unit directions d [n,3] in rows, out [16,n]."""
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
