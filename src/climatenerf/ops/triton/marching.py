"""GPU kernels in Triton: the density, and marching, which evaluates it in occupied cells.

A block of rays searches for occupied cells and computes densities together. `march` stores the
samples; `fused_render.composite` shares the search and does not. Rays of a block wait for each
other for at most `TRIES` cells at a time.
"""

# pyright cannot know the types of Triton's functions.
# pyright: reportCallIssue=false, reportArgumentType=false, reportAttributeAccessIssue=false
# pyright: reportOperatorIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOptionalSubscript=false

import math

import triton
import triton.language as tl
from torch import Tensor

from climatenerf.ops.step_limits import MAX_STEPS
from climatenerf.ops.triton.encoding import features_at, slopes_of
from climatenerf.ops.triton.network import EXACT, first_layer, hidden_of, sizes_of
from climatenerf.ops.triton.tiles import RAY_LISTS, launch, points, ray_lists

SAMPLES = 64  # per tile of densities
RAYS = 16  # that march together in a program
WARPS = 2  # per program that marches
SEARCHES = tl.constexpr(MAX_STEPS)  # at most, of a ray
TRIES = tl.constexpr(4)  # empty cells that a ray crosses between two computations of densities
INFINITE = tl.constexpr(1e30)
SLOPE_SAMPLES, SLOPE_WARPS = 32, 4  # per tile of the density's slopes


@triton.jit
def unit_cube(qx, qy, qz):
    """Contract positions: return unit-cube coordinates and the distance from the centre."""
    m = tl.sqrt(qx * qx + qy * qy + qz * qz)
    s = 0.25 * tl.where(m <= 1.0, 1.0, (2.0 - 1.0 / m) / m)
    ux = tl.minimum(tl.maximum(qx * s + 0.5, 0.0), 0.999999)
    uy = tl.minimum(tl.maximum(qy * s + 0.5, 0.0), 0.999999)
    uz = tl.minimum(tl.maximum(qz * s + 0.5, 0.0), 0.999999)
    return ux, uy, uz, m


@triton.jit
def density_of(qx, qy, qz, valid, encoding, layers, SIZES: tl.constexpr):
    """Return the density (1/grid unit) at positions in grid units, where `valid`."""
    ux, uy, uz, m = unit_cube(qx, qy, qz)
    first, second = features_at(ux, uy, uz, valid, encoding, SIZES)
    layer, w2, b2 = layers
    h = tl.maximum(hidden_of(first, second, layer, EXACT), 0.0)
    raw = tl.sum(h * w2[None, :], 1) + b2
    return tl.exp(tl.minimum(raw, 15.0)) / tl.maximum(m * m, 1.0)


@triton.jit
def density_layers(net, SIZES: tl.constexpr):
    """Load the density's network (w1, b1, w2, b2) as `density_of` takes it."""
    w1, b1, w2, b2 = net
    layer = first_layer(w1, b1, SIZES)
    unit = tl.arange(0, SIZES[2])
    return layer, tl.load(w2 + unit, mask=unit < SIZES[3], other=0.0), tl.load(b2)


@triton.jit(do_not_specialize=["n"])
def _density_at(q, encoding, net, out, n, SIZES: tl.constexpr, BLOCK: tl.constexpr):
    i, valid, qx, qy, qz = points(q, tl.program_id(0), n, BLOCK)
    layers = density_layers(net, SIZES)
    tl.store(out + i, density_of(qx, qy, qz, valid, encoding, layers, SIZES), mask=valid)


def density_at(q: Tensor, net: tuple[Tensor, ...], out: Tensor) -> None:
    """Write the density (1/grid unit) at q [n,3] in grid units → out [n]."""
    table, resolutions, *layers = net
    n, encoding = q.shape[0], (table, resolutions, table.shape[1])
    launch(_density_at, n, SAMPLES)(
        q, encoding, tuple(layers), out, n, SIZES=sizes_of(table, layers[0]), BLOCK=SAMPLES
    )


