"""Metaball sums over a sparse lattice, and rays marched through them. CPU, in Numba.

The slow twin is `ops.metaballs_reference`. Kernels compute lengths in lattice spacings.

A lattice consists of cascades: squares in x and y around one centre, each with twice the spacing
and twice the side of the one before, all over the full height. A position belongs to the finest
cascade that contains it. Vertices are stored in bricks of 8 x 8 x 8 cells: a brick holds the
vertices -1 to 9 along each axis relative to its corner, because balls of those reach its cells.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int
from numba import njit, prange

from climatenerf.ops.cpu.simd_metaballs import BALL_SUPPORT, ball_means, ball_sums
from climatenerf.ops.step_limits import MAX_METABALL_STEPS

SIMD_DIGEST = "ee9d1f67a672"  # of `simd.py` and `simd_metaballs.py`; the former explains why
BRICK = 8
"""Cells along a brick's side."""
STORED = BRICK + 3
"""Vertices along a brick's side that are stored."""
SUPPORT = BALL_SUPPORT
"""Radius 1.5 R of the kernel's support, lattice spacings."""
RADIUS = SUPPORT / 1.5
"""R of the kernel, lattice spacings (measured in docs/adr/0016)."""
THRESHOLD = 0.497
"""tau, the sum at the surface. That of a half-space is 0.5; the 0.003 compensate for rays that end
0.006 spacings, at every spacing, below the surface."""
SHARPNESS = 100.0
"""a, the steepness of the logistic from sum to density."""
HEIGHT_UNIT = 1 / 128
"""Unit of `Lattice.height`, in lattice spacings."""
MAX_SAMPLES = 24
"""Capacity of a ray."""

LOW = 0.42
"""Sum below which the density is less than a thousandth of that inside."""
_SLOPE_BOUND = 0.75  # upper bound of a sum's slope per spacing (measured by a test)
_CURVATURE_BOUND = 1.1  # of its second derivative along any line, per spacing squared (likewise)
_SLOPE_BIAS = 0.545  # c of `_slope_bias`, spacings
_SAMPLE_DEPTH = 0.5  # optical depth that is merged into one sample
_OPAQUE = 7.0  # optical depth at which a ray ends: exp(-7) < 1e-3
# Without nnan and ninf: t_max may be infinite.
_FAST = {"contract", "reassoc", "arcp", "nsz"}


class Lattice(NamedTuple):
    """Cascades of bricks, in a named tuple because Numba accepts that as an argument."""

    lower: Float[np.ndarray, "k 3"]
    """Position of vertex (0, 0, 0) of each cascade, m. The outermost bricks are a margin."""
    spacing: Float[np.ndarray, "k"]
    """Lattice spacing, m; doubles from one cascade to the next."""
    bricks: Int[np.ndarray, "k 3"]
    """Number of bricks along x, y, z."""
    start: Int[np.ndarray, "k"]
    """Offset of each cascade in `index`."""
    index: Int[np.ndarray, "i"]
    """Brick at (x, y, z), z fastest; -1: empty."""
    fill: np.ndarray
    """[b, 11, 11, 11] uint8: filled fraction f of a vertex's surroundings, in 1/255."""
    height: np.ndarray
    """int16: mean height of the vertex above the ground of the columns around, in HEIGHT_UNIT
    spacings; in deep snow columns that it lies far below count less."""
    shade: np.ndarray
    """uint8, in 1/255: what `weather.snow.lattice.Catch` calls shade."""
    band: np.ndarray
    """[b, 2] uint8: first and last layer of cells; outside them all sums of the brick are low."""
    near: np.ndarray
    """[b, 8, 8] uint8: bit m is set if sums in the cell (x, y, m) may exceed `LOW`."""
    burial: Float[np.ndarray, "k"]
    """Depth below the ground at which the snow ends, m."""
    floor: float = -math.inf
    """World z of the lowest ground that carries snow, m: a water level."""


