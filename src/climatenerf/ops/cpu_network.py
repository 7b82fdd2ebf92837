"""CPU kernels in Numba: networks with one hidden layer, forward and backward.

Their twin is `reference.mlp`. Features come in rows, [features, n] as the encoding leaves them, so
that the innermost loops run over samples, which vectorises whatever the layers' widths are. A block
of samples and its hidden layer stay in the first- and second-level cache, and the backward pass
computes the hidden layer again rather than keep it.
"""

import numpy as np
from numba import njit, prange

BLOCK = 128  # samples at a time: 64 hidden rows of them are 32 kB
CHUNK = 2048  # samples, about, that one thread takes at once and sums gradients over


@njit(cache=True, fastmath=True, inline="always")
def _four(rows, i, first, size):
    """Samples of four rows; a single row's slice is known to be contiguous, so loops vectorise."""
    stop = first + size
    return (
        rows[i][first:stop],
        rows[i + 1][first:stop],
        rows[i + 2][first:stop],
        rows[i + 3][first:stop],
    )


@njit(cache=True, fastmath=True)
def _add_product(weight, rows, first, out, into, size):
    """out [m, into:into + size] += weight [m, k] @ rows [k, first:first + size].

    Two by four rows in one sweep over the samples: what is loaded is used twice.
    """
    k = rows.shape[0]
    whole = k // 4 * 4
    for m in range(0, out.shape[0] - 1, 2):
        own, next_ = out[m][into : into + size], out[m + 1][into : into + size]
        v, w = weight[m], weight[m + 1]
        for i in range(0, whole, 4):
            r0, r1, r2, r3 = _four(rows, i, first, size)
            v0, v1, v2, v3 = v[i], v[i + 1], v[i + 2], v[i + 3]
            w0, w1, w2, w3 = w[i], w[i + 1], w[i + 2], w[i + 3]
            for s in range(size):
                a0, a1, a2, a3 = r0[s], r1[s], r2[s], r3[s]
                own[s] += (v0 * a0 + v1 * a1) + (v2 * a2 + v3 * a3)
                next_[s] += (w0 * a0 + w1 * a1) + (w2 * a2 + w3 * a3)
        for i in range(whole, k):
            row = rows[i][first : first + size]
            for s in range(size):
                own[s] += v[i] * row[s]
                next_[s] += w[i] * row[s]
    if out.shape[0] % 2:
        own, v = out[-1][into : into + size], weight[-1]
        for i in range(0, whole, 4):
            r0, r1, r2, r3 = _four(rows, i, first, size)
            v0, v1, v2, v3 = v[i], v[i + 1], v[i + 2], v[i + 3]
            for s in range(size):
                own[s] += (v0 * r0[s] + v1 * r1[s]) + (v2 * r2[s] + v3 * r3[s])
        for i in range(whole, k):
            row = rows[i][first : first + size]
            for s in range(size):
                own[s] += v[i] * row[s]


@njit(cache=True, fastmath=True)
def _add_outer(left, from_left, right, from_right, out, size):
    """out [a, b] += left [a, from:from + size] @ right [b, from:from + size]ᵀ, two by four."""
    a, b = left.shape[0], right.shape[0]
    whole = b // 4 * 4
    for i in range(0, a - 1, 2):
        own = left[i][from_left : from_left + size]
        next_ = left[i + 1][from_left : from_left + size]
        for j in range(0, whole, 4):
            r0, r1, r2, r3 = _four(right, j, from_right, size)
            t0 = t1 = t2 = t3 = np.float32(0.0)
            u0 = u1 = u2 = u3 = np.float32(0.0)
            for s in range(size):
                x, y = own[s], next_[s]
                t0 += x * r0[s]
                t1 += x * r1[s]
                t2 += x * r2[s]
                t3 += x * r3[s]
                u0 += y * r0[s]
                u1 += y * r1[s]
                u2 += y * r2[s]
                u3 += y * r3[s]
            out[i, j] += t0
            out[i, j + 1] += t1
            out[i, j + 2] += t2
            out[i, j + 3] += t3
            out[i + 1, j] += u0
            out[i + 1, j + 1] += u1
            out[i + 1, j + 2] += u2
            out[i + 1, j + 3] += u3
        for j in range(whole, b):
            out[i, j] += _inner(own, right[j][from_right : from_right + size])
            out[i + 1, j] += _inner(next_, right[j][from_right : from_right + size])
    if a % 2:
        own = left[-1][from_left : from_left + size]
        for j in range(b):
            out[-1, j] += _inner(own, right[j][from_right : from_right + size])


@njit(cache=True, fastmath=True)
def _inner(a, b):
    """Inner product."""
    total = np.float32(0.0)
    for s in range(a.shape[0]):
        total += a[s] * b[s]
    return total


