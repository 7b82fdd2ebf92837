"""Marching on a GPU, in Triton: a block of rays looks for occupied cells, and computes densities.

Shared by `gpu.march`, which keeps the samples, and `gpu_render.composite`, which does not. Rays of
a block wait for one another, but only for `TRIES` cells at a time.
"""

# Triton's functions have no types that pyright could know.
# pyright: reportCallIssue=false, reportArgumentType=false, reportAttributeAccessIssue=false
# pyright: reportOperatorIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOptionalSubscript=false

import math

import triton
import triton.language as tl
from torch import Tensor

from climatenerf.ops.triton.encoding import density_layers, density_of, over, points, sizes_of

SAMPLES = 64  # of a tile of densities
RAYS = 16  # that march together
WARPS = 2  # they are marched by
TRIES = tl.constexpr(4)  # empty cells that a ray crosses while others compute densities
FOREVER = tl.constexpr(1e30)


@triton.jit(do_not_specialize=["n"])
def _density_at(q, encoding, net, out, n, SIZES: tl.constexpr, BLOCK: tl.constexpr):
    i, some, qx, qy, qz = points(q, tl.program_id(0), n, BLOCK)
    layers = density_layers(net, SIZES)
    tl.store(out + i, density_of(qx, qy, qz, some, encoding, layers, SIZES), mask=some)


def density_at(q: Tensor, net: tuple[Tensor, ...], out: Tensor) -> None:
    """Density (1/grid unit) at q [n,3] in grid units → out [n]."""
    table, resolutions, *layers = net
    n, encoding = q.shape[0], (table, resolutions, table.shape[1])
    over(_density_at, n, SAMPLES)(
        q, encoding, tuple(layers), out, n, SIZES=sizes_of(table, layers[0]), BLOCK=SAMPLES
    )


@triton.jit
def _clip(o, d, far, start, end):
    """Cuts a ray to its part within the outermost cube, along one axis."""
    moves = d != 0.0
    safe = tl.where(moves, d, 1.0)
    a, b = (-far - o) / safe, (far - o) / safe
    start = tl.where(moves, tl.maximum(start, tl.minimum(a, b)), start)
    gone = (o < -far) | (o > far)
    end = tl.where(moves, tl.minimum(end, tl.maximum(a, b)), tl.where(gone, -1.0, end))
    return start, end


@triton.jit
def begin(rays, spans, cascades, steps, n, BLOCK: tl.constexpr):
    """A block's rays: index, which there are, origins, directions, where their combs begin, end."""
    r = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    some = r < n
    ox = tl.load(rays[0] + 3 * r, mask=some, other=0.0)
    oy = tl.load(rays[0] + 3 * r + 1, mask=some, other=0.0)
    oz = tl.load(rays[0] + 3 * r + 2, mask=some, other=0.0)
    dx = tl.load(rays[1] + 3 * r, mask=some, other=1.0)
    dy = tl.load(rays[1] + 3 * r + 1, mask=some, other=1.0)
    dz = tl.load(rays[1] + 3 * r + 2, mask=some, other=1.0)
    t = tl.load(spans + 3 * r, mask=some, other=0.0)
    end = tl.load(spans + 3 * r + 1, mask=some, other=-1.0)
    # A count of 1 is a constant to the compiler, which has no types of its own.
    far = tl.exp2(tl.full((), cascades - 1, tl.int32).to(tl.float32))
    t, end = _clip(ox, dx, far, t, end)
    t, end = _clip(oy, dy, far, t, end)
    t, end = _clip(oz, dz, far, t, end)
    share = tl.load(spans + 3 * r + 2, mask=some, other=0.0)
    t += share * tl.maximum(steps[0], steps[1] * t)
    return r, some, (ox, oy, oz), (dx, dy, dz), t, end


@triton.jit
def _leave(o, d, index, cell, half):
    """Ray length at which rays leave their lattice cells of side `cell`, along one axis."""
    face = (index + (d > 0.0).to(tl.int32)).to(tl.float32) * cell - half
    return tl.where(d == 0.0, FOREVER, (face - o) / tl.where(d == 0.0, 1.0, d))


@triton.jit
def middle_of(o, d, t, end, steps):
    """The comb's step that begins at t: its length, ray length of its middle, and place there."""
    dt = tl.minimum(tl.maximum(steps[0], steps[1] * t), end - t)
    tm = t + 0.5 * dt
    return dt, tm, o[0] + tm * d[0], o[1] + tm * d[1], o[2] + tm * d[2]


@triton.jit
def search(o, d, t, end, live, cells, steps):
    """Live rays cross `TRIES` cells at most: t, and 1 for those that have found an occupied one."""
    found = tl.zeros_like(t).to(tl.int32)
    for _try in range(TRIES):
        t, found = _walk(o, d, t, end, live & (t < end), found, cells, steps)
    return t, found


