"""CPU kernels in Numba: multi-resolution hash encoding.

The slow twin `reference.hash_encode` is the specification. Arrays are float32 and C-contiguous.
"""

import numpy as np
from numba import get_num_threads, njit, prange

from climatenerf.ops.cpu import simd
from climatenerf.ops.cpu.simd import LANES

LANES_DIGEST = "eeeb3e1424f9"  # of `simd.py`, which explains why

BLOCK = 256  # points that one thread takes at once
AHEAD = 2 * LANES  # points by which a table's rows are asked for before they are read
ENCODED = 2**16  # the same, at most, where levels come one by one


@njit(cache=True, fastmath=True, parallel=True)
def _hash_encode(u, table, resolutions, out, threads):
    n = u.shape[0]
    each = -(-n // threads)
    size = min(ENCODED, -(-max(each, 1) // LANES) * LANES)
    for block in prange((n + size - 1) // size):
        places = np.zeros((3, LANES), np.float32)
        features, ahead = np.empty((2, LANES), np.float32), np.zeros((3, LANES), np.float32)
        end = min(n, block * size + size)
        for level in range(table.shape[0]):
            far = simd.is_far(table, resolutions[level])
            for start in range(block * size, end, LANES):
                count = min(LANES, n - start)
                if far:
                    for k in range(min(LANES, end - start - AHEAD)):
                        for axis in range(3):
                            ahead[axis, k] = u[start + AHEAD + k, axis]
                    simd.touch(ahead, table, level, resolutions[level])
                for k in range(count):
                    for axis in range(3):
                        places[axis, k] = u[start + k, axis]
                simd.look_up(places, table, level, resolutions[level], features, 0)
                for k in range(count):
                    out[2 * level, start + k] = features[0, k]
                    out[2 * level + 1, start + k] = features[1, k]


@njit(cache=True, fastmath=True, parallel=True)
def _hash_encode_backward(u, grad_out, resolutions, grad_table, threads):
    n = u.shape[0]
    for part in prange(threads):
        places, grad = np.zeros((3, LANES), np.float32), np.zeros((2, LANES), np.float32)
        ahead = np.zeros((3, LANES), np.float32)
        for level in range(part, grad_table.shape[0], threads):
            far = simd.is_far(grad_table, resolutions[level])
            for start in range(0, n, LANES):
                count = min(LANES, n - start)
                if far:
                    for k in range(min(LANES, n - start - AHEAD)):
                        for axis in range(3):
                            ahead[axis, k] = u[start + AHEAD + k, axis]
                    simd.touch(ahead, grad_table, level, resolutions[level])
                some = np.float32(0.0)
                grad[:] = 0.0
                for k in range(count):
                    for axis in range(3):
                        places[axis, k] = u[start + k, axis]
                    for feature in range(2):
                        grad[feature, k] = grad_out[2 * level + feature, start + k]
                        some += abs(grad[feature, k])
                if some != np.float32(0.0):
                    simd.spread(places, grad, grad_table, level, resolutions[level])


def hash_encode(u, table, resolutions, out):
    """Features of n points: u [n,3] in [0,1), table [L,T,2] → out [2L,n] (feature-major).

    A thread takes its points through one level after the other: most of a large table is read, and
    it is read once.
    """
    _hash_encode(u, table, resolutions, out, get_num_threads())


def hash_encode_backward(u, grad_out, resolutions, grad_table):
    """Adds the gradient of `hash_encode` to grad_table [L,T,2].

    One thread owns a level, so no two threads write to one row and the sum's order is fixed. Fine
    levels take longest, so each thread has some of all kinds.
    """
    _hash_encode_backward(u, grad_out, resolutions, grad_table, get_num_threads())


@njit(cache=True, fastmath=True, parallel=True)
def hash_encode_slopes(u, grad_out, table, resolutions, grad_u):
    """Gradient of `hash_encode` to the positions: grad_out [2L,n] → grad_u [n,3].

    A trilinear cell's slope along an axis is the difference of its two faces.
    """
    n = u.shape[0]
    for block in prange((n + BLOCK - 1) // BLOCK):
        places, found = np.zeros((3, LANES), np.float32), np.empty((8, LANES), np.float32)
        first, last = block * BLOCK, min(n, block * BLOCK + BLOCK)
        grad_u[first:last] = 0.0
        for level in range(table.shape[0]):
            for start in range(first, last, LANES):
                count = min(LANES, n - start)
                for k in range(count):
                    for axis in range(3):
                        places[axis, k] = u[start + k, axis]
                simd.look_up_slopes(places, table, level, resolutions[level], found, 0, 2)
                for k in range(count):
                    ga, gb = grad_out[2 * level, start + k], grad_out[2 * level + 1, start + k]
                    for axis in range(3):
                        grad_u[start + k, axis] += ga * found[2 + axis, k] + gb * found[5 + axis, k]
