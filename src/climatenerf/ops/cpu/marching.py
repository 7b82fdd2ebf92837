"""CPU kernels in Numba: ray marching, and the density that it evaluates.

The slow twins in `ops/reference.py` are the specification. Lengths are in grid units (see
`reference.contract`). Rays are packed: the samples of ray r are `offsets[r]:offsets[r + 1]`, front
to back. Arrays are float32 and C-contiguous.
"""

import numpy as np
from numba import njit, prange

from climatenerf.ops.cpu import simd
from climatenerf.ops.cpu.simd import LANES
from climatenerf.ops.step_limits import MAX_STEPS

SIMD_DIGEST = "2210a987a87b"  # of `simd.py`, which explains why

BLOCK = 256  # points per task of a thread
RAY_BLOCK = 32  # rays per task of a thread


@njit(cache=True, fastmath=True, inline="always")
def _contract_scale(m):
    """Return the factor that contracts a point at distance m from the centre."""
    return 1.0 if m <= 1.0 else (2.0 - 1.0 / m) / m


@njit(cache=True, fastmath=True, inline="always")
def _contract(points, fall_off, k, qx, qy, qz):
    """Write a point in grid units to column k: unit-cube coordinates → points [3, LANES].

    The factor from contracted to true density → fall_off [LANES].
    """
    m = np.sqrt(qx * qx + qy * qy + qz * qz)
    s = np.float32(_contract_scale(m)) * np.float32(0.25)
    half, low, high = np.float32(0.5), np.float32(0.0), np.float32(0.999999)
    points[0, k] = min(max(qx * s + half, low), high)
    points[1, k] = min(max(qy * s + half, low), high)
    points[2, k] = min(max(qz * s + half, low), high)
    # The networks give density per contracted length; 1/m² makes it density per length.
    fall_off[k] = np.float32(1.0) / max(m * m, np.float32(1.0))


@njit(cache=True, fastmath=True, inline="always")
def _densities(points, fall_off, table, resolutions, w1, b1, w2, b2, features, sigma):
    """Write the density (1/grid unit) at LANES points → sigma [1, LANES].

    Encoding, one hidden layer, exp. points and fall_off by `_contract`; features [2 levels, LANES]
    is scratch memory.
    """
    for level in range(table.shape[0]):
        simd.look_up(points, table, level, resolutions[level], features, 2 * level)
    simd.network(features, w1, b1, w2, b2, sigma)
    for k in range(LANES):
        sigma[0, k] = np.exp(min(sigma[0, k], np.float32(15.0))) * fall_off[k]


