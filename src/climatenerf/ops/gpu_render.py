"""Whole rays on a GPU, one thread each: march, encode, both networks, composite, in one launch.

The twin is the composition of the operations (`Field.composited` on the CPU). Nothing is stored for
the samples, so memory does not grow with them. In Numba-CUDA, as `gpu.py`, whose march this shares.
"""

# Numba's stubs take kernels for plain Python.
# pyright: reportCallIssue=false, reportArgumentType=false, reportAttributeAccessIssue=false

import math

import numpy as np
from numba import cuda, float32

from climatenerf.ops.gpu import FEATURES, LEAST_TAU, _begin, _density, _encode, _next, launch

SHARPNESS = np.float32(8.0)  # of the softplus; see `field.field._to_radiance`

BRIGHT = np.float32(2.4 / 1.055)  # slope beyond white; see `field.colour_space.decode_srgb`


@cuda.jit(device=True)
def _radiance(raw):
    """Network output to linear radiance: softplus, then the display curve undone."""
    x = raw + np.float32(0.5)
    if SHARPNESS * x <= np.float32(20.0):  # beyond it is the identity, and exp would overflow
        x = math.log1p(math.exp(SHARPNESS * x)) / SHARPNESS
    if x <= np.float32(0.04045):
        return x / np.float32(12.92)
    if x > np.float32(1.0):
        return np.float32(1.0) + (x - np.float32(1.0)) * BRIGHT
    return ((x + np.float32(0.055)) / np.float32(1.055)) ** np.float32(2.4)


@cuda.jit(device=True)
def _colour(u, colours, shared, r, features, rgb):
    """Linear radiance at unit-cube u [3] on ray r, into rgb [3]."""
    table, resolutions, w1, b1, w2, b2 = colours
    for level in range(table.shape[0]):
        _encode(u[0], u[1], u[2], table, level, resolutions[level], features)
    for c in range(3):
        rgb[c] = b2[c]
    for j in range(w1.shape[1]):
        h = b1[j] + shared[r, j]
        for i in range(w1.shape[0]):
            h += features[i] * w1[i, j]
        if h > 0:
            for c in range(3):
                rgb[c] += h * w2[j, c]
    for c in range(3):
        rgb[c] = _radiance(rgb[c])


@cuda.jit
def _composite(rays, spans, cells, steps, limits, net, colours, shared, out):
    r = cuda.grid(1)
    if r >= spans.shape[0]:
        return
    o, d = cuda.local.array(3, float32), cuda.local.array(3, float32)
    u, span = cuda.local.array(3, float32), cuda.local.array(2, float32)
    place, features = cuda.local.array(4, float32), cuda.local.array(FEATURES, float32)
    rgb, total = cuda.local.array(3, float32), cuda.local.array(4, float32)
    for c in range(4):
        total[c] = np.float32(0.0)
    _begin(rays, r, spans, cells, steps, o, d, span)
    t, end = span[0], span[1]
    left, stop, least = np.float32(1.0), np.float32(limits[0]), np.float32(limits[1])
    tau, enough = np.float32(0.0), -math.log(stop)
    while tau < enough:
        t = _next(o, d, t, end, cells, steps, place)
        if t >= end:
            break
        dt = place[3]
        own = _density(place, net, u, features) * dt
        if own > LEAST_TAU:
            weight = left * -math.expm1(-own)
            tau += own
            left = math.exp(-tau)
            total[3] += weight * (t + np.float32(0.5) * dt)
            if weight > least:
                _colour(u, colours, shared, r, features, rgb)
                for c in range(3):
                    total[c] += weight * rgb[c]
        t += dt
    for c in range(4):
        out[r, c] = total[c]
    out[r, 4] = left


def composite(rays, spans, cells, steps, limits, net, colours, shared, out) -> None:
    """What rays see of matter: radiance, weighted sum of lengths, transmittance.

    Args: as `gpu.march`, but rays = (origins, directions); limits = (transmittance at which a ray
    ends, weight from which a sample has a colour); colours = (table, resolutions, w1, b1, w2, b2)
    of the appearance, to whose hidden layer shared [n,H] is added; out [n,5].
    """
    launch(_composite, spans.shape[0], rays, spans, cells, steps, limits, net, colours, shared,
           out)  # fmt: skip
