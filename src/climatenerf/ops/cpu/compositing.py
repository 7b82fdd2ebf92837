"""CPU kernels in Numba: compositing of packed samples along rays.

The slow twins in `ops/reference.py` are the specification. Rays are packed: the samples of ray r
are `offsets[r]:offsets[r + 1]`, front to back. Arrays are float32 and C-contiguous.
"""

import numpy as np
from numba import njit, prange


@njit(cache=True, parallel=True)
def weights_forward(tau, offsets, weights, transmittance):
    """Write rendering weights of samples with optical depths tau, and transmittance of rays."""
    for r in prange(offsets.shape[0] - 1):
        light = 1.0
        for i in range(offsets[r], offsets[r + 1]):
            passed = np.exp(-np.float64(tau[i]))  # float64: 1 - passed keeps its digits
            weights[i] = light * (1.0 - passed)
            light *= passed
        transmittance[r] = light


@njit(cache=True, parallel=True)
def weights_backward(tau, offsets, grad_w, grad_t, grad_tau):
    """Write the gradient of `weights_forward`.

    dw_i/dtau_i = T_{i+1}, dw_j/dtau_i = -w_j for j > i, dT/dtau_i = -T.
    """
    for r in prange(offsets.shape[0] - 1):
        light = 1.0
        for i in range(offsets[r], offsets[r + 1]):
            grad_tau[i] = light  # read again by the loop below
            light *= np.exp(-np.float64(tau[i]))
        behind = grad_t[r] * light
        for i in range(offsets[r + 1] - 1, offsets[r] - 1, -1):
            before = np.float64(grad_tau[i])
            grad_tau[i] = grad_w[i] * light - behind
            behind += grad_w[i] * before * (1.0 - np.exp(-np.float64(tau[i])))
            light = before


@njit(cache=True, parallel=True)
def accumulate_forward(weights, values, offsets, out):
    """Write the sum over each ray of weights [s] · values [c,s] → out [rays,c]."""
    for r in prange(offsets.shape[0] - 1):
        for c in range(values.shape[0]):
            total = 0.0
            for i in range(offsets[r], offsets[r + 1]):
                total += weights[i] * values[c, i]
            out[r, c] = total


@njit(cache=True, parallel=True)
def accumulate_backward(weights, values, offsets, grad_out, grad_w, grad_v):
    """Write the gradient of `accumulate_forward`."""
    for r in prange(offsets.shape[0] - 1):
        for i in range(offsets[r], offsets[r + 1]):
            total = 0.0
            for c in range(values.shape[0]):
                total += grad_out[r, c] * values[c, i]
                grad_v[c, i] = grad_out[r, c] * weights[i]
            grad_w[i] = total


@njit(cache=True, fastmath=True, inline="always")
def _unit(x, y, z):
    """Return the unit vector, the length, and the minimum that the length is clamped to."""
    min_length = np.float32(1e-6)
    length = max(np.sqrt(x * x + y * y + z * z), min_length)
    return x / length, y / length, z / length, length, min_length


@njit(cache=True, fastmath=True, parallel=True)
def surface_forward(weights, raw, target, offsets, logits, error):
    """Write weighted sums of the surface head's output along rays; see `reference.surface`.

    weights [s]; raw [3 + c, s]; target [s, 3], or [0, 3] → logits [rays, c], error [rays].
    """
    for r in prange(offsets.shape[0] - 1):
        first, last = offsets[r], offsets[r + 1]
        for c in range(logits.shape[1]):
            total = np.float32(0.0)
            for i in range(first, last):
                total += weights[i] * raw[3 + c, i]
            logits[r, c] = total
        total = np.float32(0.0)
        if target.shape[0]:
            for i in range(first, last):
                nx, ny, nz, _, _ = _unit(raw[0, i], raw[1, i], raw[2, i])
                nx, ny, nz = nx - target[i, 0], ny - target[i, 1], nz - target[i, 2]
                total += weights[i] * (nx * nx + ny * ny + nz * nz)
        error[r] = total


@njit(cache=True, fastmath=True, parallel=True)
def surface_backward(weights, raw, target, offsets, grad_logits, grad_error, grad_raw):
    """Write the gradient of `surface_forward` to raw."""
    for r in prange(offsets.shape[0] - 1):
        for i in range(offsets[r], offsets[r + 1]):
            for c in range(grad_logits.shape[1]):
                grad_raw[3 + c, i] = grad_logits[r, c] * weights[i]
            if not target.shape[0]:
                grad_raw[:3, i] = 0.0
                continue
            nx, ny, nz, length, min_length = _unit(raw[0, i], raw[1, i], raw[2, i])
            ex, ey, ez = nx - target[i, 0], ny - target[i, 1], nz - target[i, 2]
            # The gradient of a direction is perpendicular to it.
            along = nx * ex + ny * ey + nz * ez if length > min_length else np.float32(0.0)
            scale = np.float32(2.0) * grad_error[r] * weights[i] / length
            grad_raw[0, i] = scale * (ex - along * nx)
            grad_raw[1, i] = scale * (ey - along * ny)
            grad_raw[2, i] = scale * (ez - along * nz)


@njit(cache=True, parallel=True)
def distortion_forward(weights, s, ds, offsets, out):
    """Write the distortion of each ray in linear time (DVGOv2); see `reference.distortion`."""
    for r in prange(offsets.shape[0] - 1):
        total, w_sum, ws_sum = 0.0, 0.0, 0.0
        for i in range(offsets[r], offsets[r + 1]):
            total += 2.0 * weights[i] * (s[i] * w_sum - ws_sum)
            total += weights[i] * weights[i] * ds[i] / 3.0
            w_sum += weights[i]
            ws_sum += weights[i] * s[i]
        out[r] = total


@njit(cache=True, parallel=True)
def distortion_backward(weights, s, ds, offsets, grad_out, grad_w):
    """Write the gradient of `distortion_forward` to the weights."""
    for r in prange(offsets.shape[0] - 1):
        w_all, ws_all = 0.0, 0.0
        for i in range(offsets[r], offsets[r + 1]):
            w_all += weights[i]
            ws_all += weights[i] * s[i]
        w_sum, ws_sum = 0.0, 0.0
        for i in range(offsets[r], offsets[r + 1]):
            w, p = weights[i], s[i]
            before = p * w_sum - ws_sum
            w_sum += w
            ws_sum += w * p
            after = (ws_all - ws_sum) - p * (w_all - w_sum)
            grad_w[i] = grad_out[r] * (2.0 * (before + after) + 2.0 * w * ds[i] / 3.0)


@njit(cache=True, parallel=True)
def merge_order(t_a, offsets_a, t_b, offsets_b, offsets, order):
    """Write the order that merges two packed lists by t; indices ≥ len(t_a) are list b's."""
    shift = t_a.shape[0]
    for r in prange(offsets.shape[0] - 1):
        i, j = offsets_a[r], offsets_b[r]
        for k in range(offsets[r], offsets[r + 1]):
            if j >= offsets_b[r + 1] or (i < offsets_a[r + 1] and t_a[i] <= t_b[j]):
                order[k] = i
                i += 1
            else:
                order[k] = shift + j
                j += 1
