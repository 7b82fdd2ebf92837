"""GPU kernels in Triton: multi-resolution hash encoding.

Samples lie along the first axis of a tile, levels of the encoding along the second, so that all
corners of all levels are on their way from memory at once. `reference.hash_encode` specifies it.

Kernels are compiled for SIZES: levels of the encoding, the same padded, hidden units padded, hidden
units; and, of networks whose outputs are not one density, outputs padded, outputs.
"""

# Triton's functions have no types that pyright could know.
# pyright: reportCallIssue=false, reportArgumentType=false, reportAttributeAccessIssue=false
# pyright: reportOperatorIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOptionalSubscript=false

import triton
import triton.language as tl
from torch import Tensor

from climatenerf.ops.triton.tiles import over, padded, points

SAMPLES = 64  # of a tile of an encoding
PRIME_Y = tl.constexpr(2654435761)
PRIME_Z = tl.constexpr(805459861)


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
def both(features, i, n, some, SIZES: tl.constexpr):
    """Where a level's first and second feature of samples lie in [2L,n], and which there are."""
    level = tl.arange(0, SIZES[1])[None, :].to(tl.int64)
    first = features + 2 * level * n + i[:, None]
    return first, first + n, some[:, None] & (level < SIZES[0])


@triton.jit(do_not_specialize=["n"])
def _hash_encode(u, encoding, out, n, SIZES: tl.constexpr, BLOCK: tl.constexpr):
    i, some, ux, uy, uz = points(u, tl.program_id(0), n, BLOCK)
    first, second = features_at(ux, uy, uz, some, encoding, SIZES)
    at_first, at_second, known = both(out, i, n, some, SIZES)
    tl.store(at_first, first, mask=known)
    tl.store(at_second, second, mask=known)


def hash_encode(u: Tensor, table: Tensor, resolutions: Tensor, out: Tensor) -> None:
    """Features of n points: u [n,3] in [0,1), table [L,T,2] → out [2L,n]."""
    n, levels, size = u.shape[0], table.shape[0], table.shape[1]
    encoding = table, resolutions, size
    over(_hash_encode, n, SAMPLES)(
        u, encoding, out, n, SIZES=(levels, padded(levels)), BLOCK=SAMPLES
    )


@triton.jit(do_not_specialize=["n"])
def _hash_encode_backward(u, grad_out, encoding, n, SIZES: tl.constexpr, BLOCK: tl.constexpr):
    grad_table, resolutions, size = encoding
    i, some, ux, uy, uz = points(u, tl.program_id(0), n, BLOCK)
    at_first, at_second, known = both(grad_out, i, n, some, SIZES)
    first = tl.load(at_first, mask=known, other=0.0)
    second = tl.load(at_second, mask=known, other=0.0)
    scatter(first, second, ux, uy, uz, known, grad_table, resolutions, size, SIZES)


@triton.jit
def scatter(first, second, ux, uy, uz, known, grad_table, resolutions, size, SIZES: tl.constexpr):
    """Adds gradients to both features of the levels [samples, levels] to the table's."""
    cell, place, resolution = lattice(ux, uy, uz, resolutions, SIZES)
    known = known & ((first != 0.0) | (second != 0.0))
    for corner in tl.static_range(8):
        at = grad_table + 2 * rows_of(cell, corner, resolution, size)
        weight = share_of(place, corner)
        tl.atomic_add(at, weight * first, mask=known, sem="relaxed")
        tl.atomic_add(at + 1, weight * second, mask=known, sem="relaxed")


def hash_encode_backward(
    u: Tensor, grad_out: Tensor, resolutions: Tensor, grad_table: Tensor
) -> None:
    """Adds the gradient of `hash_encode` to grad_table [L,T,2]; the sum's order is not fixed."""
    n, levels, size = u.shape[0], grad_table.shape[0], grad_table.shape[1]
    encoding = grad_table, resolutions, size
    over(_hash_encode_backward, n, SAMPLES)(
        u, grad_out, encoding, n, SIZES=(levels, padded(levels)), BLOCK=SAMPLES
    )


@triton.jit
def slopes_of(first, second, ux, uy, uz, known, encoding, SIZES: tl.constexpr):
    """Gradient to the positions from those to both features of the levels."""
    table, resolutions, size = encoding
    cell, place, resolution = lattice(ux, uy, uz, resolutions, SIZES)
    fx, fy, fz = place
    tx, ty, tz = tl.zeros_like(fx), tl.zeros_like(fx), tl.zeros_like(fx)
    for corner in tl.static_range(8):
        a, b = pair_at(table, rows_of(cell, corner, resolution, size), known)
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
    i, some, ux, uy, uz = points(u, tl.program_id(0), n, BLOCK)
    at_first, at_second, known = both(grad_out, i, n, some, SIZES)
    first = tl.load(at_first, mask=known, other=0.0)
    second = tl.load(at_second, mask=known, other=0.0)
    gx, gy, gz = slopes_of(first, second, ux, uy, uz, known, encoding, SIZES)
    tl.store(grad_u + 3 * i, gx, mask=some)
    tl.store(grad_u + 3 * i + 1, gy, mask=some)
    tl.store(grad_u + 3 * i + 2, gz, mask=some)


def hash_encode_slopes(
    u: Tensor, grad_out: Tensor, table: Tensor, resolutions: Tensor, grad_u: Tensor
) -> None:
    """Gradient of `hash_encode` to the positions: grad_out [2L,n] → grad_u [n,3]."""
    n, levels, size = u.shape[0], table.shape[0], table.shape[1]
    encoding = table, resolutions, size
    over(_hash_encode_slopes, n, SAMPLES)(
        u, grad_out, encoding, grad_u, n, SIZES=(levels, padded(levels)), BLOCK=SAMPLES
    )
