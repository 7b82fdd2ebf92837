"""GPU kernels in Triton: the density, and marching, which evaluates it in occupied cells.

A block of rays looks for occupied cells and computes densities together. `march` keeps the samples;
`fused_render.composite` shares the search and does not. Rays of a block wait for one another, but
only for `TRIES` cells at a time.
"""

# Triton's functions have no types that pyright could know.
# pyright: reportCallIssue=false, reportArgumentType=false, reportAttributeAccessIssue=false
# pyright: reportOperatorIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOptionalSubscript=false

import math

import triton
import triton.language as tl
from torch import Tensor

from climatenerf.ops.triton.encoding import features_at, slopes_of
from climatenerf.ops.triton.network import EXACT, first_layer, hidden_of, sizes_of
from climatenerf.ops.triton.tiles import LIST, over, points, ray_lists

SAMPLES = 64  # of a tile of densities
RAYS = 16  # that march together
WARPS = 2  # they are marched by
TRIES = tl.constexpr(4)  # empty cells that a ray crosses while others compute densities
FOREVER = tl.constexpr(1e30)
SLOPE_SAMPLES, SLOPE_WARPS = 32, 4  # of a tile of the density's slopes


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


@triton.jit(do_not_specialize=["n"])
def _slopes(q, encoding, layers, out, n, SIZES: tl.constexpr, BLOCK: tl.constexpr):
    w1, b1, w2, _ = layers
    i, some, qx, qy, qz = points(q, tl.program_id(0), n, BLOCK)
    ux, uy, uz, m = unit_cube(qx, qy, qz)
    layer = first_layer(w1, b1, SIZES)
    even, odd, _ = layer
    first, second = features_at(ux, uy, uz, some, encoding, SIZES)
    unit = tl.arange(0, SIZES[2])
    own = tl.load(w2 + unit, mask=unit < SIZES[3], other=0.0)[None, :]
    back = tl.where(hidden_of(first, second, layer, EXACT) > 0.0, own, 0.0)
    first = tl.dot(back, tl.trans(even), input_precision=EXACT)
    second = tl.dot(back, tl.trans(odd), input_precision=EXACT)
    known = some[:, None] & (tl.arange(0, SIZES[1]) < SIZES[0])[None, :]
    gx, gy, gz = slopes_of(first, second, ux, uy, uz, known, encoding, SIZES)
    # Back through the contraction, and what thins the density outside the core.
    outside = m > 1.0
    far = tl.where(outside, m, 1.0)
    s = 0.25 * tl.where(outside, (2.0 - 1.0 / far) / far, 1.0)
    along = (qx * gx + qy * gy + qz * gz) * 0.5 * (1.0 / far - 1.0) / (far * far * far)
    along = tl.where(outside, along - 2.0 / (far * far), 0.0)
    tl.store(out + 3 * i, s * gx + along * qx, mask=some)
    tl.store(out + 3 * i + 1, s * gy + along * qy, mask=some)
    tl.store(out + 3 * i + 2, s * gz + along * qz, mask=some)


def density_slopes(q: Tensor, net: tuple[Tensor, ...], out: Tensor) -> None:
    """Gradient of the density's logarithm at q [n,3] (grid units) → out [n,3]."""
    table, resolutions, *layers = net
    n = q.shape[0]
    over(_slopes, n, SLOPE_SAMPLES)(
        q,
        (table, resolutions, table.shape[1]),
        tuple(layers),
        out,
        n,
        SIZES=sizes_of(table, layers[0]),
        BLOCK=SLOPE_SAMPLES,
        num_warps=SLOPE_WARPS,
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


@triton.jit(do_not_specialize=["n", "total"])
def _pack(rows, offsets, out, n, total, capacity, BLOCK: tl.constexpr):
    r, first, count = ray_lists(offsets, n, BLOCK)
    longest = tl.max(count, 0)
    k = 0
    while k < longest:
        some = k < count
        for kind in tl.static_range(3):
            value = tl.load(rows + (kind * capacity + k) * n + r, mask=some)
            tl.store(out + kind * total + first + k, value, mask=some)
        k += 1


def pack(rows: Tensor, offsets: Tensor, out: Tensor) -> None:
    """Packs what `march` has left in rows into out [3, samples]."""
    n = offsets.shape[0] - 1
    over(_pack, n, LIST)(rows, offsets, out, n, out.shape[1], rows.shape[1], BLOCK=LIST)


@triton.jit(do_not_specialize=["n"])
def _grid_positions(rays_o, rays_d, offsets, t, out, n, BLOCK: tl.constexpr):
    r, first, count = ray_lists(offsets, n, BLOCK)
    some = r < n
    ox = tl.load(rays_o + 3 * r, mask=some)
    oy = tl.load(rays_o + 3 * r + 1, mask=some)
    oz = tl.load(rays_o + 3 * r + 2, mask=some)
    dx = tl.load(rays_d + 3 * r, mask=some)
    dy = tl.load(rays_d + 3 * r + 1, mask=some)
    dz = tl.load(rays_d + 3 * r + 2, mask=some)
    longest = tl.max(count, 0)
    k = 0
    while k < longest:
        i, own = first + k, k < count
        far = tl.load(t + i, mask=own, other=0.0)
        ux, uy, uz, _ = unit_cube(ox + far * dx, oy + far * dy, oz + far * dz)
        tl.store(out + 3 * i, ux, mask=own)
        tl.store(out + 3 * i + 1, uy, mask=own)
        tl.store(out + 3 * i + 2, uz, mask=own)
        k += 1


def grid_positions(rays_o: Tensor, rays_d: Tensor, offsets: Tensor, t: Tensor, u: Tensor) -> None:
    """Unit-cube coordinates (after contraction) of packed samples: → u [samples,3]."""
    n = rays_o.shape[0]
    over(_grid_positions, n, LIST)(rays_o, rays_d, offsets, t, u, n, BLOCK=LIST)
