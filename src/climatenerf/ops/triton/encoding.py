"""What the GPU's kernels share: contraction, hash encoding, density. In Triton.

Samples lie along the first axis of a tile, levels of the encoding along the second, so that all
corners of all levels are on their way from memory at once. `reference.py` specifies it all. Without
a GPU Triton's interpreter runs the same code (TRITON_INTERPRET=1): so it is tested.

Kernels are compiled for SIZES: levels of the encoding, the same padded, hidden units padded, hidden
units; and, of networks whose outputs are not one density, outputs padded, outputs.
"""

# Triton's functions have no types that pyright could know.
# pyright: reportCallIssue=false, reportArgumentType=false, reportAttributeAccessIssue=false
# pyright: reportOperatorIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false

import triton
import triton.language as tl
from torch import Tensor

PRIME_Y = tl.constexpr(2654435761)
PRIME_Z = tl.constexpr(805459861)
# Products of three tensor-core passes come as near as single precision does.
EXACT = tl.constexpr("tf32x3")
FAST = tl.constexpr("tf32")  # one pass: 11 bits, enough for a colour that is shown in 8


@triton.jit
def points(u, tile, n, BLOCK: tl.constexpr):
    """The rows of u [n,3] in a tile: index, which there are, x, y, z."""
    i = tile.to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    some = i < n
    ux = tl.load(u + 3 * i, mask=some, other=0.0)
    uy = tl.load(u + 3 * i + 1, mask=some, other=0.0)
    return i, some, ux, uy, tl.load(u + 3 * i + 2, mask=some, other=0.0)


@triton.jit
def unit_cube(qx, qy, qz):
    """Contraction into the unit cube: its coordinates, and the distance from the centre."""
    m = tl.sqrt(qx * qx + qy * qy + qz * qz)
    s = 0.25 * tl.where(m <= 1.0, 1.0, (2.0 - 1.0 / m) / m)
    ux = tl.minimum(tl.maximum(qx * s + 0.5, 0.0), 0.999999)
    uy = tl.minimum(tl.maximum(qy * s + 0.5, 0.0), 0.999999)
    uz = tl.minimum(tl.maximum(qz * s + 0.5, 0.0), 0.999999)
    return ux, uy, uz, m


@triton.jit
def lattice(ux, uy, uz, resolutions, SIZES: tl.constexpr):
    """Cells of points on every level [samples, levels], places in them, cells a side."""
    LEVELS: tl.constexpr = SIZES[0]
    PADDED: tl.constexpr = SIZES[1]
    level = tl.arange(0, PADDED)
    resolution = tl.load(resolutions + level, mask=level < LEVELS, other=1)
    scale = resolution.to(tl.float32)[None, :]
    px, py, pz = ux[:, None] * scale, uy[:, None] * scale, uz[:, None] * scale
    ix, iy, iz = px.to(tl.int32), py.to(tl.int32), pz.to(tl.int32)
    place = px - ix.to(tl.float32), py - iy.to(tl.float32), pz - iz.to(tl.float32)
    return (ix.to(tl.uint32), iy.to(tl.uint32), iz.to(tl.uint32)), place, resolution


@triton.jit
def rows_of(cell, corner: tl.constexpr, resolution, size):
    """Table rows of one of the cells' eight corners, counted from the first level's first row.

    Bits 0 to 2 of `corner` say which side on x, y and z; direct where a level fits, else hashed.
    """
    x, y, z = cell[0] + (corner & 1), cell[1] + (corner >> 1 & 1), cell[2] + (corner >> 2)
    side = resolution + 1
    fits = side * side * side <= size
    side = side.to(tl.uint32)[None, :]
    hashed = (x ^ (y * PRIME_Y) ^ (z * PRIME_Z)) & (size - 1).to(tl.uint32)
    own = tl.where(fits[None, :], x + side * (y + side * z), hashed)
    return tl.arange(0, resolution.shape[0])[None, :].to(tl.int64) * size + own.to(tl.int64)


@triton.jit
def share_of(place, corner: tl.constexpr):
    """Weight of a corner for points at some place in their cells."""
    fx, fy, fz = place
    wx = fx if corner & 1 else 1.0 - fx
    wy = fy if corner >> 1 & 1 else 1.0 - fy
    wz = fz if corner >> 2 else 1.0 - fz
    return wx * wy * wz


