"""What views agree to see behind places, on a GPU, in Triton: see `reference.label_votes`."""

# Triton's functions have no types that pyright could know.
# pyright: reportCallIssue=false, reportArgumentType=false, reportAttributeAccessIssue=false
# pyright: reportOperatorIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false

import triton
import triton.language as tl
from torch import Tensor

from climatenerf.ops.triton.tiles import over, points

PLACES = 128  # of a block


@triton.jit(do_not_specialize=["n", "count"])
def _voices_of(x, radius, views, least, agreed, n, count, BLOCK: tl.constexpr):
    reach, starts, sizes, pinholes, c2w = views
    i, some, px, py, pz = points(x, tl.program_id(0), n, BLOCK)
    own = tl.load(radius + i, mask=some, other=0.0)
    voices, watching = tl.zeros([BLOCK], tl.int32), tl.zeros([BLOCK], tl.int32)
    spread = voices > 0
    first_x, first_y, first_z = tl.zeros_like(px), tl.zeros_like(px), tl.zeros_like(px)
    v = 0
    while v < count:
        pose, pinhole = c2w + 16 * v, pinholes + 4 * v
        ex, ey, ez = tl.load(pose + 3), tl.load(pose + 7), tl.load(pose + 11)
        dx, dy, dz = px - ex, py - ey, pz - ez
        across = dx * tl.load(pose) + dy * tl.load(pose + 4) + dz * tl.load(pose + 8)
        down = dx * tl.load(pose + 1) + dy * tl.load(pose + 5) + dz * tl.load(pose + 9)
        z = dx * tl.load(pose + 2) + dy * tl.load(pose + 6) + dz * tl.load(pose + 10)
        before = some & (z > own)
        per_metre = 1.0 / tl.where(before, z, 1.0)
        fx, fy = tl.load(pinhole), tl.load(pinhole + 1)
        column = tl.floor(fx * across * per_metre + tl.load(pinhole + 2))
        row = tl.floor(fy * down * per_metre + tl.load(pinhole + 3))
        height, width = tl.load(sizes + 2 * v), tl.load(sizes + 2 * v + 1)
        inside = before & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        watching += inside.to(tl.int32)
        at = tl.load(starts + v) + tl.where(inside, row * width + column, 0.0).to(tl.int64)
        within = tl.load(reach + at, mask=inside, other=0).to(tl.float32)
        says = inside & (within >= 1) & (within - 1 >= own * tl.maximum(fx, fy) * per_metre)
        begins = says & (voices == 0)
        first_x, first_y = tl.where(begins, ex, first_x), tl.where(begins, ey, first_y)
        first_z = tl.where(begins, ez, first_z)
        ax, ay, az = first_x - ex, first_y - ey, first_z - ez
        spread = spread | (says & (ax * ax + ay * ay + az * az > least[2] * least[2]))
        voices += says.to(tl.int32)
        v += 1
    enough = spread & (voices >= least[0]) & (voices >= least[1] * watching.to(tl.float32))
    tl.store(agreed + i, enough.to(tl.uint8), mask=some)


def label_votes(
    x: Tensor,
    radius: Tensor,
    views: tuple[Tensor, Tensor, Tensor, Tensor, Tensor],
    least: tuple[int, float, float],
    agreed: Tensor,
) -> None:
    """Which places x [n,3] enough views see before nothing but sky, or ground → agreed [n].

    Args: views = (maps in one row, where each starts, sizes [v,2], pinholes [v,4], c2w [v,4,4]).
    """
    n = x.shape[0]
    given = float(least[0]), *least[1:]  # a count of 1 would be a constant to the compiler
    over(_voices_of, n, PLACES)(x, radius, views, given, agreed, n, views[1].shape[0], BLOCK=PLACES)
