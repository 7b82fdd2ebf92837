"""GPU kernels in Triton: multi-resolution hash encoding. The twin is `reference.hash_encode`.

Samples lie along the first axis of a tile and levels of the encoding along the second, so that the
loads of all corners of all levels are in flight at once.

Kernels are compiled for SIZES: levels of the encoding, levels padded, hidden units padded, hidden
units; and, for networks with more than one output, outputs padded, outputs.
"""

# pyright cannot know the types of Triton's functions.
# pyright: reportCallIssue=false, reportArgumentType=false, reportAttributeAccessIssue=false
# pyright: reportOperatorIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOptionalSubscript=false

import triton
import triton.language as tl
from torch import Tensor

from climatenerf.ops.triton.tiles import launch, padded, points

SAMPLES = 64  # per tile
PRIME_Y = tl.constexpr(2654435761)
PRIME_Z = tl.constexpr(805459861)


@triton.jit
def lattice(ux, uy, uz, resolutions, SIZES: tl.constexpr):
    """Return the points' cells on every level [samples, levels], fractions in them, resolutions."""
    LEVELS: tl.constexpr = SIZES[0]
    PADDED: tl.constexpr = SIZES[1]
    level = tl.arange(0, PADDED)
    resolution = tl.load(resolutions + level, mask=level < LEVELS, other=1)
    scale = resolution.to(tl.float32)[None, :]
    px, py, pz = ux[:, None] * scale, uy[:, None] * scale, uz[:, None] * scale
    ix, iy, iz = px.to(tl.int32), py.to(tl.int32), pz.to(tl.int32)
    fraction = px - ix.to(tl.float32), py - iy.to(tl.float32), pz - iz.to(tl.float32)
    return (ix.to(tl.uint32), iy.to(tl.uint32), iz.to(tl.uint32)), fraction, resolution


@triton.jit
def rows_of(cell, corner: tl.constexpr, resolution, size):
    """Return the table rows of one of the cells' eight corners, from the first level's first row.

    Bits 0 to 2 of `corner` are the side on x, y and z. Levels that fit the table are not hashed.
    """
    x, y, z = cell[0] + (corner & 1), cell[1] + (corner >> 1 & 1), cell[2] + (corner >> 2)
    side = resolution + 1
    fits = side * side * side <= size
    side = side.to(tl.uint32)[None, :]
    hashed = (x ^ (y * PRIME_Y) ^ (z * PRIME_Z)) & (size - 1).to(tl.uint32)
    row = tl.where(fits[None, :], x + side * (y + side * z), hashed)
    return tl.arange(0, resolution.shape[0])[None, :].to(tl.int64) * size + row.to(tl.int64)


@triton.jit
def corner_weight(fraction, corner: tl.constexpr):
    """Return the trilinear weight of a corner for points at fractions of their cells."""
    fx, fy, fz = fraction
    wx = fx if corner & 1 else 1.0 - fx
    wy = fy if corner >> 1 & 1 else 1.0 - fy
    wz = fz if corner >> 2 else 1.0 - fz
    return wx * wy * wz


@triton.jit
def pair_at(table, row, mask):
    """Load both features of table rows in one read of 64 bits."""
    both = tl.load(table.to(tl.pointer_type(tl.int64), bitcast=True) + row, mask=mask, other=0)
    first = both.to(tl.int32).to(tl.float32, bitcast=True)
    return first, (both >> 32).to(tl.int32).to(tl.float32, bitcast=True)


@triton.jit
def features_at(ux, uy, uz, valid, encoding, SIZES: tl.constexpr):
    """Return both features of every level [samples, levels]; 0 where not `valid`."""
    table, resolutions, size = encoding
    cell, fraction, resolution = lattice(ux, uy, uz, resolutions, SIZES)
    mask = valid[:, None] & (tl.arange(0, SIZES[1]) < SIZES[0])[None, :]
    first, second = tl.zeros_like(fraction[0]), tl.zeros_like(fraction[0])
    for corner in tl.static_range(8):
        a, b = pair_at(table, rows_of(cell, corner, resolution, size), mask)
        weight = corner_weight(fraction, corner)
        first += weight * a
        second += weight * b
    return first, second


@triton.jit
def feature_pointers(features, i, n, valid, SIZES: tl.constexpr):
    """Return pointers to the first and second features of samples in [2L,n], and a mask."""
    level = tl.arange(0, SIZES[1])[None, :].to(tl.int64)
    first = features + 2 * level * n + i[:, None]
    return first, first + n, valid[:, None] & (level < SIZES[0])


@triton.jit(do_not_specialize=["n"])
def _hash_encode(u, encoding, out, n, SIZES: tl.constexpr, BLOCK: tl.constexpr):
    i, valid, ux, uy, uz = points(u, tl.program_id(0), n, BLOCK)
    first, second = features_at(ux, uy, uz, valid, encoding, SIZES)
    at_first, at_second, mask = feature_pointers(out, i, n, valid, SIZES)
    tl.store(at_first, first, mask=mask)
    tl.store(at_second, second, mask=mask)


