"""CPU kernels in Numba: networks with one hidden layer, forward and backward.

Their twin is `reference.mlp`. Features come in rows, [features, n] as the encoding leaves them, so
that vectors run over samples, whatever the layers' widths are. A block of samples and its hidden
layer stay in the first- and second-level cache, and the backward pass computes the hidden layer
again rather than keep it.
"""

import numpy as np
from numba import njit, prange

from climatenerf.ops import lanes
from climatenerf.ops.lanes import LANES

LANES_DIGEST = "867c92b329b6"  # of `lanes.py`, which says why

BLOCK = 128  # samples at a time, some whole lanes: 64 hidden rows of them are 32 kB
CHUNK = 2048  # samples, about, that one thread takes at once and sums gradients over


@njit(cache=True, fastmath=True)
def _take(rows, start, size, out):
    """Some samples of rows [k, n] → the first k rows of out [≥ k, BLOCK], 0 to the lanes' end."""
    end = (size + LANES - 1) // LANES * LANES
    for i in range(rows.shape[0]):
        out[i][:size] = rows[i][start : start + size]
        out[i][size:end] = 0.0


@njit(cache=True, fastmath=True)
def _hidden(x, shared, row, w1, b1, start, size, hidden):
    """The first layer after its ReLU of a block x [inputs, BLOCK] → first rows of hidden."""
    units = w1.shape[0]
    for m in range(units):
        hidden[m] = b1[m]  # behind the block's end, too: what is there meets zeros
    if shared.shape[0]:
        # Samples of a ray lie side by side: each run of them is filled at once.
        begin = start
        while begin < start + size:
            end = begin + 1
            while end < start + size and row[end] == row[begin]:
                end += 1
            own = shared[row[begin]]
            for m in range(units):
                hidden[m, begin - start : end - start] = b1[m] + own[m]
            begin = end
    lanes.add_product(w1, x, hidden, (size + LANES - 1) // LANES)
    for m in range(units):
        line = hidden[m]
        for s in range(BLOCK):
            line[s] = max(line[s], np.float32(0.0))


@njit(cache=True, fastmath=True, parallel=True)
def network_forward(x, shared, row, w1, b1, w2, b2, out):
    """One hidden layer with ReLU: → out [outputs, n].

    Args: x [inputs, n]; w1 [hidden, inputs], w2 [outputs, hidden]: transposed, so that a unit's
    weights lie side by side; shared [rays, hidden] is added to the first layer by row [n], or is
    empty.
    """
    n = x.shape[1]
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        given = np.empty((x.shape[0], BLOCK), np.float32)
        hidden = np.empty((w1.shape[0], BLOCK), np.float32)
        own = np.empty((w2.shape[0], BLOCK), np.float32)
        for start in range(chunk * CHUNK, min(n, chunk * CHUNK + CHUNK), BLOCK):
            size = min(BLOCK, n - start)
            _take(x, start, size, given)
            _hidden(given, shared, row, w1, b1, start, size, hidden)
            for o in range(own.shape[0]):
                own[o] = b2[o]
            lanes.add_product(w2, hidden, own, (size + LANES - 1) // LANES)
            out[:, start : start + size] = own[:, :size]


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
    units, inputs = w1.shape
    for chunk in prange(borders.shape[0] - 1):
        # The last rows are of ones: by them the biases' sums come with the weights'.
        own_x, hidden = (
            np.ones((inputs + 1, BLOCK), np.float32),
            np.ones((units + 1, BLOCK), np.float32),
        )
        own_grad = np.empty((grad.shape[0], BLOCK), np.float32)
        back, to_x = np.empty((units, BLOCK), np.float32), np.empty((inputs, BLOCK), np.float32)
        for start in range(borders[chunk], borders[chunk + 1], BLOCK):
            size = min(BLOCK, borders[chunk + 1] - start)
            count = (size + LANES - 1) // LANES
            _take(x, start, size, own_x)
            _take(grad, start, size, own_grad)
            _hidden(own_x, shared, row, w1, b1, start, size, hidden)
            lanes.add_outer(own_grad, hidden, sums2[chunk], count)
            back[:] = 0.0
            lanes.add_product(w2_in, own_grad, back, count)
            for m in range(units):
                line, lit = back[m], hidden[m]
                for s in range(BLOCK):
                    line[s] = line[s] if lit[s] > 0 else np.float32(0.0)
            lanes.add_outer(back, own_x, sums1[chunk], count)
            if grad_x.shape[0]:
                to_x[:] = 0.0
                lanes.add_product(w1_in, back, to_x, count)
                grad_x[:, start : start + size] = to_x[:, :size]
            if grad_shared.shape[0]:
                begin = start
                while begin < start + size:
                    end = begin + 1
                    while end < start + size and row[end] == row[begin]:
                        end += 1
                    for m in range(units):
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