@triton.jit
def _walk(o, d, t, end, live, found, cells, steps):
    """Rays that are live and have not found an occupied cell look into the one they are in.

    Returns t, behind the cell (or its block of cells) where that is empty, and who has found one.
    """
    occupied, blocks, sides = cells
    cascades, side, size = sides
    look = live & (found == 0)
    dt, tm, qx, qy, qz = middle_of(o, d, t, end, steps)
    reach = tl.maximum(tl.maximum(tl.abs(qx), tl.abs(qy)), tl.abs(qz))
    # The least cascade that holds it: exponents are exact where logarithms round.
    bits = tl.maximum(reach, 1.0).to(tl.int32, bitcast=True)
    cascade = (bits >> 23) - 127 + ((bits & 0x7FFFFF) != 0).to(tl.int32)
    cascade = tl.minimum(cascade, cascades - 1)
    half = tl.exp2(cascade.to(tl.float32))
    cell = 2.0 * half / side
    x = tl.minimum(tl.maximum(((qx + half) / cell).to(tl.int32), 0), side - 1)
    y = tl.minimum(tl.maximum(((qy + half) / cell).to(tl.int32), 0), side - 1)
    z = tl.minimum(tl.maximum(((qz + half) / cell).to(tl.int32), 0), side - 1)
    bx, by, bz, count = x // size, y // size, z // size, side // size
    held = tl.load(blocks + ((cascade * count + bx) * count + by) * count + bz, mask=look, other=0)
    full = held > 0
    own = tl.load(
        occupied + ((cascade * side + x) * side + y) * side + z, mask=look & full, other=0
    )
    width = tl.where(full, cell, cell * size)
    leave = _leave(o[0], d[0], tl.where(full, x, bx), width, half)
    leave = tl.minimum(leave, _leave(o[1], d[1], tl.where(full, y, by), width, half))
    leave = tl.minimum(leave, _leave(o[2], d[2], tl.where(full, z, bz), width, half))
    # Whole steps, so that the sampling comb does not depend on the cells crossed.
    on = t + dt * tl.maximum(tl.ceil((leave - tm) / dt), 1.0)
    hit = look & (own > 0)
    return tl.where(look & (own == 0), on, t), found | hit.to(tl.int32)


@triton.jit(do_not_specialize=["n"])
def _march(
    rays,
    spans,
    cells,
    steps,
    enough,
    encoding,
    net,
    rows,
    counts,
    n,
    capacity,
    SIZES: tl.constexpr,
    BLOCK: tl.constexpr,
):
    r, some, o, d, t, end = begin(rays, spans, cells[2][0], steps, n, BLOCK)
    layers = density_layers(net, SIZES)
    tau = tl.zeros_like(t)
    k = tl.zeros_like(r)
    live = some & (t < end)
    while tl.max(live.to(tl.int32), 0) > 0:
        t, found = search(o, d, t, end, live, cells, steps)
        here = found > 0
        if tl.max(found, 0) > 0:
            dt, tm, qx, qy, qz = middle_of(o, d, t, end, steps)
            sigma = density_of(qx, qy, qz, here, encoding, layers, SIZES)
            thick = here & (sigma * dt > steps[2])
            # By step, then by ray: neighbouring threads write side by side.
            at = rows + k * n + r
            tl.store(at, tm, mask=thick)
            tl.store(at + capacity * n, dt, mask=thick)
            tl.store(at + 2 * capacity * n, sigma, mask=thick)
            tau += tl.where(thick, sigma * dt, 0.0)
            k += thick.to(tl.int64)
            t = tl.where(here, t + dt, t)
        live = live & (t < end) & (tau < enough) & (k < capacity)
    tl.store(counts + r, k, mask=some)


def march(
    rays_o: Tensor,
    rays_d: Tensor,
    spans: Tensor,
    cells: tuple[Tensor, Tensor],
    steps: tuple[float, float, float],
    stop: float,
    net: tuple[Tensor, ...],
    rows: Tensor,
    counts: Tensor,
) -> None:
    """Marches rays front to back through occupied space, evaluating density on the way.

    Args: rays [n,3] in grid units; spans [n,3]: first and last length, share of the first step;
    cells = (occupied [K,G,G,G], the same for blocks); steps = (smallest step, step per length,
    optical depth below which one counts as empty); stop = transmittance at which a ray ends;
    net = (table, resolutions, w1, b1, w2, b2).
    rows [3, capacity, n or more] receive t, dt and sigma, counts [n] how many.
    """
    table, resolutions, *layers = net
    n = spans.shape[0]
    over(_march, n, RAYS)(
        (rays_o, rays_d),
        spans,
        cells_of(cells),
        steps,
        -math.log(stop),
        (table, resolutions, table.shape[1]),
        tuple(layers),
        rows,
        counts,
        n,
        rows.shape[1],
        SIZES=sizes_of(table, layers[0]),
        BLOCK=RAYS,
        num_warps=WARPS,
    )


def cells_of(cells: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor, tuple[int, int, int]]:
    """As kernels take them: with cascades, cells along a side, cells along a block's."""
    occupied, blocks = cells
    cascades, side = occupied.shape[:2]
    return occupied, blocks, (cascades, side, side // blocks.shape[1])


@triton.jit
def weight_of(before, tau):
    """Rendering weight of a sample of optical depth tau behind so much of it."""
    # 1 - exp(-tau) loses all digits of a thin sample's; the series has them.
    thin = tau * (1.0 - tau * (0.5 - tau * (1.0 / 6.0 - tau / 24.0)))
    return tl.exp(-before) * tl.where(tau < 0.05, thin, 1.0 - tl.exp(-tau))