@triton.jit(do_not_specialize=["n"])
def _slopes(q, encoding, layers, out, n, SIZES: tl.constexpr, BLOCK: tl.constexpr):
    w1, b1, w2, _ = layers
    i, valid, qx, qy, qz = points(q, tl.program_id(0), n, BLOCK)
    ux, uy, uz, m = unit_cube(qx, qy, qz)
    layer = first_layer(w1, b1, SIZES)
    even, odd, _ = layer
    first, second = features_at(ux, uy, uz, valid, encoding, SIZES)
    unit = tl.arange(0, SIZES[2])
    output_weight = tl.load(w2 + unit, mask=unit < SIZES[3], other=0.0)[None, :]
    active = hidden_of(first, second, layer, EXACT) > 0.0
    back = tl.where(active, output_weight, 0.0)
    first = tl.dot(back, tl.trans(even), input_precision=EXACT)
    second = tl.dot(back, tl.trans(odd), input_precision=EXACT)
    mask = valid[:, None] & (tl.arange(0, SIZES[1]) < SIZES[0])[None, :]
    gx, gy, gz = slopes_of(first, second, ux, uy, uz, mask, encoding, SIZES)
    # Back through the contraction and the density's fall-off outside the core.
    outside = m > 1.0
    far = tl.where(outside, m, 1.0)
    s = 0.25 * tl.where(outside, (2.0 - 1.0 / far) / far, 1.0)
    along = (qx * gx + qy * gy + qz * gz) * 0.5 * (1.0 / far - 1.0) / (far * far * far)
    along = tl.where(outside, along - 2.0 / (far * far), 0.0)
    tl.store(out + 3 * i, s * gx + along * qx, mask=valid)
    tl.store(out + 3 * i + 1, s * gy + along * qy, mask=valid)
    tl.store(out + 3 * i + 2, s * gz + along * qz, mask=valid)