@triton.jit
def pair_at(table, row, known):
    """Both features of table rows, in one read of 64 bits."""
    both = tl.load(table.to(tl.pointer_type(tl.int64), bitcast=True) + row, mask=known, other=0)
    first = both.to(tl.int32).to(tl.float32, bitcast=True)
    return first, (both >> 32).to(tl.int32).to(tl.float32, bitcast=True)


@triton.jit
def features_at(ux, uy, uz, some, encoding, SIZES: tl.constexpr):
    """Both features of every level [samples, levels]; 0 beyond the last and where not `some`."""
    table, resolutions, size = encoding
    cell, place, resolution = lattice(ux, uy, uz, resolutions, SIZES)
    known = some[:, None] & (tl.arange(0, SIZES[1]) < SIZES[0])[None, :]
    first, second = tl.zeros_like(place[0]), tl.zeros_like(place[0])
    for corner in tl.static_range(8):
        a, b = pair_at(table, rows_of(cell, corner, resolution, size), known)
        weight = share_of(place, corner)
        first += weight * a
        second += weight * b
    return first, second


@triton.jit
def first_layer(w1, b1, SIZES: tl.constexpr):
    """Weights of the first features [levels, hidden], of the second, and biases."""
    PADDED: tl.constexpr = SIZES[1]
    H: tl.constexpr = SIZES[2]
    HIDDEN: tl.constexpr = SIZES[3]
    level, unit = tl.arange(0, PADDED)[:, None], tl.arange(0, H)[None, :]
    known = (level < SIZES[0]) & (unit < HIDDEN)
    at = w1 + 2 * level * HIDDEN + unit
    even = tl.load(at, mask=known, other=0.0)
    odd = tl.load(at + HIDDEN, mask=known, other=0.0)
    bias = tl.load(b1 + tl.arange(0, H), mask=tl.arange(0, H) < HIDDEN, other=0.0)
    return even, odd, bias


@triton.jit
def hidden_of(first, second, layer, PRECISION: tl.constexpr):
    """The hidden layer before its ReLU [samples, hidden]."""
    even, odd, bias = layer
    h = tl.dot(first, even, input_precision=PRECISION)
    return tl.dot(second, odd, h, input_precision=PRECISION) + bias[None, :]


@triton.jit
def density_of(qx, qy, qz, some, encoding, layers, SIZES: tl.constexpr):
    """Density (1/grid unit) at positions in grid units, where `some`."""
    ux, uy, uz, m = unit_cube(qx, qy, qz)
    first, second = features_at(ux, uy, uz, some, encoding, SIZES)
    layer, w2, b2 = layers
    h = tl.maximum(hidden_of(first, second, layer, EXACT), 0.0)
    raw = tl.sum(h * w2[None, :], 1) + b2
    return tl.exp(tl.minimum(raw, 15.0)) / tl.maximum(m * m, 1.0)


@triton.jit
def density_layers(net, SIZES: tl.constexpr):
    """The density's network as `density_of` takes it, from (w1, b1, w2, b2) in memory."""
    w1, b1, w2, b2 = net
    layer = first_layer(w1, b1, SIZES)
    unit = tl.arange(0, SIZES[2])
    return layer, tl.load(w2 + unit, mask=unit < SIZES[3], other=0.0), tl.load(b2)


def padded(count: int) -> int:
    """A tile's width for so many levels or units: matrix products want a power of 2 from 16 on."""
    return max(16, 1 << (count - 1).bit_length())


def sizes_of(table: Tensor, w1: Tensor, w2: Tensor | None = None) -> tuple[int, ...]:
    """SIZES of an encoding and the network on it; with its second layer's where that is given."""
    levels, hidden = table.shape[0], w1.shape[1]
    own = levels, padded(levels), padded(hidden), hidden
    return own if w2 is None else (*own, padded(w2.shape[1]), w2.shape[1])


def over(kernel, count: int, block: int):
    """A kernel ready to be called for `count` items, `block` of them a program."""
    return kernel[(max(1, triton.cdiv(count, block)),)]
