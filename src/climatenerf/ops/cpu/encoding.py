"""CPU kernels in Numba: multi-resolution hash encoding.

The slow twin `reference.hash_encode` is the specification. Arrays are float32 and C-contiguous.
"""

import numpy as np
from numba import get_num_threads, njit, prange

from climatenerf.ops.cpu import simd
from climatenerf.ops.cpu.simd import LANES

SIMD_DIGEST = "2210a987a87b"  # of `simd.py`, which explains why

BLOCK = 256  # points per task of a thread
PREFETCH = 2 * LANES  # points between the prefetch of a table's rows and their use
MAX_BLOCK = 2**16  # points per task, at most, where a task goes through level after level


@njit(cache=True, fastmath=True, parallel=True)
def _hash_encode(u, table, resolutions, out, threads):
    n = u.shape[0]
    per_thread = -(-n // threads)
    size = min(MAX_BLOCK, -(-max(per_thread, 1) // LANES) * LANES)
    for block in prange((n + size - 1) // size):
        points = np.zeros((3, LANES), np.float32)
        features, ahead = np.empty((2, LANES), np.float32), np.zeros((3, LANES), np.float32)
        end = min(n, block * size + size)
        for level in range(table.shape[0]):
            prefetched = simd.exceeds_cache(table, resolutions[level])
            for start in range(block * size, end, LANES):
                count = min(LANES, n - start)
                if prefetched:
                    for k in range(min(LANES, end - start - PREFETCH)):
                        for axis in range(3):
                            ahead[axis, k] = u[start + PREFETCH + k, axis]
                    simd.prefetch(ahead, table, level, resolutions[level])
                for k in range(count):
                    for axis in range(3):
                        points[axis, k] = u[start + k, axis]
                simd.look_up(points, table, level, resolutions[level], features, 0)
                for k in range(count):
                    out[2 * level, start + k] = features[0, k]
                    out[2 * level + 1, start + k] = features[1, k]


@njit(cache=True, fastmath=True, parallel=True)
def _hash_encode_backward(u, grad_out, resolutions, grad_table, threads):
    n = u.shape[0]
    for thread in prange(threads):
        points, grad = np.zeros((3, LANES), np.float32), np.zeros((2, LANES), np.float32)
        ahead = np.zeros((3, LANES), np.float32)
        for level in range(thread, grad_table.shape[0], threads):
            prefetched = simd.exceeds_cache(grad_table, resolutions[level])
            for start in range(0, n, LANES):
                count = min(LANES, n - start)
                if prefetched:
                    for k in range(min(LANES, n - start - PREFETCH)):
                        for axis in range(3):
                            ahead[axis, k] = u[start + PREFETCH + k, axis]
                    simd.prefetch(ahead, grad_table, level, resolutions[level])
                magnitude = np.float32(0.0)
                grad[:] = 0.0
                for k in range(count):
                    for axis in range(3):
                        points[axis, k] = u[start + k, axis]
                    for feature in range(2):
                        grad[feature, k] = grad_out[2 * level + feature, start + k]
                        magnitude += abs(grad[feature, k])
                if magnitude != np.float32(0.0):
                    simd.scatter(points, grad, grad_table, level, resolutions[level])


def hash_encode(u, table, resolutions, out):
    """Write the features of n points: u [n,3] in [0,1), table [L,T,2] → out [2L,n].

    A thread takes its points through one level after the other, so that it reads a large table
    once.
    """
    _hash_encode(u, table, resolutions, out, get_num_threads())


def hash_encode_backward(u, grad_out, resolutions, grad_table):
    """Add the gradient of `hash_encode` to grad_table [L,T,2].

    One thread owns a level: no two threads write to one row, and the order of the sum is fixed.
    Fine levels take longest, so each thread owns both coarse and fine ones.
    """
    _hash_encode_backward(u, grad_out, resolutions, grad_table, get_num_threads())


@njit(cache=True, fastmath=True, parallel=True)
def hash_encode_slopes(u, grad_out, table, resolutions, grad_u):
    """Write the gradient of `hash_encode` to the positions: grad_out [2L,n] → grad_u [n,3].

    The slope of a trilinear cell along an axis is the difference between two faces.
    """
    n = u.shape[0]
    for block in prange((n + BLOCK - 1) // BLOCK):
        points, slopes = np.zeros((3, LANES), np.float32), np.empty((8, LANES), np.float32)
        first, last = block * BLOCK, min(n, block * BLOCK + BLOCK)
        grad_u[first:last] = 0.0
        for level in range(table.shape[0]):
            for start in range(first, last, LANES):
                count = min(LANES, n - start)
                for k in range(count):
                    for axis in range(3):
                        points[axis, k] = u[start + k, axis]
                simd.look_up_slopes(points, table, level, resolutions[level], slopes, 0, 2)
                for k in range(count):
                    ga, gb = grad_out[2 * level, start + k], grad_out[2 * level + 1, start + k]
                    for axis in range(3):
                        grad_u[start + k, axis] += (
                            ga * slopes[2 + axis, k] + gb * slopes[5 + axis, k]
                        )
