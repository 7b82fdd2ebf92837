"""Tiles of samples, lists of rays and launches, shared by all GPU kernels. In Triton.

Triton comes with PyTorch for CUDA and compiles each kernel at its first launch; it needs a C
compiler to build the launcher. Its interpreter (TRITON_INTERPRET=1) runs the same code on a CPU,
which is how the tests check kernels without a GPU. `ops/reference.py` specifies every kernel.
"""

# pyright cannot know the types of Triton's functions.
# pyright: reportCallIssue=false, reportArgumentType=false, reportAttributeAccessIssue=false
# pyright: reportOperatorIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOptionalSubscript=false

import triton
import triton.language as tl

RAY_LISTS = 64  # rays per program, where a program goes along their lists of samples


@triton.jit
def points(u, tile, n, BLOCK: tl.constexpr):
    """Load a tile of u [n,3]: return index, mask of those below n, x, y, z."""
    i = tile.to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    valid = i < n
    ux = tl.load(u + 3 * i, mask=valid, other=0.0)
    uy = tl.load(u + 3 * i + 1, mask=valid, other=0.0)
    return i, valid, ux, uy, tl.load(u + 3 * i + 2, mask=valid, other=0.0)


@triton.jit
def ray_lists(offsets, n, BLOCK: tl.constexpr):
    """Return a program's rays, their first samples, and their numbers of samples (0 beyond n)."""
    r = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    valid = r < n
    first = tl.load(offsets + r, mask=valid, other=0)
    return r, first, tl.load(offsets + r + 1, mask=valid, other=0) - first


def padded(count: int) -> int:
    """Return a tile's width for `count` levels or units: a power of 2, at least 16."""
    return max(16, 1 << (count - 1).bit_length())


def launch(kernel, count: int, block: int):
    """Return a kernel with its grid: `block` of `count` items for each program."""
    return kernel[(max(1, triton.cdiv(count, block)),)]
