"""CPU kernels in Numba: small networks, forward and backward.

Their twin is `reference.mlp`. Features come in rows, [features, n] as the encoding leaves them, so
that vectors run over samples, whatever the layers' widths are. A block of samples and its hidden
layers stay in the first- and second-level cache, and the backward pass computes these again rather
than keep them.

All layers of a network lie in one row of numbers: of each its weights, [outputs, inputs] or turned
[inputs, outputs], and its biases. `widths` are the inputs and then each layer's outputs.
"""

import numpy as np
from numba import njit, prange

from climatenerf.ops.cpu import simd
from climatenerf.ops.cpu.simd import LANES

LANES_DIGEST = "eeeb3e1424f9"  # of `simd.py`, which explains why

BLOCK = 128  # samples at a time, some whole lanes: 64 hidden rows of them are 32 kB
CHUNK = 2048  # samples, about, that one thread takes at once and sums gradients over
FAINTEST = 1e-30  # of gradients that count, far below any that moves a weight


@njit(cache=True, fastmath=True)
def _take(rows, start, size, out):
    """Some samples of rows [k, n] → the first k rows of out [≥ k, BLOCK], 0 to the lanes' end."""
    end = (size + LANES - 1) // LANES * LANES
    for i in range(rows.shape[0]):
        out[i][:size] = rows[i][start : start + size]
        out[i][size:end] = 0.0