def density_slopes(q: Tensor, net: tuple[Tensor, ...], out: Tensor) -> None:
    """Write the gradient of the density's logarithm at q [n,3] (grid units) → out [n,3]."""
    table, resolutions, *layers = net
    n = q.shape[0]
    launch(_slopes, n, SLOPE_SAMPLES)(
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
    """Clip rays to the outermost cube along one axis."""
    moves = d != 0.0
    safe = tl.where(moves, d, 1.0)
    a, b = (-far - o) / safe, (far - o) / safe
    start = tl.where(moves, tl.maximum(start, tl.minimum(a, b)), start)
    outside = (o < -far) | (o > far)
    end = tl.where(moves, tl.minimum(end, tl.maximum(a, b)), tl.where(outside, -1.0, end))
    return start, end


@triton.jit
def begin(rays, spans, cascades, steps, n, BLOCK: tl.constexpr):
    """Load a block of rays: return index, mask, origins, directions, first and last length."""
    r = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    valid = r < n
    ox = tl.load(rays[0] + 3 * r, mask=valid, other=0.0)
    oy = tl.load(rays[0] + 3 * r + 1, mask=valid, other=0.0)
    oz = tl.load(rays[0] + 3 * r + 2, mask=valid, other=0.0)
    dx = tl.load(rays[1] + 3 * r, mask=valid, other=1.0)
    dy = tl.load(rays[1] + 3 * r + 1, mask=valid, other=1.0)
    dz = tl.load(rays[1] + 3 * r + 2, mask=valid, other=1.0)
    t = tl.load(spans + 3 * r, mask=valid, other=0.0)
    end = tl.load(spans + 3 * r + 1, mask=valid, other=-1.0)
    # The compiler treats an argument of 1 as a constant without a type.
    far = tl.exp2(tl.full((), cascades - 1, tl.int32).to(tl.float32))
    t, end = _clip(ox, dx, far, t, end)
    t, end = _clip(oy, dy, far, t, end)
    t, end = _clip(oz, dz, far, t, end)
    jitter = tl.load(spans + 3 * r + 2, mask=valid, other=0.0)
    t += jitter * tl.maximum(steps[0], steps[1] * t)
    return r, valid, (ox, oy, oz), (dx, dy, dz), t, end


@triton.jit
def _cell_exit(o, d, index, cell, half):
    """Return the ray length at which rays leave their cells of side `cell`, along one axis."""
    face = (index + (d > 0.0).to(tl.int32)).to(tl.float32) * cell - half
    return tl.where(d == 0.0, INFINITE, (face - o) / tl.where(d == 0.0, 1.0, d))


@triton.jit
def middle_of(o, d, t, end, steps):
    """Return the step that begins at t: its length, and ray length and position of its middle."""
    dt = tl.minimum(tl.maximum(steps[0], steps[1] * t), end - t)
    tm = t + 0.5 * dt
    return dt, tm, o[0] + tm * d[0], o[1] + tm * d[1], o[2] + tm * d[2]


@triton.jit
def search(o, d, t, end, live, cells, steps):
    """Let live rays cross at most `TRIES` cells: return t, and 1 where a cell is occupied."""
    found = tl.zeros_like(t).to(tl.int32)
    for _try in range(TRIES):
        t, found = _walk(o, d, t, end, live & (t < end), found, cells, steps)
    return t, found


@triton.jit
def _walk(o, d, t, end, live, found, cells, steps):
    """Test the cells of live rays that have not found an occupied one.

    Return t, moved behind the cell (or its block of cells) where that is empty, and the updated
    `found`.
    """
    occupied, blocks, sides = cells
    cascades, side, size = sides
    look = live & (found == 0)
    dt, tm, qx, qy, qz = middle_of(o, d, t, end, steps)
    distance = tl.maximum(tl.maximum(tl.abs(qx), tl.abs(qy)), tl.abs(qz))
    # The finest cascade that holds it: exponents are exact where logarithms round.
    bits = tl.maximum(distance, 1.0).to(tl.int32, bitcast=True)
    cascade = (bits >> 23) - 127 + ((bits & 0x7FFFFF) != 0).to(tl.int32)
    cascade = tl.minimum(cascade, cascades - 1)
    half = tl.exp2(cascade.to(tl.float32))
    cell = 2.0 * half / side
    x = tl.minimum(tl.maximum(((qx + half) / cell).to(tl.int32), 0), side - 1)
    y = tl.minimum(tl.maximum(((qy + half) / cell).to(tl.int32), 0), side - 1)
    z = tl.minimum(tl.maximum(((qz + half) / cell).to(tl.int32), 0), side - 1)
    bx, by, bz, count = x // size, y // size, z // size, side // size
    block = tl.load(blocks + ((cascade * count + bx) * count + by) * count + bz, mask=look, other=0)
    full = block > 0
    value = tl.load(
        occupied + ((cascade * side + x) * side + y) * side + z, mask=look & full, other=0
    )
    width = tl.where(full, cell, cell * size)
    exit_length = _cell_exit(o[0], d[0], tl.where(full, x, bx), width, half)
    exit_length = tl.minimum(
        exit_length, _cell_exit(o[1], d[1], tl.where(full, y, by), width, half)
    )
    exit_length = tl.minimum(
        exit_length, _cell_exit(o[2], d[2], tl.where(full, z, bz), width, half)
    )
    # Whole steps, so that sample positions do not depend on the cells crossed.
    after = t + dt * tl.maximum(tl.ceil((exit_length - tm) / dt), 1.0)
    hit = look & (value > 0)
    return tl.where(look & (value == 0), after, t), found | hit.to(tl.int32)


@triton.jit(do_not_specialize=["n"])
def _march(
    rays,
    spans,
    cells,
    steps,
    max_depth,
    encoding,
    net,
    rows,
    counts,
    n,
    capacity,
    SIZES: tl.constexpr,
    BLOCK: tl.constexpr,
):
    r, valid, o, d, t, end = begin(rays, spans, cells[2][0], steps, n, BLOCK)
    layers = density_layers(net, SIZES)
    tau = tl.zeros_like(t)
    k = tl.zeros_like(r)
    live = valid & (t < end)
    searches = 0
    while (tl.max(live.to(tl.int32), 0) > 0) & (searches < SEARCHES):
        searches += 1
        t, found = search(o, d, t, end, live, cells, steps)
        here = found > 0
        if tl.max(found, 0) > 0:
            dt, tm, qx, qy, qz = middle_of(o, d, t, end, steps)
            sigma = density_of(qx, qy, qz, here, encoding, layers, SIZES)
            thick = here & (sigma * dt > steps[2])
            # By step, then by ray: neighbouring threads write to adjacent addresses.
            at = rows + k * n + r
            tl.store(at, tm, mask=thick)
            tl.store(at + capacity * n, dt, mask=thick)
            tl.store(at + 2 * capacity * n, sigma, mask=thick)
            tau += tl.where(thick, sigma * dt, 0.0)
            k += thick.to(tl.int64)
            t = tl.where(here, t + dt, t)
        live = live & (t < end) & (tau < max_depth) & (k < capacity)
    tl.store(counts + r, k, mask=valid)


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
    """March rays front to back through occupied space and evaluate the density on the way.

    Args:
        rays_o, rays_d: [n,3], grid units; directions have unit length.
        spans: [n,3], first and last length, fraction of the first step to skip.
        cells: (occupied [K,G,G,G], the same for blocks of cells).
        steps: smallest step, step per length, optical depth below which a sample counts as empty.
        stop: transmittance at which a ray ends.
        net: (table, resolutions, w1, b1, w2, b2).
        rows: [3, capacity, n or more], receives t, dt and sigma.
        counts: [n], receives the number of samples of each ray.
    """
    table, resolutions, *layers = net
    n = spans.shape[0]
    launch(_march, n, RAYS)(
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
    """Return cells as kernels take them: with cascades and sides of the cube and of a block."""
    occupied, blocks = cells
    cascades, side = occupied.shape[:2]
    return occupied, blocks, (cascades, side, side // blocks.shape[1])


@triton.jit(do_not_specialize=["n", "total"])
def _pack(rows, offsets, out, n, total, capacity, BLOCK: tl.constexpr):
    r, first, count = ray_lists(offsets, n, BLOCK)
    longest = tl.max(count, 0)
    k = 0
    while k < longest:
        valid = k < count
        for kind in tl.static_range(3):
            value = tl.load(rows + (kind * capacity + k) * n + r, mask=valid)
            tl.store(out + kind * total + first + k, value, mask=valid)
        k += 1


def pack(rows: Tensor, offsets: Tensor, out: Tensor) -> None:
    """Pack the samples that `march` wrote to rows → out [3, samples]."""
    n = offsets.shape[0] - 1
    launch(_pack, n, RAY_LISTS)(rows, offsets, out, n, out.shape[1], rows.shape[1], BLOCK=RAY_LISTS)


@triton.jit(do_not_specialize=["n"])
def _grid_positions(rays_o, rays_d, offsets, t, out, n, BLOCK: tl.constexpr):
    r, first, count = ray_lists(offsets, n, BLOCK)
    valid = r < n
    ox = tl.load(rays_o + 3 * r, mask=valid)
    oy = tl.load(rays_o + 3 * r + 1, mask=valid)
    oz = tl.load(rays_o + 3 * r + 2, mask=valid)
    dx = tl.load(rays_d + 3 * r, mask=valid)
    dy = tl.load(rays_d + 3 * r + 1, mask=valid)
    dz = tl.load(rays_d + 3 * r + 2, mask=valid)
    longest = tl.max(count, 0)
    k = 0
    while k < longest:
        i, mask = first + k, k < count
        length = tl.load(t + i, mask=mask, other=0.0)
        ux, uy, uz, _ = unit_cube(ox + length * dx, oy + length * dy, oz + length * dz)
        tl.store(out + 3 * i, ux, mask=mask)
        tl.store(out + 3 * i + 1, uy, mask=mask)
        tl.store(out + 3 * i + 2, uz, mask=mask)
        k += 1


def grid_positions(rays_o: Tensor, rays_d: Tensor, offsets: Tensor, t: Tensor, u: Tensor) -> None:
    """Write the unit-cube coordinates (after contraction) of packed samples → u [samples,3]."""
    n = rays_o.shape[0]
    launch(_grid_positions, n, RAY_LISTS)(rays_o, rays_d, offsets, t, u, n, BLOCK=RAY_LISTS)
