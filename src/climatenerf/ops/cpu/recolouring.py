"""CPU kernel in Numba: recolouring of samples by class. The slow twin is in `ops.recolouring`."""

import math

import numpy as np
from numba import njit, prange

from climatenerf.core.srgb import LUMA
from climatenerf.ops.recolouring import CONES, HUES, OKLAB, SATURATIONS

RED, GREEN, BLUE = (np.float32(each) for each in LUMA)
TO_CONES = np.array(CONES, np.float32)
TO_OKLAB = np.array(OKLAB, np.float32)
MIN_LIGHTNESS = np.float32(1e-6)  # lightness; black has no saturation, 0/0
UNCHANGED = np.float32(1e-7)  # share of a class below which its colours are not looked up


@njit(cache=True, inline="always")
def _smoothstep(x, low, high):
    u = min(max((x - low) / (high - low), np.float32(0.0)), np.float32(1.0))
    return u * u * (np.float32(3.0) - np.float32(2.0) * u)


@njit(cache=True, inline="always")
def _green(red, green, blue):
    """How green a colour is, from 0 to 1."""
    lightness, a, b = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for k in range(3):
        cone = TO_CONES[k, 0] * red + TO_CONES[k, 1] * green + TO_CONES[k, 2] * blue
        root = max(cone, np.float32(0.0)) ** np.float32(1.0 / 3.0)
        lightness += TO_OKLAB[0, k] * root
        a += TO_OKLAB[1, k] * root
        b += TO_OKLAB[2, k] * root
    saturation = math.sqrt(a * a + b * b) / max(lightness, MIN_LIGHTNESS)
    coloured = _smoothstep(saturation, SATURATIONS[0], SATURATIONS[1])
    if coloured == 0:
        return coloured
    hue = math.degrees(math.atan2(b, a)) % 360.0
    inside = _smoothstep(hue, HUES[0], HUES[1]) * (1 - _smoothstep(hue, HUES[2], HUES[3]))
    return coloured * inside


@njit(cache=True, inline="always")
def _noise_at(noise, x, scale):
    """Periodic noise at a position, trilinear; its first node is repeated at its end."""
    place = np.empty(3, np.float32)
    corner = np.empty(3, np.int64)
    for axis in range(3):
        nodes = noise.shape[2 - axis] - 1
        turns = x[axis] * scale
        at = np.float32((turns - math.floor(turns)) * nodes)
        corner[axis] = min(int(at), nodes - 1)
        place[axis] = at - corner[axis]
    total = np.float32(0.0)
    for k in range(8):
        a, b, c = k & 1, k >> 1 & 1, k >> 2 & 1
        weight = place[0] if a else 1 - place[0]
        weight *= place[1] if b else 1 - place[1]
        weight *= place[2] if c else 1 - place[2]
        total += weight * noise[corner[2] + c, corner[1] + b, corner[0] + a]
    return total


@njit(cache=True, parallel=True, fastmath=True)
def recolour(colour, logits, group, x, noise, frame, classes, palette, matrix, found):
    """Write the colours of samples in a style.

    `frame` has the white of the light and the turns of the noise per metre; `classes` the index,
    number of colours, strength and gate of each class.
    """
    index, count, strength, gate = classes
    for i in prange(colour.shape[0]):
        row = logits[group[i]]
        top = row[0]
        for each in row:
            top = max(top, each)
        total = np.float32(0.0)
        for each in row:
            total += math.exp(each - top)
        red, green, blue = colour[i, 0] / frame[0], colour[i, 1] / frame[1], colour[i, 2] / frame[2]
        luma = RED * red + GREEN * green + BLUE * blue
        leaf = _green(red, green, blue)
        place = np.float32(-1.0)
        new = red, green, blue
        for k in range(index.shape[0]):
            share = math.exp(row[index[k]] - top) / total * strength[k] * max(leaf, gate[k])
            if share < UNCHANGED:
                continue
            if place < 0:
                place = _noise_at(noise, x[i], frame[3])
            at = place * (count[k] - 1)
            low = min(int(at), max(count[k] - 2, 0))
            high = min(low + 1, count[k] - 1)
            part = at - low
            old = red, green, blue
            shown = np.empty(3, np.float32)
            for c in range(3):
                tint = palette[k, low, c] * (1 - part) + palette[k, high, c] * part
                kept = matrix[k, c, 0] * red + matrix[k, c, 1] * green + matrix[k, c, 2] * blue
                shown[c] = new[c] + share * (max(luma * tint + kept, 0.0) - old[c])
            new = shown[0], shown[1], shown[2]
        found[i, 0], found[i, 1], found[i, 2] = (
            new[0] * frame[0],
            new[1] * frame[1],
            new[2] * frame[2],
        )