def hash_encode(u: Tensor, table: Tensor, resolutions: Tensor, out: Tensor) -> None:
    """Write the features of n points: u [n,3] in [0,1), table [L,T,2] → out [2L,n]."""
    n, levels, size = u.shape[0], table.shape[0], table.shape[1]
    encoding = table, resolutions, size
    launch(_hash_encode, n, SAMPLES)(
        u, encoding, out, n, SIZES=(levels, padded(levels)), BLOCK=SAMPLES
    )


@triton.jit(do_not_specialize=["n"])
def _hash_encode_backward(u, grad_out, encoding, n, SIZES: tl.constexpr, BLOCK: tl.constexpr):
    grad_table, resolutions, size = encoding
    i, valid, ux, uy, uz = points(u, tl.program_id(0), n, BLOCK)
    at_first, at_second, mask = feature_pointers(grad_out, i, n, valid, SIZES)
    first = tl.load(at_first, mask=mask, other=0.0)
    second = tl.load(at_second, mask=mask, other=0.0)
    scatter(first, second, ux, uy, uz, mask, grad_table, resolutions, size, SIZES)


@triton.jit
def scatter(first, second, ux, uy, uz, mask, grad_table, resolutions, size, SIZES: tl.constexpr):
    """Add gradients of both features [samples, levels] to the table's gradient."""
    cell, fraction, resolution = lattice(ux, uy, uz, resolutions, SIZES)
    mask = mask & ((first != 0.0) | (second != 0.0))
    for corner in tl.static_range(8):
        at = grad_table + 2 * rows_of(cell, corner, resolution, size)
        weight = corner_weight(fraction, corner)
        tl.atomic_add(at, weight * first, mask=mask, sem="relaxed")
        tl.atomic_add(at + 1, weight * second, mask=mask, sem="relaxed")


def hash_encode_backward(
    u: Tensor, grad_out: Tensor, resolutions: Tensor, grad_table: Tensor
) -> None:
    """Add the gradient of `hash_encode` to grad_table [L,T,2]; the order of the sum varies."""
    n, levels, size = u.shape[0], grad_table.shape[0], grad_table.shape[1]
    encoding = grad_table, resolutions, size
    launch(_hash_encode_backward, n, SAMPLES)(
        u, grad_out, encoding, n, SIZES=(levels, padded(levels)), BLOCK=SAMPLES
    )


@triton.jit
def slopes_of(first, second, ux, uy, uz, mask, encoding, SIZES: tl.constexpr):
    """Return the gradient to the positions from gradients to both features [samples, levels]."""
    table, resolutions, size = encoding
    cell, fraction, resolution = lattice(ux, uy, uz, resolutions, SIZES)
    fx, fy, fz = fraction
    tx, ty, tz = tl.zeros_like(fx), tl.zeros_like(fx), tl.zeros_like(fx)
    for corner in tl.static_range(8):
        a, b = pair_at(table, rows_of(cell, corner, resolution, size), mask)
        value = first * a + second * b
        wx = fx if corner & 1 else 1.0 - fx
        wy = fy if corner >> 1 & 1 else 1.0 - fy
        wz = fz if corner >> 2 else 1.0 - fz
        tx += value * wy * wz * (1.0 if corner & 1 else -1.0)
        ty += value * wx * wz * (1.0 if corner >> 1 & 1 else -1.0)
        tz += value * wx * wy * (1.0 if corner >> 2 else -1.0)
    scale = resolution.to(tl.float32)[None, :]
    return tl.sum(tx * scale, 1), tl.sum(ty * scale, 1), tl.sum(tz * scale, 1)


@triton.jit(do_not_specialize=["n"])
def _hash_encode_slopes(u, grad_out, encoding, grad_u, n, SIZES: tl.constexpr, BLOCK: tl.constexpr):
    i, valid, ux, uy, uz = points(u, tl.program_id(0), n, BLOCK)
    at_first, at_second, mask = feature_pointers(grad_out, i, n, valid, SIZES)
    first = tl.load(at_first, mask=mask, other=0.0)
    second = tl.load(at_second, mask=mask, other=0.0)
    gx, gy, gz = slopes_of(first, second, ux, uy, uz, mask, encoding, SIZES)
    tl.store(grad_u + 3 * i, gx, mask=valid)
    tl.store(grad_u + 3 * i + 1, gy, mask=valid)
    tl.store(grad_u + 3 * i + 2, gz, mask=valid)


def hash_encode_slopes(
    u: Tensor, grad_out: Tensor, table: Tensor, resolutions: Tensor, grad_u: Tensor
) -> None:
    """Write the gradient of `hash_encode` to the positions: grad_out [2L,n] → grad_u [n,3]."""
    n, levels, size = u.shape[0], table.shape[0], table.shape[1]
    encoding = table, resolutions, size
    launch(_hash_encode_slopes, n, SAMPLES)(
        u, grad_out, encoding, grad_u, n, SIZES=(levels, padded(levels)), BLOCK=SAMPLES
    )