@njit(cache=True, fastmath=True, parallel=True)
def density_at(q, net, out):
    """Write the density (1/grid unit) at q [n,3] in grid units → out [n]."""
    table, resolutions, w1, b1, w2, b2 = net
    n = q.shape[0]
    for block in prange((n + BLOCK - 1) // BLOCK):
        points, fall_off = np.zeros((3, LANES), np.float32), np.zeros(LANES, np.float32)
        features = np.empty((2 * table.shape[0], LANES), np.float32)
        sigma = np.empty((1, LANES), np.float32)
        for start in range(block * BLOCK, min(n, block * BLOCK + BLOCK), LANES):
            count = min(LANES, n - start)
            for k in range(count):
                _contract(points, fall_off, k, q[start + k, 0], q[start + k, 1], q[start + k, 2])
            _densities(points, fall_off, table, resolutions, w1, b1, w2, b2, features, sigma)
            for k in range(count):
                out[start + k] = sigma[0, k]


@njit(cache=True, fastmath=True, parallel=True)
def density_slopes(q, net, transposed, out):
    """Write the gradient of the density's logarithm at q [n,3] in grid units → out [n,3].

    `transposed` is w1 as [features, hidden].
    """
    table, resolutions, w1, b1, w2, _ = net
    n, levels = q.shape[0], table.shape[0]
    for block in prange((n + BLOCK - 1) // BLOCK):
        points, fall_off = np.zeros((3, LANES), np.float32), np.zeros(LANES, np.float32)
        encoded = np.empty((8 * levels, LANES), np.float32)  # features, then their slopes
        hidden = np.empty((w1.shape[0], LANES), np.float32)
        grad_features, slope = (
            np.empty((2 * levels, LANES), np.float32),
            np.empty((3, LANES), np.float32),
        )
        for start in range(block * BLOCK, min(n, block * BLOCK + BLOCK), LANES):
            count = min(LANES, n - start)
            for k in range(count):
                _contract(points, fall_off, k, q[start + k, 0], q[start + k, 1], q[start + k, 2])
            for level in range(levels):
                first = 2 * levels + 6 * level
                resolution = resolutions[level]
                simd.look_up_slopes(points, table, level, resolution, encoded, 2 * level, first)
            for m in range(hidden.shape[0]):
                hidden[m] = b1[m]
            simd.add_product(w1, encoded, hidden, 1)
            for m in range(hidden.shape[0]):
                for k in range(LANES):
                    hidden[m, k] = w2[0, m] if hidden[m, k] > 0 else np.float32(0.0)
            grad_features[:] = 0.0
            simd.add_product(transposed, hidden, grad_features, 1)
            slope[:] = 0.0
            for feature in range(2 * levels):
                first = 2 * levels + 3 * feature
                for axis in range(3):
                    for k in range(LANES):
                        slope[axis, k] += grad_features[feature, k] * encoded[first + axis, k]
            for k in range(count):
                x, y, z = q[start + k, 0], q[start + k, 1], q[start + k, 2]
                m2 = x * x + y * y + z * z
                # Contraction: u = 1/2 + s·q/4. Its Jacobian outside the core: (s·I + s'/m·q·qᵀ)/4.
                s, radial, outer = np.float32(1.0), np.float32(0.0), np.float32(0.0)
                if m2 > 1.0:
                    m = np.sqrt(m2)
                    s = np.float32(_contract_scale(m))
                    radial = np.float32(2.0) * (np.float32(1.0) - m) / (m2 * m2)
                    outer = np.float32(2.0) / m2  # from the logarithm of 1/m²
                along = radial * (slope[0, k] * x + slope[1, k] * y + slope[2, k] * z)
                out[start + k, 0] = np.float32(0.25) * (s * slope[0, k] + along * x) - outer * x
                out[start + k, 1] = np.float32(0.25) * (s * slope[1, k] + along * y) - outer * y
                out[start + k, 2] = np.float32(0.25) * (s * slope[2, k] + along * z) - outer * z


@njit(cache=True, parallel=True)
def pack_cells(occupied, words):
    """Pack cells [K,G,G,G] as bits, 4³ in a word of 64 bits, x fastest → words [K,W,W,W]."""
    for slab in prange(words.shape[0] * words.shape[1]):
        cascade, wx = slab // words.shape[1], slab % words.shape[1]
        for wy in range(words.shape[2]):
            words[cascade, wx, wy] = 0
        for x in range(4 * wx, min(4 * wx + 4, occupied.shape[1])):
            for y in range(occupied.shape[2]):
                row, column = words[cascade, wx, y >> 2], occupied[cascade, x, y]
                bit = np.int64((x & 3) | (y & 3) << 2)
                for z in range(occupied.shape[3]):
                    row[z >> 2] |= np.int64(column[z] != 0) << (bit | np.int64((z & 3) << 4))


@njit(cache=True, parallel=True)
def occupied_blocks(words, out):
    """Mark the blocks of 8³ cells (2³ words) that hold an occupied one → out [K,B,B,B]."""
    for slab in prange(out.shape[0] * out.shape[1]):
        cascade, x = slab // out.shape[1], slab % out.shape[1]
        for y in range(out.shape[2]):
            for z in range(out.shape[3]):
                union = np.int64(0)
                for ix in range(2 * x, 2 * x + 2):
                    for iy in range(2 * y, 2 * y + 2):
                        union |= words[cascade, ix, iy, 2 * z] | words[cascade, ix, iy, 2 * z + 1]
                out[cascade, x, y, z] = union != 0


@njit(cache=True, fastmath=True, inline="always")
def _cell_exit(o, inv, index, cell, half):
    """Return the ray length at which the ray leaves a cell of side `cell`, along one axis."""
    if inv > 1e29 or inv < -1e29:  # the ray runs parallel to this pair of faces
        return np.float32(1e30)
    edge = np.float32(index + 1 if inv > 0 else index) * cell - half
    return (edge - o) * inv


@njit(cache=True, fastmath=True, parallel=True)
def march(rays_o, rays_d, spans, cells, steps, stop, net, rows, counts):
    """March rays front to back through occupied space and evaluate the density on the way.

    Args:
        rays_o, rays_d: [n,3], grid units; directions have unit length.
        spans: [n,3], first and last length, fraction of the first step to skip.
        cells: (words [K,W,W,W] of `pack_cells`, blocks [K,B,B,B] of `occupied_blocks` or of one
            cell each); cascade k covers the cube of half side 2^k.
        steps: smallest step, step per length, optical depth below which a sample counts as empty.
        stop: transmittance at which a ray ends.
        net: (table, resolutions, w1 [hidden, features], b1, w2 [1, hidden], b2).
        rows: [3, blocks of rays, RAY_BLOCK * capacity], receives t, dt and sigma. A block of rays
            writes its samples one after the other; `pack` joins the blocks.
        counts: [n], receives the number of samples of each ray.
    """
    table, resolutions, w1, b1, w2, b2 = net
    words, blocks = cells
    n = rays_o.shape[0]
    # Shifts are faster than divisions. With blocks of one cell no words are skipped.
    cascades, side = words.shape[0], words.shape[1] << 2
    shift, word_shift = (3, 2) if blocks.shape[1] == side >> 3 else (0, 0)
    side = blocks.shape[1] << shift
    capacity = rows.shape[2] // RAY_BLOCK
    far = np.float32(2.0 ** (cascades - 1))
    dt_min, cone, min_tau = np.float32(steps[0]), np.float32(steps[1]), np.float32(steps[2])
    log_stop = np.float32(-np.log(stop))
    half_cells = np.float32(0.5) * np.float32(side)
    for block in prange((n + RAY_BLOCK - 1) // RAY_BLOCK):
        points, fall_off = np.zeros((3, LANES), np.float32), np.zeros(LANES, np.float32)
        features = np.empty((2 * table.shape[0], LANES), np.float32)
        sigma = np.empty((1, LANES), np.float32)
        middles, lengths = np.empty(LANES, np.float32), np.empty(LANES, np.float32)
        k = 0
        for r in range(block * RAY_BLOCK, min(n, block * RAY_BLOCK + RAY_BLOCK)):
            ox, oy, oz = rays_o[r, 0], rays_o[r, 1], rays_o[r, 2]
            dx, dy, dz = rays_d[r, 0], rays_d[r, 1], rays_d[r, 2]
            infinite = np.float32(1e30)
            ivx = np.float32(1.0) / dx if dx != 0 else infinite
            ivy = np.float32(1.0) / dy if dy != 0 else infinite
            ivz = np.float32(1.0) / dz if dz != 0 else infinite
            # Clip to the outermost cube.
            t, end = spans[r, 0], spans[r, 1]
            for o, d, iv in ((ox, dx, ivx), (oy, dy, ivy), (oz, dz, ivz)):
                if d == 0:
                    if o < -far or o > far:
                        end = np.float32(-1.0)
                else:
                    ta, tb = (-far - o) * iv, (far - o) * iv
                    t = max(t, min(ta, tb))
                    end = min(end, max(ta, tb))
            tau = np.float32(0.0)
            first, steps_left = k, MAX_STEPS
            t += spans[r, 2] * max(dt_min, cone * t)
            while t < end and steps_left > 0:
                # The next LANES steps in occupied cells. The ray may end at the first of them, but
                # together they cost little more than one.
                count = 0
                while t < end and count < LANES and steps_left > 0:
                    steps_left -= 1
                    dt = min(max(dt_min, cone * t), end - t)
                    tm = t + np.float32(0.5) * dt
                    qx, qy, qz = ox + tm * dx, oy + tm * dy, oz + tm * dz
                    m = max(abs(qx), abs(qy), abs(qz))
                    cascade = 0
                    half, per_cell = np.float32(1.0), half_cells
                    while m > half and cascade < cascades - 1:
                        half *= np.float32(2.0)
                        per_cell *= np.float32(0.5)
                        cascade += 1
                    ix = min(max(np.int64((qx + half) * per_cell), 0), side - 1)
                    iy = min(max(np.int64((qy + half) * per_cell), 0), side - 1)
                    iz = min(max(np.int64((qz + half) * per_cell), 0), side - 1)
                    empty = 0  # log2 of the cells along a side of the empty block
                    if not blocks[cascade, ix >> shift, iy >> shift, iz >> shift]:
                        empty = shift
                    else:
                        word = words[cascade, ix >> 2, iy >> 2, iz >> 2]
                        if word == 0:
                            empty = word_shift
                        elif word >> ((ix & 3) | (iy & 3) << 2 | (iz & 3) << 4) & 1:
                            _contract(points, fall_off, count, qx, qy, qz)
                            middles[count], lengths[count] = tm, dt
                            count += 1
                            t += dt
                            continue
                    cell = np.float32(1 << empty) / per_cell
                    ix, iy, iz = ix >> empty, iy >> empty, iz >> empty
                    exit_length = min(
                        _cell_exit(ox, ivx, ix, cell, half),
                        _cell_exit(oy, ivy, iy, cell, half),
                        _cell_exit(oz, ivz, iz, cell, half),
                    )
                    # Whole steps, so that sample positions do not depend on the cells crossed.
                    skip = np.ceil((exit_length - tm) / dt)
                    t += dt * max(skip, np.float32(1.0))
                if count:
                    _densities(
                        points, fall_off, table, resolutions, w1, b1, w2, b2, features, sigma
                    )
                for i in range(count):
                    if sigma[0, i] * lengths[i] > min_tau:
                        rows[0, block, k] = middles[i]
                        rows[1, block, k] = lengths[i]
                        rows[2, block, k] = sigma[0, i]
                        tau += sigma[0, i] * lengths[i]
                        k += 1
                        if tau >= log_stop or k - first == capacity:
                            end = np.float32(-1.0)
                            break
            counts[r] = k - first


@njit(cache=True, parallel=True)
def pack(rows, offsets, out):
    """Join the blocks of samples that `march` wrote to rows [3, blocks, *] → out [3, samples]."""
    for block in prange((offsets.shape[0] - 2) // RAY_BLOCK + 1):
        start = offsets[block * RAY_BLOCK]
        stop = offsets[min(block * RAY_BLOCK + RAY_BLOCK, offsets.shape[0] - 1)]
        for kind in range(3):
            out[kind, start:stop] = rows[kind, block, : stop - start]


@njit(cache=True, fastmath=True, parallel=True)
def grid_positions(rays_o, rays_d, offsets, t, u):
    """Write the unit-cube coordinates (after contraction) of packed samples → u [samples,3]."""
    for r in prange(rays_o.shape[0]):
        for i in range(offsets[r], offsets[r + 1]):
            qx = rays_o[r, 0] + t[i] * rays_d[r, 0]
            qy = rays_o[r, 1] + t[i] * rays_d[r, 1]
            qz = rays_o[r, 2] + t[i] * rays_d[r, 2]
            m = np.sqrt(qx * qx + qy * qy + qz * qz)
            s = np.float32(_contract_scale(m)) * np.float32(0.25)
            half, low, high = np.float32(0.5), np.float32(0.0), np.float32(0.999999)
            u[i, 0] = min(max(qx * s + half, low), high)
            u[i, 1] = min(max(qy * s + half, low), high)
            u[i, 2] = min(max(qz * s + half, low), high)