def occupied_cells(fill: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return `Lattice.band` and `Lattice.near` of `Lattice.fill`.

    The sum in a cell is a mean over the vertices from one below to two above it along each axis:
    where all of them are low, so is the sum.
    """
    cells = fill >= LOW * 255
    for axis in (1, 2, 3):
        cells = np.lib.stride_tricks.sliding_window_view(cells, 4, axis).any(-1)
    near = np.packbits(cells, axis=-1, bitorder="little")[..., 0]
    layers = np.pad(cells.max((1, 2), initial=False), ((0, 0), (0, 1)))
    first = layers.argmax(1)
    last = np.where(layers.any(1), BRICK + 1 - layers[:, ::-1].argmax(1), 0)
    return np.stack([first, last], 1).astype(np.uint8), near


def spacing_at(points: Float32[np.ndarray, "n 3"], lattice: Lattice) -> Float32[np.ndarray, "n"]:
    """Spacing of the finest cascade that contains each point, m; outside all, of the coarsest."""
    found = np.full(len(points), lattice.spacing[-1], np.float32)
    for k in reversed(range(len(lattice.spacing))):
        brick = BRICK * lattice.spacing[k]
        # The outermost bricks are a margin, as in `_find`.
        lower = lattice.lower[k, :2] + brick
        upper = lattice.lower[k, :2] + (lattice.bricks[k, :2] - 1) * brick
        inside = ((points[:, :2] >= lower) & (points[:, :2] < upper)).all(1)
        found[inside] = lattice.spacing[k]
    return found


@njit(cache=True, fastmath=_FAST, inline="always")
def _find(lattice, x, y, z):
    """Return the finest cascade that contains a position, and its brick there (-1: none)."""
    for k in range(lattice.spacing.shape[0]):
        h = lattice.spacing[k]
        i = math.floor((x - lattice.lower[k, 0]) / (h * BRICK))
        j = math.floor((y - lattice.lower[k, 1]) / (h * BRICK))
        # The outermost bricks only provide vertices for those inside.
        if i < 1 or j < 1 or i >= lattice.bricks[k, 0] - 1 or j >= lattice.bricks[k, 1] - 1:
            continue
        m = math.floor((z - lattice.lower[k, 2]) / (h * BRICK))
        if m < 0 or m >= lattice.bricks[k, 2]:
            return k, -1, i, j, m
        at = (i * lattice.bricks[k, 1] + j) * lattice.bricks[k, 2] + m
        return k, lattice.index[lattice.start[k] + at], i, j, m
    return -1, -1, 0, 0, 0


@njit(cache=True, fastmath=_FAST, inline="always")
def _sum(lattice, brick, px, py, pz):
    """Return the normalised sum and its gradient per spacing; p from the brick's corner."""
    i, j, m = int(px), int(py), int(pz)
    i, j, m = min(max(i, 0), BRICK - 1), min(max(j, 0), BRICK - 1), min(max(m, 0), BRICK - 1)
    ux, uy, uz = np.float32(px - i), np.float32(py - j), np.float32(pz - m)
    bottom, top, bx, by, bz, tx, ty, tz = ball_sums(lattice.fill, brick, i, j, m, ux, uy, uz)
    s = top / bottom
    scale = np.float32(-6.0 / 255.0) / bottom
    return (
        s * np.float32(1 / 255.0),
        (tx - s * bx) * scale,
        (ty - s * by) * scale,
        (tz - s * bz) * scale,
    )


@njit(cache=True, fastmath=_FAST)
def _means(lattice, brick, px, py, pz):
    """Return height above the ground (spacings) and brightness, as kernel-weighted means.

    The height is that of the position: the mean ground height is subtracted from it.
    """
    i, j, m = int(px), int(py), int(pz)
    i, j, m = min(max(i, 0), BRICK - 1), min(max(j, 0), BRICK - 1), min(max(m, 0), BRICK - 1)
    ux, uy, uz = np.float32(px - i), np.float32(py - j), np.float32(pz - m)
    total, over, dz, shade = ball_means(
        lattice.fill, lattice.height, lattice.shade, brick, i, j, m, ux, uy, uz
    )
    height = over * np.float32(HEIGHT_UNIT) + dz
    if total <= np.float32(0):  # no filled vertex in the support: 0 / 0 would give NaN
        return np.float32(0), np.float32(1)
    return height / total, shade / (total * np.float32(255))


@njit(cache=True, fastmath=_FAST, inline="always")
def _slope_bias(gx, gy, gz):
    """Return by how much `_means` underestimates a height on a slope, from the sum's gradient.

    The mean is over filled vertices, which lie uphill of a position on a slope, on higher ground:
    c sin(slope) tan(slope) spacings, with c measured on planes of 10 to 60 degrees (a test does).
    0 on the sides of the snow, which are no slopes, and inside of it, where the gradient is short.
    """
    length = math.sqrt(gx * gx + gy * gy + gz * gz)
    if length < 1e-9:  # no gradient: 0/0
        return 0.0
    up = -gz / length
    surface = min(max((length - 0.3) / 0.15, 0.0), 1.0)  # at a half-space's it is 1/2
    slope = min(max((up - 0.4) / 0.1, 0.0), 1.0)
    up = max(up, 0.5)
    return surface * slope * _SLOPE_BIAS * (1 / up - up)


@njit(cache=True, fastmath=_FAST, inline="always")
def _extinction(s, h):
    """Return the density O = sigma0 s sigmoid(a (s - tau)), 1/m.

    The sum of a half-space rises by about 1/2 per spacing. With sigma0 = a / spacing a ray that
    enters it at a right angle loses half of its light at s = tau, whatever the spacing.
    """
    return SHARPNESS / h * s / (1 + math.exp(-SHARPNESS * (s - THRESHOLD)))


@njit(cache=True, parallel=True, fastmath=_FAST)
def evaluate(
    points: Float32[np.ndarray, "n 3"], lattice: Lattice
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the metaball sum, and the means of what the lattice stores, at points.

    Args:
        points: positions, m.
        lattice: the cascades.

    Returns:
        float32 arrays: the normalised sum s [n]; its gradient [n, 3], 1/m; and [n, 3]: height above
        the ground, m, brightness, and density O, 1/m, which is 0 below the ground and where s is
        low.
    """
    n = points.shape[0]
    sums = np.zeros(n, np.float32)
    gradients = np.zeros((n, 3), np.float32)
    means = np.zeros((n, 3), np.float32)
    for r in prange(n):
        x, y, z = np.float64(points[r, 0]), np.float64(points[r, 1]), np.float64(points[r, 2])
        means[r, 1] = 1
        k, brick, i, j, m = _find(lattice, x, y, z)
        if brick < 0:
            continue
        h = lattice.spacing[k]
        px = (x - lattice.lower[k, 0]) / h - i * BRICK
        py = (y - lattice.lower[k, 1]) / h - j * BRICK
        pz = (z - lattice.lower[k, 2]) / h - m * BRICK
        s, gx, gy, gz = _sum(lattice, brick, px, py, pz)
        sums[r] = s
        gradients[r, 0], gradients[r, 1], gradients[r, 2] = gx / h, gy / h, gz / h
        height, shade = _means(lattice, brick, px, py, pz)
        height += _slope_bias(gx, gy, gz)
        means[r, 0], means[r, 1] = height * h, shade
        above_ground = height * h > -lattice.burial[k] and z - height * h >= lattice.floor
        if s >= LOW and above_ground:  # as along rays
            means[r, 2] = _extinction(s, h)
    return sums, gradients, means


@njit(cache=True, parallel=True, fastmath=_FAST)
def smooth_surface(
    points: Float32[np.ndarray, "n 3"], lattice: Lattice, with_heights: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Return unit normals [n, 3] and heights over the ground [n] (m) of surfaces, for shading.

    Without heights these are 0, and it takes half as long.

    Columns of one spacing leave ripples of that length on slopes. Means over four positions on the
    surface, half a spacing apart along x and y, have none of them. Where there is no snow normals
    point up, and heights are 0.
    """
    n = points.shape[0]
    normals = np.zeros((n, 3), np.float32)
    heights = np.zeros(n, np.float32)
    for r in prange(n):
        x, y, z = np.float64(points[r, 0]), np.float64(points[r, 1]), np.float64(points[r, 2])
        gx, gy, gz, _, h = _gradient(lattice, x, y, z, False)
        # Along the surface; not on the sides of the snow, where it is too steep.
        rise_x, rise_y = 0.0, 0.0
        if gz < -0.3 * math.sqrt(gx * gx + gy * gy + gz * gz):
            rise_x, rise_y = -gx / gz, -gy / gz
        sx, sy, sz, total, known = 0.0, 0.0, 0.0, 0.0, 0.0
        # Ripples of steep slopes have the lattice's period in z.
        step = 0.25 * h / max(1.0, math.sqrt(rise_x * rise_x + rise_y * rise_y))
        for a in (-1, 1):
            for b in (-1, 1):
                dx, dy = a * step, b * step
                at = x + dx, y + dy, z + dx * rise_x + dy * rise_y
                gx, gy, gz, height, inside = _gradient(lattice, *at, with_heights)
                sx, sy, sz = sx + gx, sy + gy, sz + gz
                if inside > 0:
                    total, known = total + height, known + 1
        heights[r] = total / max(known, 1.0)
        length = math.sqrt(sx * sx + sy * sy + sz * sz)
        if length < 1e-6:  # no gradient: 0/0
            normals[r, 2] = 1.0
            continue
        normals[r, 0], normals[r, 1], normals[r, 2] = -sx / length, -sy / length, -sz / length
    return normals, heights


@njit(cache=True, fastmath=_FAST)
def _gradient(lattice, x, y, z, with_height):
    """Return at a position the sum's gradient per spacing, height (m) and spacing; 0 outside."""
    k, brick, i, j, m = _find(lattice, x, y, z)
    if brick < 0:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    h = lattice.spacing[k]
    px = (x - lattice.lower[k, 0]) / h - i * BRICK
    py = (y - lattice.lower[k, 1]) / h - j * BRICK
    pz = (z - lattice.lower[k, 2]) / h - m * BRICK
    _, gx, gy, gz = _sum(lattice, brick, px, py, pz)
    height = 0.0
    if with_height:
        height = _means(lattice, brick, px, py, pz)[0] + _slope_bias(gx, gy, gz)
    return np.float64(gx), np.float64(gy), np.float64(gz), height * h, h


@njit(cache=True, fastmath=_FAST)
def _to_band(px, py, pz, d, low, high):
    """Return the length (spacings) to a brick's band of layers, or out of the brick if shorter."""
    length = np.inf
    for p, c in ((px, d[0]), (py, d[1]), (pz, d[2])):
        if c != 0:
            length = min(length, ((BRICK if c > 0 else 0) - p) / c)
    if d[2] != 0:
        rise = (low if pz < low else high) - pz
        if rise * d[2] > 0:
            length = min(length, rise / d[2])
    return max(length, 0.0)


@njit(cache=True, fastmath=_FAST)
def _to_face(ux, uy, uz, d):
    """Return the length (spacings) from a position in a cell to its boundary."""
    length = np.inf
    for p, c in ((ux, d[0]), (uy, d[1]), (uz, d[2])):
        if c != 0:
            length = min(length, ((1 if c > 0 else 0) - p) / c)
    return max(length, 0.0)


@njit(cache=True, fastmath=_FAST, inline="always")
def _step_below(rise, slope):
    """Return a length (spacings) over which the sum rises by less than `rise`, above 0.

    The larger of what the bounds of slope and second derivative allow. Along a surface, where the
    slope is short, the second is some times longer.
    """
    if rise <= 0:
        return 0.0
    root = math.sqrt(slope * slope + 2 * _CURVATURE_BOUND * rise)
    return max(rise / _SLOPE_BOUND, (root - slope) / _CURVATURE_BOUND)


@njit(cache=True, fastmath=_FAST)
def _march_ray(lattice, o, d, t, end, out_t, out_dt, out_sigma):
    """Write the samples of one ray to the given rows; return their number."""
    n = 0
    depth = 0.0  # optical depth so far
    group, moment, first, last = 0.0, 0.0, 0.0, 0.0
    k, brick, h, per = -1, -1, 0.0, 0.0
    cx, cy, cz = 0.0, 0.0, 0.0  # the brick's corner
    steps_left = MAX_METABALL_STEPS
    while t < end and depth < _OPAQUE and steps_left > 0:
        steps_left -= 1
        x, y, z = o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]
        px, py, pz = (x - cx) * per, (y - cy) * per, (z - cz) * per
        # Most steps stay in their brick. In the finest cascade no finer brick can be there.
        inside = min(px, py, pz) >= 0 and max(px, py, pz) < BRICK
        if not (k == 0 and brick >= 0 and inside):
            k, brick, i, j, m = _find(lattice, x, y, z)
            if k < 0:
                break  # outside the outermost cascade, to which `march` clips the ray
            h = lattice.spacing[k]
            side, per = h * BRICK, 1 / h
            cx = lattice.lower[k, 0] + i * side
            cy = lattice.lower[k, 1] + j * side
            cz = lattice.lower[k, 2] + m * side
            px, py, pz = (x - cx) * per, (y - cy) * per, (z - cz) * per
        if brick < 0:
            step = np.inf
            for axis, face in ((0, cx), (1, cy), (2, cz)):
                if d[axis] != 0:
                    edge = face + (h * BRICK if d[axis] > 0 else 0.0)
                    step = min(step, (edge - o[axis]) / d[axis] - t)
            t += max(step, 0.0) + 1e-3 * h
            sigma, step = 0.0, 0.0
        else:
            # Rounding may give 8 at the upper face of the last cell.
            i, j, m = min(int(px), BRICK - 1), min(int(py), BRICK - 1), min(int(pz), BRICK - 1)
            if pz < lattice.band[brick, 0] or pz > lattice.band[brick, 1]:
                t += _to_band(px, py, pz, d, lattice.band[brick, 0], lattice.band[brick, 1]) * h
                t += 1e-3 * h
                s, sigma, step = 0.0, 0.0, 0.0
            elif not lattice.near[brick, i, j] >> m & 1:
                t += _to_face(px - i, py - j, pz - m, d) * h + 1e-3 * h
                s, sigma, step = 0.0, 0.0, 0.0
            else:
                s, gx, gy, gz = _sum(lattice, brick, px, py, pz)
                slope = gx * d[0] + gy * d[1] + gz * d[2]
                sigma, step = 0.0, max(_step_below(LOW - s, slope), 0.05) * h
            if s >= LOW:
                step = min(max(0.025 / max(abs(slope), 1e-6), 0.01), 0.15) * h
                step = min(step, end - t)
                height = _means(lattice, brick, px, py, pz)[0] + _slope_bias(gx, gy, gz)
                if height * h > -lattice.burial[k] and z - height * h >= lattice.floor:
                    sigma = _extinction(s + slope * step / h / 2, h)
            t += step
        if sigma > 0:
            if group == 0:
                first = t - step
            last = t
            group += sigma * step
            moment += sigma * step * (t - step / 2)
            depth += sigma * step
        if group > 0 and (sigma == 0 or group > _SAMPLE_DEPTH or depth >= _OPAQUE or t >= end):
            if group > 1e-4 and n < MAX_SAMPLES:
                out_t[n] = moment / group
                out_dt[n] = last - first
                out_sigma[n] = group / (last - first)
                n += 1
            group, moment = 0.0, 0.0
    return n


@njit(cache=True, parallel=True)
def march(
    rays_o: Float32[np.ndarray, "n 3"],
    rays_d: Float32[np.ndarray, "n 3"],
    t_min: Float32[np.ndarray, "n"],
    t_max: Float32[np.ndarray, "n"],
    lattice: Lattice,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """March rays through the snow, front to back, until they are opaque.

    Outside the surface a step is as long as the bound of the sum's slope allows, so that no surface
    is missed. Inside it the step follows the slope.

    Args:
        rays_o: origins, m.
        rays_d: unit directions.
        t_min: ray length at which each ray begins, m.
        t_max: ray length at which it ends, m; may be infinite.
        lattice: the cascades.

    Returns:
        Offsets [n + 1] and, packed, middle t and extent dt (m) and extinction (1/m) of the samples.
    """
    n = rays_o.shape[0]
    t = np.empty((n, MAX_SAMPLES), np.float32)
    dt = np.empty((n, MAX_SAMPLES), np.float32)
    sigma = np.empty((n, MAX_SAMPLES), np.float32)
    offsets = np.zeros(n + 1, np.int64)
    outer = lattice.spacing.shape[0] - 1
    for r in prange(n):
        begin, end = np.float64(t_min[r]), np.float64(t_max[r])
        o, d = rays_o[r].astype(np.float64), rays_d[r].astype(np.float64)
        for axis in range(3):
            side = lattice.spacing[outer] * BRICK
            low = lattice.lower[outer, axis] + side
            high = low + (lattice.bricks[outer, axis] - 2) * side
            if d[axis] == 0:
                if o[axis] < low or o[axis] > high:
                    end = -1.0
                continue
            first, second = (low - o[axis]) / d[axis], (high - o[axis]) / d[axis]
            begin = max(begin, min(first, second) + 1e-4 * lattice.spacing[0])
            end = min(end, max(first, second))
        offsets[r + 1] = _march_ray(lattice, o, d, begin, end, t[r], dt[r], sigma[r])
    for r in range(n):
        offsets[r + 1] += offsets[r]
    packed = np.empty((3, offsets[n]), np.float32)
    for r in prange(n):
        for q in range(offsets[r + 1] - offsets[r]):
            packed[0, offsets[r] + q] = t[r, q]
            packed[1, offsets[r] + q] = dt[r, q]
            packed[2, offsets[r] + q] = sigma[r, q]
    return offsets, packed[0], packed[1], packed[2]