@njit(cache=True, fastmath=True)
def _rows_of(row, start, size, which):
    """The shared rows of a block's samples, the last one's to the lanes' end → which [BLOCK]."""
    for s in range(size):
        which[s] = row[start + s]
    which[size : (size + LANES - 1) // LANES * LANES] = row[start + size - 1]


@njit(cache=True, fastmath=True)
def _layer(weights, widths, layer, start):
    """A layer's weights [outputs, inputs] and biases, which begin at `start`; where it ends."""
    inputs, outputs = widths[layer], widths[layer + 1]
    middle = start + outputs * inputs
    return (
        weights[start:middle].reshape(outputs, inputs),
        weights[middle : middle + outputs],
        middle + outputs,
    )


@njit(cache=True, fastmath=True)
def _hidden_layers(rows, shared, which, weights, widths, size):
    """All hidden layers of a block of samples after their ReLU, one after the other.

    rows [inputs + 1 + hidden layers with a row of ones behind each, BLOCK] begin with the samples'
    features; shared [rays, hidden] is added to the first layer by `which` [BLOCK], or is empty.
    Returns where the last of them begins, and where the output layer's weights do.
    """
    count = (size + LANES - 1) // LANES
    first, start = 0, 0
    for layer in range(widths.shape[0] - 2):
        w, b, start = _layer(weights, widths, layer, start)
        below = rows[first : first + widths[layer]]
        first += widths[layer] + 1
        units = widths[layer + 1]
        own = rows[first : first + units]
        for m in range(units):
            own[m] = b[m]  # behind the block's end, too: what is there meets zeros
        if layer == 0 and shared.shape[0]:
            whole = units // LANES * LANES
            for point in range(0, size, LANES):
                for unit in range(0, whole, LANES):
                    simd.add_shared(own, shared, which, unit, point)
            for m in range(whole, units):
                for s in range(size):
                    own[m, s] += shared[which[s], m]
        simd.add_product(w, below, own, count)
        for m in range(units):
            line = own[m]
            for s in range(BLOCK):
                line[s] = max(line[s], np.float32(0.0))
    return first, start


@njit(cache=True, fastmath=True, parallel=True)
def network_forward(x, shared, row, weights, widths, out):
    """Layers with a ReLU between them: → out [outputs, n].

    Args: x [inputs, n]; weights [numbers], a unit's side by side, and widths [layers + 1]: see
    above; shared [rays, hidden] is added to the first layer by row [n], or is empty.
    """
    n, last = x.shape[1], widths.shape[0] - 2
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        rows = np.ones((widths[:-1].sum() + widths.shape[0] - 1, BLOCK), np.float32)
        own = np.empty((widths[-1], BLOCK), np.float32)
        which = np.zeros(BLOCK, np.int64)
        for start in range(chunk * CHUNK, min(n, chunk * CHUNK + CHUNK), BLOCK):
            size = min(BLOCK, n - start)
            _take(x, start, size, rows)
            if shared.shape[0]:
                _rows_of(row, start, size, which)
            first, at = _hidden_layers(rows, shared, which, weights, widths, size)
            w, b, _ = _layer(weights, widths, last, at)
            for o in range(own.shape[0]):
                own[o] = b[o]
            hidden = rows[first : first + widths[last]]
            simd.add_product(w, hidden, own, (size + LANES - 1) // LANES)
            out[:, start : start + size] = own[:, :size]


@njit(cache=True, fastmath=True, parallel=True)
def network_backward(given, weights, turned, widths, grad, borders, gradients):
    """Gradients of `network_forward`.

    Args: given = (x, shared, row), weights and widths as there; turned: the same weights the other
    way round, a layer's [inputs, outputs] and its biases; grad [outputs, n];
    borders [chunks + 1] of chunks of samples that share no ray with another.
    → gradients = (grad_x [inputs, n] or of no rows, grad_shared [rays, hidden] or of no rows, which
    is added to, sums [chunks, numbers]: of each layer [outputs, inputs + 1], with the bias in the
    last column).
    """
    x, shared, row = given
    grad_x, grad_shared, sums = gradients
    layers = widths.shape[0] - 1
    for chunk in prange(borders.shape[0] - 1):
        # Behind each layer's rows is one of ones: by it the biases' sums come with the weights'.
        rows = np.ones((widths[:-1].sum() + layers, BLOCK), np.float32)
        above = np.empty((widths.max(), BLOCK), np.float32)
        below = np.empty((widths.max(), BLOCK), np.float32)
        which = np.zeros(BLOCK, np.int64)
        for start in range(borders[chunk], borders[chunk + 1], BLOCK):
            size = min(BLOCK, borders[chunk + 1] - start)
            count = (size + LANES - 1) // LANES
            _take(x, start, size, rows)
            _take(grad, start, size, above)
            # Of light that hardly passes are gradients below what 32 bits hold in full: Intel's
            # processors take a hundred times as long for each product with one.
            for o in range(widths[layers]):
                line = above[o]
                for s in range(BLOCK):
                    line[s] = line[s] if abs(line[s]) > FAINTEST else np.float32(0.0)
            if shared.shape[0]:
                _rows_of(row, start, size, which)
            first, at = _hidden_layers(rows, shared, which, weights, widths, size)
            for layer in range(layers - 1, -1, -1):
                inputs, outputs = widths[layer], widths[layer + 1]
                total = outputs * (inputs + 1)  # numbers, with the biases
                own = sums[chunk, at : at + total].reshape(outputs, inputs + 1)
                simd.add_outer(above[:outputs], rows[first : first + inputs + 1], own, count)
                if layer or grad_x.shape[0]:
                    w = turned[at : at + inputs * outputs].reshape(inputs, outputs)
                    below[:inputs] = 0.0
                    simd.add_product(w, above[:outputs], below, count)
                if layer:
                    for m in range(inputs):
                        line, lit = below[m], rows[first + m]
                        for s in range(BLOCK):
                            line[s] = line[s] if lit[s] > 0 else np.float32(0.0)
                    above, below = below, above
                    first -= widths[layer - 1] + 1
                    at -= inputs * (widths[layer - 1] + 1)
                if layer == 1 and grad_shared.shape[0]:
                    _add_to_shared(above, which, inputs, size, grad_shared)
            if grad_x.shape[0]:
                grad_x[:, start : start + size] = below[: widths[0], :size]


@njit(cache=True, fastmath=True)
def _add_to_shared(grad, which, units, size, out):
    """Adds the first layer's gradient [units, BLOCK] to what samples share, out [rays, units]."""
    whole = units // LANES * LANES
    for point in range(0, size, LANES):
        for unit in range(0, whole, LANES):
            simd.add_to_shared(grad, out, which, unit, point)
    for m in range(whole, units):
        for s in range(size):
            out[which[s], m] += grad[m, s]


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
