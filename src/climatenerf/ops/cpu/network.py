"""CPU kernels in Numba: small networks, forward and backward. The slow twin is `reference.mlp`.

Features are feature-major, [features, n], as the encoding writes them, so that vectors run over
samples whatever the widths of the layers are. A block of samples and its hidden layers stay in the
first- and second-level cache. The backward pass computes the hidden layers again.

All layers of a network lie in one flat array: for each its weights, [outputs, inputs] or transposed
[inputs, outputs], and its biases. `widths` holds the inputs and then the outputs of each layer.
"""

import numpy as np
from numba import njit, prange

from climatenerf.ops.cpu import simd
from climatenerf.ops.cpu.simd import LANES

SIMD_DIGEST = "2210a987a87b"  # of `simd.py`, which explains why

BLOCK = 128  # samples at a time, a multiple of LANES: 64 hidden rows of them take 32 kB
CHUNK = 2048  # about how many samples one task of a thread sums gradients over
MIN_GRADIENT = 1e-30  # smaller ones are flushed to zero; far below any that moves a weight


@njit(cache=True, fastmath=True)
def _take(rows, start, size, out):
    """Copy a block of rows [k, n] → first k rows of out [≥ k, BLOCK], padded with zeros."""
    end = (size + LANES - 1) // LANES * LANES
    for i in range(rows.shape[0]):
        out[i][:size] = rows[i][start : start + size]
        out[i][size:end] = 0.0


