"""Tiles of samples, blocks of rays and launches, shared by all GPU kernels. In Triton.

Triton comes with PyTorch for CUDA and compiles each kernel at its first launch; it needs a C
compiler to build the launcher. Its interpreter (TRITON_INTERPRET=1) runs the same code on a CPU,
which is how the tests check kernels without a GPU. `ops/reference.py` specifies every kernel.
"""

# Triton's functions have no types that pyright could know.
# pyright: reportCallIssue=false, reportArgumentType=false, reportAttributeAccessIssue=false
# pyright: reportOperatorIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOptionalSubscript=false

import triton
import triton.language as tl

LIST = 64  # rays of a block that goes along lists of samples


@triton.jit
def points(u, tile, n, BLOCK: tl.constexpr):
    """The rows of u [n,3] in a tile: index, which there are, x, y, z."""
    i = tile.to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    some = i < n
    ux = tl.load(u + 3 * i, mask=some, other=0.0)
    uy = tl.load(u + 3 * i + 1, mask=some, other=0.0)
    return i, some, ux, uy, tl.load(u + 3 * i + 2, mask=some, other=0.0)


@triton.jit
def ray_lists(offsets, n, BLOCK: tl.constexpr):
    """A block's rays, where their samples begin, and how many they are (0 beyond the last ray)."""
    r = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    some = r < n
    first = tl.load(offsets + r, mask=some, other=0)
    return r, first, tl.load(offsets + r + 1, mask=some, other=0) - first


def padded(count: int) -> int:
    """A tile's width for so many levels or units: matrix products want a power of 2 from 16 on."""
    return max(16, 1 << (count - 1).bit_length())


def over(kernel, count: int, block: int):
    """A kernel ready to be called for `count` items, `block` of them a program."""
    return kernel[(max(1, triton.cdiv(count, block)),)]