@njit(cache=True, fastmath=True)
def _hidden(x, shared, row, w1, b1, start, stop, hidden):
    """Fills hidden [h, ≥ stop - start] for some samples: the first layer after its ReLU."""
    size = stop - start
    if shared.shape[0]:
        # Samples of a ray lie side by side: each run of them is filled at once.
        begin = start
        while begin < stop:
            end = begin + 1
            while end < stop and row[end] == row[begin]:
                end += 1
            own = shared[row[begin]]
            for m in range(hidden.shape[0]):
                hidden[m, begin - start : end - start] = b1[m] + own[m]
            begin = end
    else:
        for m in range(hidden.shape[0]):
            hidden[m, :size] = b1[m]
    _add_product(w1, x, start, hidden, 0, size)
    for m in range(hidden.shape[0]):
        for s in range(size):
            hidden[m, s] = max(hidden[m, s], np.float32(0.0))


@njit(cache=True, fastmath=True, parallel=True)
def network_forward(x, shared, row, w1, b1, w2, b2, out):
    """One hidden layer with ReLU: → out [outputs, n].

    Args: x [inputs, n]; w1 [hidden, inputs], w2 [outputs, hidden]: transposed, so that a unit's
    weights lie side by side; shared [rays, hidden] is added to the first layer by row [n], or is
    empty.
    """
    n = x.shape[1]
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        hidden = np.empty((w1.shape[0], BLOCK), np.float32)
        own = np.empty((w2.shape[0], BLOCK), np.float32)
        for start in range(chunk * CHUNK, min(n, chunk * CHUNK + CHUNK), BLOCK):
            stop = min(start + BLOCK, n)
            _hidden(x, shared, row, w1, b1, start, stop, hidden)
            for o in range(own.shape[0]):
                own[o, : stop - start] = b2[o]
            _add_product(w2, hidden, 0, own, 0, stop - start)
            out[:, start:stop] = own[:, : stop - start]


@njit(cache=True, fastmath=True, parallel=True)
def network_backward(given, weights, turned, grad, borders, gradients):
    """Gradients of `network_forward`.

    Args: given = (x, shared, row) and weights = (w1, b1, w2) as there; turned = the same weights
    the other way round, (w1 [inputs, hidden], w2 [hidden, outputs]); grad [outputs, n];
    borders [chunks + 1] of chunks of samples that share no ray with another.
    → gradients = (grad_x [inputs, n] or of no rows, grad_shared [rays, hidden] or of no rows, which
    is added to, sums1 [chunks, hidden, inputs + 1], sums2 [chunks, outputs, hidden + 1]): sums of
    the weights', with the bias in the last column.
    """
    x, shared, row = given
    w1, b1, w2 = weights
    w1_in, w2_in = turned
    grad_x, grad_shared, sums1, sums2 = gradients
    for chunk in prange(borders.shape[0] - 1):
        hidden = np.empty((w1.shape[0], BLOCK), np.float32)
        back = np.empty((w1.shape[0], BLOCK), np.float32)
        for start in range(borders[chunk], borders[chunk + 1], BLOCK):
            stop = min(start + BLOCK, borders[chunk + 1])
            size = stop - start
            _hidden(x, shared, row, w1, b1, start, stop, hidden)
            _add_outer(grad, start, hidden, 0, sums2[chunk], size)
            back[:, :size] = 0.0
            _add_product(w2_in, grad, start, back, 0, size)
            for m in range(back.shape[0]):
                for s in range(size):
                    back[m, s] = back[m, s] if hidden[m, s] > 0 else np.float32(0.0)
            _add_outer(back, 0, x, start, sums1[chunk], size)
            for m in range(back.shape[0]):
                total = np.float32(0.0)
                for s in range(size):
                    total += back[m, s]
                sums1[chunk, m, -1] += total
            for o in range(grad.shape[0]):
                total = np.float32(0.0)
                for s in range(start, stop):
                    total += grad[o, s]
                sums2[chunk, o, -1] += total
            if grad_x.shape[0]:
                grad_x[:, start:stop] = 0.0
                _add_product(w1_in, back, 0, grad_x, start, size)
            if grad_shared.shape[0]:
                begin = start
                while begin < stop:
                    end = begin + 1
                    while end < stop and row[end] == row[begin]:
                        end += 1
                    for m in range(back.shape[0]):
                        total = np.float32(0.0)
                        for s in range(begin - start, end - start):
                            total += back[m, s]
                        grad_shared[row[begin], m] += total
                    begin = end


def chunk_borders(row: np.ndarray, n: int) -> np.ndarray:
    """Where chunks of about `CHUNK` samples begin and end, none within a ray.

    Rays that come again (row does not ascend) may be in any chunk, so then there is but one.
    """
    if (np.diff(row) < 0).any():
        return np.array([0, n])
    borders = np.append(np.arange(0, n, CHUNK), n)
    if row.shape[0]:
        borders[1:-1] = np.searchsorted(row, row[borders[1:-1]], side="right")
    return borders
