"""GPU kernel in Triton: label votes. The twin is `visual_hull_reference.label_votes`."""

# pyright cannot know the types of Triton's functions.
# pyright: reportCallIssue=false, reportArgumentType=false, reportAttributeAccessIssue=false
# pyright: reportOperatorIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false

import triton
import triton.language as tl
from torch import Tensor

from climatenerf.ops.triton.tiles import launch, points

POSITIONS = 128  # per program


@triton.jit(do_not_specialize=["n", "count"])
def _label_votes(x, radius, views, thresholds, consensus, n, count, BLOCK: tl.constexpr):
    depth, starts, sizes, pinholes, c2w = views
    i, valid, px, py, pz = points(x, tl.program_id(0), n, BLOCK)
    ball = tl.load(radius + i, mask=valid, other=0.0)
    votes, observers = tl.zeros([BLOCK], tl.int32), tl.zeros([BLOCK], tl.int32)
    wide = votes > 0
    first_x, first_y, first_z = tl.zeros_like(px), tl.zeros_like(px), tl.zeros_like(px)
    v = 0
    while v < count:
        pose, pinhole = c2w + 16 * v, pinholes + 4 * v
        ex, ey, ez = tl.load(pose + 3), tl.load(pose + 7), tl.load(pose + 11)
        dx, dy, dz = px - ex, py - ey, pz - ez
        across = dx * tl.load(pose) + dy * tl.load(pose + 4) + dz * tl.load(pose + 8)
        down = dx * tl.load(pose + 1) + dy * tl.load(pose + 5) + dz * tl.load(pose + 9)
        z = dx * tl.load(pose + 2) + dy * tl.load(pose + 6) + dz * tl.load(pose + 10)
        ahead = valid & (z > ball)
        inverse_z = 1.0 / tl.where(ahead, z, 1.0)
        fx, fy = tl.load(pinhole), tl.load(pinhole + 1)
        column = tl.floor(fx * across * inverse_z + tl.load(pinhole + 2))
        row = tl.floor(fy * down * inverse_z + tl.load(pinhole + 3))
        height, width = tl.load(sizes + 2 * v), tl.load(sizes + 2 * v + 1)
        inside = ahead & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        observers += inside.to(tl.int32)
        at = tl.load(starts + v) + tl.where(inside, row * width + column, 0.0).to(tl.int64)
        inside_depth = tl.load(depth + at, mask=inside, other=0).to(tl.float32)
        vote = (
            inside
            & (inside_depth >= 1)
            & (inside_depth - 1 >= ball * tl.maximum(fx, fy) * inverse_z)
        )
        begins = vote & (votes == 0)
        first_x, first_y = tl.where(begins, ex, first_x), tl.where(begins, ey, first_y)
        first_z = tl.where(begins, ez, first_z)
        ax, ay, az = first_x - ex, first_y - ey, first_z - ez
        wide = wide | (vote & (ax * ax + ay * ay + az * az > thresholds[2] * thresholds[2]))
        votes += vote.to(tl.int32)
        v += 1
    agree = wide & (votes >= thresholds[0]) & (votes >= thresholds[1] * observers.to(tl.float32))
    tl.store(consensus + i, agree.to(tl.uint8), mask=valid)


def label_votes(
    x: Tensor,
    radius: Tensor,
    views: tuple[Tensor, Tensor, Tensor, Tensor, Tensor],
    thresholds: tuple[int, float, float],
    consensus: Tensor,
) -> None:
    """Write on which balls (x [n,3], radius [n]) the views' masks agree → consensus [n].

    views: (depths inside the masks, flat; start of each view; sizes [v,2]; pinholes [v,4];
    c2w [v,4,4]).
    """
    n = x.shape[0]
    # The compiler would treat an integer 1 as a constant.
    limits = float(thresholds[0]), *thresholds[1:]
    launch(_label_votes, n, POSITIONS)(
        x, radius, views, limits, consensus, n, views[1].shape[0], BLOCK=POSITIONS
    )
