"""GPU kernels in Numba-CUDA, one thread a ray or a sample; `reference.py` specifies them.

Function by function the interface of `cpu.py`, on arrays of the device, but for what is packed or
turned for a CPU (`dispatch.cells_of`, `_cpu_net`). Nothing is compiled before
the first launch, and no compiler is needed on the machine. Launches go to the default stream, as
PyTorch's own do, so neither waits for the other. Numba's simulator runs the same code on the CPU
(NUMBA_ENABLE_CUDASIM=1), which is how it is tested without a GPU.
"""

# Numba's stubs take kernels for plain Python.
# pyright: reportCallIssue=false, reportArgumentType=false, reportAttributeAccessIssue=false

import math

import numpy as np
from numba import cuda, float32

THREADS = 128  # of a block
FEATURES = 64  # of an encoding, at most: they stay in the thread's own memory
PRIME_Y = np.uint32(2654435761)
PRIME_Z = np.uint32(805459861)
LEAST_TAU = np.float32(1e-3)  # samples thinner than this are left out


def launch(kernel, count: int, *arguments: object) -> None:
    """Runs a kernel with `count` threads or a few more."""
    if count:
        kernel[(count + THREADS - 1) // THREADS, THREADS](*arguments)


# --- Python's own min and max do not compile for CUDA from Numba 0.66 on -------------------------


@cuda.jit(device=True)
def _low(a, b):
    return a if a < b else b


@cuda.jit(device=True)
def _high(a, b):
    return a if a > b else b


# --- hash encoding -------------------------------------------------------------------------------


@cuda.jit(device=True)
def _corner(x, y, z, resolution, size):
    """Table row of a lattice corner: direct where the level fits its table, else hashed."""
    side = np.uint32(resolution + 1)
    if (resolution + 1) ** 3 <= size:
        return np.uint32(x + side * np.uint32(y + side * z))
    hashed = np.uint32(x ^ np.uint32(y * PRIME_Y)) ^ np.uint32(z * PRIME_Z)
    return np.uint32(hashed) & np.uint32(size - 1)


@cuda.jit(device=True)
def _row(ix, iy, iz, corner, resolution, size):
    """Table row of one of a cell's eight corners; bits 0 to 2 say which side on x, y and z."""
    x = np.uint32(ix + np.uint32(corner & 1))
    y = np.uint32(iy + np.uint32((corner >> 1) & 1))
    z = np.uint32(iz + np.uint32(corner >> 2))
    return _corner(x, y, z, resolution, size)


@cuda.jit(device=True)
def _cell(ux, uy, uz, resolution):
    """Lattice cell of a point and the place in it."""
    scale = np.float32(resolution)
    px, py, pz = ux * scale, uy * scale, uz * scale
    ix, iy, iz = np.uint32(px), np.uint32(py), np.uint32(pz)
    return ix, iy, iz, px - np.float32(ix), py - np.float32(iy), pz - np.float32(iz)


@cuda.jit(device=True)
def _side(f, upper):
    """Weight of a cell's lower or upper side for a point a share f across it."""
    return f if upper else np.float32(1.0) - f


@cuda.jit(device=True)
def _encode(ux, uy, uz, table, level, resolution, features):
    """Trilinear interpolation of one level's two features, into features[2 level : 2 level + 2]."""
    ix, iy, iz, fx, fy, fz = _cell(ux, uy, uz, resolution)
    first, second = np.float32(0.0), np.float32(0.0)
    for corner in range(8):
        dx, dy, dz = corner & 1, (corner >> 1) & 1, corner >> 2
        weight = _side(fx, dx) * _side(fy, dy) * _side(fz, dz)
        row = _row(ix, iy, iz, corner, resolution, table.shape[1])
        first += weight * table[level, row, 0]
        second += weight * table[level, row, 1]
    features[2 * level] = first
    features[2 * level + 1] = second


@cuda.jit
def _hash_encode(u, table, resolutions, out):
    i = cuda.grid(1)
    n = u.shape[0]
    if i < n * table.shape[0]:
        level, p = i // n, i % n  # neighbouring threads take neighbouring points
        pair = cuda.local.array(FEATURES, float32)
        _encode(u[p, 0], u[p, 1], u[p, 2], table, level, resolutions[level], pair)
        out[2 * level, p] = pair[2 * level]
        out[2 * level + 1, p] = pair[2 * level + 1]


def hash_encode(u, table, resolutions, out) -> None:
    """Features of n points: u [n,3] in [0,1), table [L,T,2] → out [2L,n]."""
    launch(_hash_encode, u.shape[0] * table.shape[0], u, table, resolutions, out)


@cuda.jit
def _hash_encode_backward(u, grad_out, resolutions, grad_table):
    i = cuda.grid(1)
    n = u.shape[0]
    if i < n * grad_table.shape[0]:
        level, p = i // n, i % n
        ga, gb = grad_out[2 * level, p], grad_out[2 * level + 1, p]
        if ga != 0.0 or gb != 0.0:
            resolution = resolutions[level]
            ix, iy, iz, fx, fy, fz = _cell(u[p, 0], u[p, 1], u[p, 2], resolution)
            for corner in range(8):
                dx, dy, dz = corner & 1, (corner >> 1) & 1, corner >> 2
                weight = _side(fx, dx) * _side(fy, dy) * _side(fz, dz)
                row = _row(ix, iy, iz, corner, resolution, grad_table.shape[1])
                cuda.atomic.add(grad_table, (level, row, 0), weight * ga)
                cuda.atomic.add(grad_table, (level, row, 1), weight * gb)


def hash_encode_backward(u, grad_out, resolutions, grad_table) -> None:
    """Adds the gradient of `hash_encode` to grad_table [L,T,2]; the sum's order is not fixed."""
    count = u.shape[0] * grad_table.shape[0]
    launch(_hash_encode_backward, count, u, grad_out, resolutions, grad_table)


@cuda.jit
def _hash_encode_slopes(u, grad_out, table, resolutions, grad_u):
    p = cuda.grid(1)
    if p < u.shape[0]:
        one = np.float32(1.0)
        tx, ty, tz = np.float32(0.0), np.float32(0.0), np.float32(0.0)
        for level in range(table.shape[0]):
            resolution = resolutions[level]
            ga, gb = grad_out[2 * level, p], grad_out[2 * level + 1, p]
            ix, iy, iz, fx, fy, fz = _cell(u[p, 0], u[p, 1], u[p, 2], resolution)
            for corner in range(8):
                dx, dy, dz = corner & 1, (corner >> 1) & 1, corner >> 2
                row = _row(ix, iy, iz, corner, resolution, table.shape[1])
                value = np.float32(resolution) * (
                    ga * table[level, row, 0] + gb * table[level, row, 1]
                )
                wx, wy, wz = _side(fx, dx), _side(fy, dy), _side(fz, dz)
                tx += value * wy * wz * (one if dx else -one)
                ty += value * wx * wz * (one if dy else -one)
                tz += value * wx * wy * (one if dz else -one)
        grad_u[p, 0], grad_u[p, 1], grad_u[p, 2] = tx, ty, tz


def hash_encode_slopes(u, grad_out, table, resolutions, grad_u) -> None:
    """Gradient of `hash_encode` to the positions: grad_out [2L,n] → grad_u [n,3]."""
    launch(_hash_encode_slopes, u.shape[0], u, grad_out, table, resolutions, grad_u)


# --- density and marching ------------------------------------------------------------------------


@cuda.jit(device=True)
def _unit_cube(qx, qy, qz, u):
    """Contraction into the unit cube, → u [3]; returns the distance from the centre."""
    m = math.sqrt(qx * qx + qy * qy + qz * qz)
    one, two, quarter = np.float32(1.0), np.float32(2.0), np.float32(0.25)
    s = quarter * (one if m <= one else (two - one / m) / m)
    half, low, high = np.float32(0.5), np.float32(0.0), np.float32(0.999999)
    u[0] = _low(_high(qx * s + half, low), high)
    u[1] = _low(_high(qy * s + half, low), high)
    u[2] = _low(_high(qz * s + half, low), high)
    return m


@cuda.jit(device=True)
def _density(q, net, u, features):
    """Density (1/grid unit) at q [3]; u [3] and features are room to work in, u its coordinates."""
    table, resolutions, w1, b1, w2, b2 = net
    m = _unit_cube(q[0], q[1], q[2], u)
    for level in range(table.shape[0]):
        _encode(u[0], u[1], u[2], table, level, resolutions[level], features)
    raw = b2[0]
    for j in range(w1.shape[1]):
        h = b1[j]
        for i in range(w1.shape[0]):
            h += features[i] * w1[i, j]
        raw += _high(h, np.float32(0.0)) * w2[j, 0]
    return math.exp(_low(raw, np.float32(15.0))) / _high(m * m, np.float32(1.0))


@cuda.jit
def _density_at(q, net, out):
    p = cuda.grid(1)
    if p < q.shape[0]:
        u = cuda.local.array(3, float32)
        features = cuda.local.array(FEATURES, float32)
        out[p] = _density(q[p], net, u, features)


def density_at(q, net, out) -> None:
    """Density (1/grid unit) at q [n,3] in grid units → out [n]."""
    launch(_density_at, q.shape[0], q, net, out)


@cuda.jit(device=True)
def _exit(o, d, index, cell, half):
    """Ray length at which the ray leaves the lattice cell of side `cell`, along one axis."""
    if d == np.float32(0.0):
        return np.float32(1e30)
    return (np.float32(index + 1 if d > 0 else index) * cell - half - o) / d


@cuda.jit(device=True)
def _next(o, d, t, end, cells, steps, place):
    """The next step in an occupied cell: its start, or `end` if there is none; place [4] gets its
    middle and the step's length."""
    occupied, blocks = cells
    cascades, side = occupied.shape[0], occupied.shape[1]
    size = side // blocks.shape[1]
    dt_min, cone = np.float32(steps[0]), np.float32(steps[1])
    one, two = np.float32(1.0), np.float32(2.0)
    while t < end:
        dt = _low(_high(dt_min, cone * t), end - t)
        tm = t + np.float32(0.5) * dt
        qx, qy, qz = o[0] + tm * d[0], o[1] + tm * d[1], o[2] + tm * d[2]
        m = _high(_high(abs(qx), abs(qy)), abs(qz))
        cascade, half = 0, one
        while m > half and cascade < cascades - 1:
            half *= two
            cascade += 1
        cell = two * half / np.float32(side)
        ix = _low(_high(int((qx + half) / cell), 0), side - 1)
        iy = _low(_high(int((qy + half) / cell), 0), side - 1)
        iz = _low(_high(int((qz + half) / cell), 0), side - 1)
        if not blocks[cascade, ix // size, iy // size, iz // size]:
            cell *= np.float32(size)
            ix, iy, iz = ix // size, iy // size, iz // size
        elif occupied[cascade, ix, iy, iz]:
            place[0], place[1], place[2], place[3] = qx, qy, qz, dt
            return t
        leave = _exit(o[0], d[0], ix, cell, half)
        leave = _low(leave, _exit(o[1], d[1], iy, cell, half))
        leave = _low(leave, _exit(o[2], d[2], iz, cell, half))
        # Whole steps, so that the sampling comb does not depend on the cells crossed.
        t += dt * _high(np.float32(math.ceil((leave - tm) / dt)), one)
    return end


@cuda.jit(device=True)
def _clip(o, d, far, span):
    """Cuts span [2] to the part of the ray within the outermost cube."""
    for axis in range(3):
        if d[axis] == np.float32(0.0):
            if o[axis] < -far or o[axis] > far:
                span[1] = np.float32(-1.0)
        else:
            a, b = (-far - o[axis]) / d[axis], (far - o[axis]) / d[axis]
            span[0] = _high(span[0], _low(a, b))
            span[1] = _low(span[1], _high(a, b))


@cuda.jit(device=True)
def _begin(rays, r, spans, cells, steps, o, d, span):
    """Ray r into o and d [3]; into span [2] where its comb begins and ends in the cells."""
    for axis in range(3):
        o[axis], d[axis] = rays[0][r, axis], rays[1][r, axis]
    span[0], span[1] = spans[r, 0], spans[r, 1]
    _clip(o, d, np.float32(2.0 ** (cells[0].shape[0] - 1)), span)
    span[0] += spans[r, 2] * _high(np.float32(steps[0]), np.float32(steps[1]) * span[0])


@cuda.jit
def _march(rays, spans, cells, steps, stop, net, rows, counts):
    r = cuda.grid(1)
    if r >= spans.shape[0]:
        return
    o, d = cuda.local.array(3, float32), cuda.local.array(3, float32)
    u, span = cuda.local.array(3, float32), cuda.local.array(2, float32)
    place, features = cuda.local.array(4, float32), cuda.local.array(FEATURES, float32)
    _begin(rays, r, spans, cells, steps, o, d, span)
    t, end = span[0], span[1]
    tau, enough = np.float32(0.0), np.float32(-math.log(stop))
    k, capacity = 0, rows.shape[1]
    while k < capacity and tau < enough:
        t = _next(o, d, t, end, cells, steps, place)
        if t >= end:
            break
        dt = place[3]
        sigma = _density(place, net, u, features)
        if sigma * dt > LEAST_TAU:
            # By step, then by ray: neighbouring threads write side by side.
            rows[0, k, r] = t + np.float32(0.5) * dt
            rows[1, k, r] = dt
            rows[2, k, r] = sigma
            tau += sigma * dt
            k += 1
        t += dt
    counts[r] = k


def march(rays_o, rays_d, spans, cells, steps, stop, net, rows, counts) -> None:
    """Marches rays front to back through occupied space, evaluating density on the way.

    Args: rays [n,3] in grid units; spans [n,3]: first and last length, share of the first step;
    cells = (occupied [K,G,G,G], the same for blocks); steps = (smallest step, step per length);
    stop = transmittance at which a ray ends; net = (table, resolutions, w1, b1, w2, b2).
    rows [3, capacity, n] receive t, dt and sigma, counts [n] how many.
    """
    launch(_march, spans.shape[0], (rays_o, rays_d), spans, cells, steps, stop, net, rows, counts)


@cuda.jit
def _pack(rows, offsets, out):
    r = cuda.grid(1)
    if r < offsets.shape[0] - 1:
        for k in range(offsets[r + 1] - offsets[r]):
            for kind in range(3):
                out[kind, offsets[r] + k] = rows[kind, k, r]


def pack(rows, offsets, out) -> None:
    """Packs what `march` has left in rows into out [3, samples]."""
    launch(_pack, offsets.shape[0] - 1, rows, offsets, out)


@cuda.jit
def _grid_positions(rays_o, rays_d, offsets, t, out):
    r = cuda.grid(1)
    if r < rays_o.shape[0]:
        u = cuda.local.array(3, float32)
        for i in range(offsets[r], offsets[r + 1]):
            _unit_cube(
                rays_o[r, 0] + t[i] * rays_d[r, 0],
                rays_o[r, 1] + t[i] * rays_d[r, 1],
                rays_o[r, 2] + t[i] * rays_d[r, 2],
                u,
            )
            out[i, 0], out[i, 1], out[i, 2] = u[0], u[1], u[2]


def grid_positions(rays_o, rays_d, offsets, t, u) -> None:
    """Unit-cube coordinates (after contraction) of packed samples: → u [samples,3]."""
    launch(_grid_positions, rays_o.shape[0], rays_o, rays_d, offsets, t, u)


# --- compositing: a thread a ray -----------------------------------------------------------------


@cuda.jit
def _weights_forward(tau, offsets, weights, transmittance):
    r = cuda.grid(1)
    if r < offsets.shape[0] - 1:
        total = np.float32(0.0)
        for i in range(offsets[r], offsets[r + 1]):
            before = math.exp(-total)
            total += tau[i]
            weights[i] = before * -math.expm1(-tau[i])
        transmittance[r] = math.exp(-total)


def weights_forward(tau, offsets, weights, transmittance) -> None:
    """Rendering weights of packed samples with optical depths tau; transmittance left per ray."""
    launch(_weights_forward, offsets.shape[0] - 1, tau, offsets, weights, transmittance)


@cuda.jit
def _weights_backward(tau, offsets, grad_w, grad_t, grad_tau):
    r = cuda.grid(1)
    if r < offsets.shape[0] - 1:
        total = np.float32(0.0)
        for i in range(offsets[r], offsets[r + 1]):
            total += tau[i]
        behind = grad_t[r] * math.exp(-total)
        for i in range(offsets[r + 1] - 1, offsets[r] - 1, -1):
            after = math.exp(-total)
            total -= tau[i]
            grad_tau[i] = grad_w[i] * after - behind
            behind += grad_w[i] * math.exp(-total) * -math.expm1(-tau[i])


def weights_backward(tau, offsets, grad_w, grad_t, grad_tau) -> None:
    """Gradient of `weights_forward`."""
    launch(_weights_backward, offsets.shape[0] - 1, tau, offsets, grad_w, grad_t, grad_tau)


@cuda.jit
def _accumulate_forward(weights, values, offsets, out):
    i = cuda.grid(1)
    channels = values.shape[1]
    if i < (offsets.shape[0] - 1) * channels:
        r, c = i // channels, i % channels
        total = np.float32(0.0)
        for k in range(offsets[r], offsets[r + 1]):
            total += weights[k] * values[k, c]
        out[r, c] = total


def accumulate_forward(weights, values, offsets, out) -> None:
    """Sum over each ray of weights [s] · values [s,c] → out [rays,c]."""
    count = (offsets.shape[0] - 1) * values.shape[1]
    launch(_accumulate_forward, count, weights, values, offsets, out)


@cuda.jit
def _accumulate_backward(weights, values, offsets, grad_out, grad_w, grad_v):
    r = cuda.grid(1)
    if r < offsets.shape[0] - 1:
        for i in range(offsets[r], offsets[r + 1]):
            total = np.float32(0.0)
            for c in range(values.shape[1]):
                total += grad_out[r, c] * values[i, c]
                grad_v[i, c] = grad_out[r, c] * weights[i]
            grad_w[i] = total


def accumulate_backward(weights, values, offsets, grad_out, grad_w, grad_v) -> None:
    """Gradient of `accumulate_forward`."""
    count = offsets.shape[0] - 1
    launch(_accumulate_backward, count, weights, values, offsets, grad_out, grad_w, grad_v)


@cuda.jit
def _distortion_forward(weights, s, ds, offsets, out):
    r = cuda.grid(1)
    if r < offsets.shape[0] - 1:
        two, third = np.float32(2.0), np.float32(1.0 / 3.0)
        total, w_sum, ws_sum = np.float32(0.0), np.float32(0.0), np.float32(0.0)
        for i in range(offsets[r], offsets[r + 1]):
            total += two * weights[i] * (s[i] * w_sum - ws_sum)
            total += weights[i] * weights[i] * ds[i] * third
            w_sum += weights[i]
            ws_sum += weights[i] * s[i]
        out[r] = total


def distortion_forward(weights, s, ds, offsets, out) -> None:
    """Distortion loss per ray, in linear time (DVGOv2); see `reference.distortion`."""
    launch(_distortion_forward, offsets.shape[0] - 1, weights, s, ds, offsets, out)


@cuda.jit
def _distortion_backward(weights, s, ds, offsets, grad_out, grad_w):
    r = cuda.grid(1)
    if r < offsets.shape[0] - 1:
        two, third = np.float32(2.0), np.float32(1.0 / 3.0)
        w_all, ws_all = np.float32(0.0), np.float32(0.0)
        for i in range(offsets[r], offsets[r + 1]):
            w_all += weights[i]
            ws_all += weights[i] * s[i]
        w_sum, ws_sum = np.float32(0.0), np.float32(0.0)
        for i in range(offsets[r], offsets[r + 1]):
            w, p = weights[i], s[i]
            before = p * w_sum - ws_sum
            w_sum += w
            ws_sum += w * p
            after = (ws_all - ws_sum) - p * (w_all - w_sum)
            grad_w[i] = grad_out[r] * two * (before + after + w * ds[i] * third)


def distortion_backward(weights, s, ds, offsets, grad_out, grad_w) -> None:
    """Gradient of `distortion_forward` to the weights."""
    count = offsets.shape[0] - 1
    launch(_distortion_backward, count, weights, s, ds, offsets, grad_out, grad_w)


@cuda.jit
def _merge_order(t_a, offsets_a, t_b, offsets_b, offsets, order):
    r = cuda.grid(1)
    if r < offsets.shape[0] - 1:
        i, j, shift = offsets_a[r], offsets_b[r], t_a.shape[0]
        for k in range(offsets[r], offsets[r + 1]):
            if j >= offsets_b[r + 1] or (i < offsets_a[r + 1] and t_a[i] <= t_b[j]):
                order[k] = i
                i += 1
            else:
                order[k] = shift + j
                j += 1


def merge_order(t_a, offsets_a, t_b, offsets_b, offsets, order) -> None:
    """Order that merges two packed sample lists by t; indices ≥ len(t_a) mean list b."""
    launch(_merge_order, offsets.shape[0] - 1, t_a, offsets_a, t_b, offsets_b, offsets, order)


# --- the optimiser's -----------------------------------------------------------------------------


@cuda.jit
def _adam(parameter, gradient, first, second, rates):
    i = cuda.grid(1)
    if i < parameter.shape[0]:
        g = gradient[i]
        if g != np.float32(0.0):
            rate, beta1, beta2, epsilon, correction1, correction2 = rates
            one = np.float32(1.0)
            m = beta1 * first[i] + (one - beta1) * g
            v = beta2 * second[i] + (one - beta2) * g * g
            first[i] = m
            second[i] = v
            parameter[i] -= rate * (m / correction1) / (math.sqrt(v / correction2) + epsilon)
            gradient[i] = np.float32(0.0)


def adam(parameter, gradient, first, second, *rates) -> None:
    """One Adam step over flat arrays that leaves entries without gradient untouched.

    Rates: rate, beta1, beta2, epsilon, and the corrections of both moments.
    """
    launch(_adam, parameter.shape[0], parameter, gradient, first, second, rates)