@njit(cache=True, fastmath=True)
def _rows_of(row, start, size, which):
    """Write the shared row of each sample of a block → which [BLOCK], the last repeated."""
    for s in range(size):
        which[s] = row[start + s]
    which[size : (size + LANES - 1) // LANES * LANES] = row[start + size - 1]


@njit(cache=True, fastmath=True)
def _layer(weights, widths, layer, start):
    """Return weights [outputs, inputs] and biases of the layer at `start`, and where it ends."""
    inputs, outputs = widths[layer], widths[layer + 1]
    middle = start + outputs * inputs
    return (
        weights[start:middle].reshape(outputs, inputs),
        weights[middle : middle + outputs],
        middle + outputs,
    )


@njit(cache=True, fastmath=True)
def _hidden_layers(rows, shared, which, weights, widths, size):
    """Write all hidden layers of a block of samples after their ReLU, one after the other.

    rows [inputs + 1 + hidden layers with a row of ones behind each, BLOCK] begin with the samples'
    features; shared [rays, hidden], or empty, is added to the first layer by `which` [BLOCK].
    Return the first row of the last hidden layer, and where the output layer's weights begin.
    """
    count = (size + LANES - 1) // LANES
    first, start = 0, 0
    for layer in range(widths.shape[0] - 2):
        w, b, start = _layer(weights, widths, layer, start)
        below = rows[first : first + widths[layer]]
        first += widths[layer] + 1
        units = widths[layer + 1]
        hidden = rows[first : first + units]
        for m in range(units):
            hidden[m] = b[m]  # also in the padding, whose gradients are zero
        if layer == 0 and shared.shape[0]:
            whole = units // LANES * LANES
            for point in range(0, size, LANES):
                for unit in range(0, whole, LANES):
                    simd.add_shared(hidden, shared, which, unit, point)
            for m in range(whole, units):
                for s in range(size):
                    hidden[m, s] += shared[which[s], m]
        simd.add_product(w, below, hidden, count)
        for m in range(units):
            line = hidden[m]
            for s in range(BLOCK):
                line[s] = max(line[s], np.float32(0.0))
    return first, start


@njit(cache=True, fastmath=True, parallel=True)
def network_forward(x, shared, row, weights, widths, out):
    """Write the outputs of layers with a ReLU between them → out [outputs, n].

    Args:
        x: [inputs, n].
        shared: [rays, hidden], added to the first layer by row; or empty.
        row: [n], the row of `shared` for each sample.
        weights, widths: see the module; weights are [outputs, inputs].
    """
    n, last = x.shape[1], widths.shape[0] - 2
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        rows = np.ones((widths[:-1].sum() + widths.shape[0] - 1, BLOCK), np.float32)
        result = np.empty((widths[-1], BLOCK), np.float32)
        which = np.zeros(BLOCK, np.int64)
        for start in range(chunk * CHUNK, min(n, chunk * CHUNK + CHUNK), BLOCK):
            size = min(BLOCK, n - start)
            _take(x, start, size, rows)
            if shared.shape[0]:
                _rows_of(row, start, size, which)
            first, at = _hidden_layers(rows, shared, which, weights, widths, size)
            w, b, _ = _layer(weights, widths, last, at)
            for o in range(result.shape[0]):
                result[o] = b[o]
            hidden = rows[first : first + widths[last]]
            simd.add_product(w, hidden, result, (size + LANES - 1) // LANES)
            out[:, start : start + size] = result[:, :size]


@njit(cache=True, fastmath=True, parallel=True)
def network_backward(inputs, weights, transposed, widths, grad, chunks, gradients):
    """Write the gradients of `network_forward`.

    Args:
        inputs: (x, shared, row), as there.
        weights, widths: as there.
        transposed: the same weights as [inputs, outputs].
        grad: [outputs, n].
        chunks: [chunks + 1], bounds of chunks of samples; no two chunks share a ray.
        gradients: (grad_x [inputs, n] or without rows; grad_shared [rays, hidden] or without rows,
            which is added to; sums [chunks, all weights], of each layer [outputs, inputs + 1] with
            the bias in the last column).
    """
    x, shared, row = inputs
    grad_x, grad_shared, sums = gradients
    layers = widths.shape[0] - 1
    for chunk in prange(chunks.shape[0] - 1):
        # A row of ones behind each layer makes the gradients of biases part of those of weights.
        rows = np.ones((widths[:-1].sum() + layers, BLOCK), np.float32)
        above = np.empty((widths.max(), BLOCK), np.float32)
        below = np.empty((widths.max(), BLOCK), np.float32)
        which = np.zeros(BLOCK, np.int64)
        for start in range(chunks[chunk], chunks[chunk + 1], BLOCK):
            size = min(BLOCK, chunks[chunk + 1] - start)
            count = (size + LANES - 1) // LANES
            _take(x, start, size, rows)
            _take(grad, start, size, above)
            # Samples behind almost opaque ones have denormal gradients: Intel's processors take a
            # hundred times as long for each product with one.
            for o in range(widths[layers]):
                line = above[o]
                for s in range(BLOCK):
                    line[s] = line[s] if abs(line[s]) > MIN_GRADIENT else np.float32(0.0)
            if shared.shape[0]:
                _rows_of(row, start, size, which)
            first, at = _hidden_layers(rows, shared, which, weights, widths, size)
            for layer in range(layers - 1, -1, -1):
                n_in, n_out = widths[layer], widths[layer + 1]
                total = n_out * (n_in + 1)  # weights and biases
                layer_sums = sums[chunk, at : at + total].reshape(n_out, n_in + 1)
                simd.add_outer(above[:n_out], rows[first : first + n_in + 1], layer_sums, count)
                if layer or grad_x.shape[0]:
                    w = transposed[at : at + n_in * n_out].reshape(n_in, n_out)
                    below[:n_in] = 0.0
                    simd.add_product(w, above[:n_out], below, count)
                if layer:
                    for m in range(n_in):
                        line, active = below[m], rows[first + m]
                        for s in range(BLOCK):
                            line[s] = line[s] if active[s] > 0 else np.float32(0.0)
                    above, below = below, above
                    first -= widths[layer - 1] + 1
                    at -= n_in * (widths[layer - 1] + 1)
                if layer == 1 and grad_shared.shape[0]:
                    _add_to_shared(above, which, n_in, size, grad_shared)
            if grad_x.shape[0]:
                grad_x[:, start : start + size] = below[: widths[0], :size]


@njit(cache=True, fastmath=True)
def _add_to_shared(grad, which, units, size, out):
    """Add the first layer's gradient [units, BLOCK] to the shared rows, out [rays, units]."""
    whole = units // LANES * LANES
    for point in range(0, size, LANES):
        for unit in range(0, whole, LANES):
            simd.add_to_shared(grad, out, which, unit, point)
    for m in range(whole, units):
        for s in range(size):
            out[which[s], m] += grad[m, s]


def chunk_bounds(row: np.ndarray, n: int) -> np.ndarray:
    """Return the bounds of chunks of about `CHUNK` samples; no ray is split between two.

    Where `row` does not ascend a ray may occur in any chunk, so that there is only one.
    """
    if (np.diff(row) < 0).any():
        return np.array([0, n])
    chunks = np.append(np.arange(0, n, CHUNK), n)
    if row.shape[0]:
        chunks[1:-1] = np.searchsorted(row, row[chunks[1:-1]], side="right")
    return chunks
