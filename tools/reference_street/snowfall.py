"""Simulated snow on the street: flakes fall vertically onto the true meshes, slide and settle.

The code shares nothing with the program's own snow. It fills a height field flake by flake. A flake
stays on a bare surface with the probability that roofs of that pitch keep their snow (EN 1991-1-3,
5.3: all up to 30 degrees, none from 60), and on snow unless its side is too steep for its depth.
Otherwise it moves to the lowest neighbour. What falls over an edge lands scattered, and what slid
off a surface is packed. Flakes never reach surfaces under a roof or a table.
Leaves keep a fraction of the flakes that depends on their pitch, up to what a crown can hold; the
rest falls through. Snow in a crown does not follow single leaves: it bridges them in cushions.
"""

from dataclasses import dataclass

import numba
import numpy as np
from jaxtyping import Float
from scipy import ndimage

from tools.reference_street.geometry import Mesh

# (half width in x, half width in y, cell) in m: finest around the test views.
RINGS = ((16.0, 24.0, 0.03), (40.0, 60.0, 0.12), (200.0, 200.0, 0.8))
FLAKES = 60  # per cell
# Snow stands the steeper the thinner it is: slopes of 30, 45, 60 and 75 degrees hold 3.08, 1.11,
# .45 and .15 m (Bernhardt and Schulz 2010, SnowSlide), which an exponential fits.
HELD_AT_30, PER_DEGREE, STEEPEST = 3.08, 0.0671, 80.0  # m, 1/degree, degrees
# Deposits of slides are twice as dense as the snow that slid (Sovilla and others 2001).
PACKED = 0.5
SCATTER, FROM_DROP = 0.2, 0.2  # standard deviation of where it lands over the drop; least drop, m
KEEPS, SHEDS = 30.0, 60.0  # degrees of pitch up to which all, and from which no snow stays
MAX_MOVES = 400  # of one flake
LEVEL = 1e-9  # m a cell; by less a flake would move to and fro forever
MAX_RISE = 2.5  # height difference of neighbours on one surface, cells
MIN_DEPTH = 0.002  # m, thinner snow is removed
# A crown intercepts some 5 kg/m2 of snow for each unit of leaf area that it shows to the sky
# (Hedstrom and Pomeroy 1998): half a decimetre of fresh snow, and a little more in clumps.
CROWN_HOLDS = 0.08  # m
CUSHION = 0.1  # m, standard deviation of the smoothing of crowns
ONE_LAYER = 0.6  # m below the highest leaf nearby; deeper leaves carry no part of a cushion
CLOSED = (0.25, 0.6)  # fraction covered by leaves at which a cushion begins, and is complete


@dataclass(frozen=True)
class Cover:
    """Snow on a grid of cells.

    Attributes:
        x0: x of the first cell's centre, m.
        y0: y of the first cell's centre, m.
        cell: side of a cell, m.
        ground: height of the highest surface, m; -inf without a surface.
        depth: depth of the snow on it, m.
    """

    x0: float
    y0: float
    cell: float
    ground: Float[np.ndarray, "rows columns"]
    depth: Float[np.ndarray, "rows columns"]


def snow_cover(meshes: list[Mesh], depth: float, ring: int, seed: int = 3) -> tuple[Cover, Cover]:
    """Return the snow over one of `RINGS`, on surfaces and on leaves.

    Args:
        meshes: the street.
        depth: mean depth on open level ground, m.
        ring: index into `RINGS`.
        seed: random seed.
    """
    half_x, half_y, cell = RINGS[ring]
    columns, rows = round(2 * half_x / cell), round(2 * half_y / cell)
    x0, y0 = -half_x + 0.5 * cell, -half_y + 0.5 * cell
    surfaces = []
    for leaves in (False, True):
        top, level = np.full((rows, columns), -np.inf), np.ones((rows, columns))
        for mesh in meshes:
            if (mesh.label == "vegetation") == leaves:
                _from_above(mesh.vertices[mesh.faces], x0, y0, cell, top, level)
        pitch = np.degrees(np.arccos(np.clip(level, 0, 1)))
        surfaces.append((top, np.clip((SHEDS - pitch) / (SHEDS - KEEPS), 0, 1)))
    (ground, keeps), (crown, holds) = surfaces
    crown[crown <= ground] = -np.inf
    crown, holds, most = cushions(crown, holds, depth, cell)
    rng = np.random.default_rng(seed)
    steepest = MAX_RISE * cell
    lying, held = _settle(ground, keeps, crown, holds, most, depth / FLAKES, cell, rng)
    covers = []
    for top, snow, times in ((ground, lying, 4), (crown, held, round(8 * CUSHION / cell))):
        for _ in range(times):  # removes the bumps of single flakes
            snow = _smooth(snow, top, steepest)
        covers.append(Cover(x0, y0, cell, top, np.where(snow > MIN_DEPTH, snow, 0.0)))
    return covers[0], covers[1]


def cushions(
    crown: Float[np.ndarray, "rows columns"],
    holds: Float[np.ndarray, "rows columns"],
    depth: float,
    cell: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return crowns as surfaces that snow can lie on: smooth over leaves and the gaps between.

    Args:
        crown: height of the highest leaf over each cell, m; -inf without one.
        holds: fraction of the flakes that this leaf keeps.
        depth: depth of snow on open level ground, m.
        cell: side of a cell, m.

    Returns:
        The heights of cushions, m (-inf without one); the fraction of the flakes that they keep;
        and the depth up to which they keep any, which falls to 0 at their rims.
    """
    sigma, leaf = CUSHION / cell, np.isfinite(crown)
    size = 2 * int(np.ceil(2 * sigma)) + 1
    highest = ndimage.maximum_filter(crown, size)
    top = leaf & (crown > highest - ONE_LAYER)
    weight = ndimage.gaussian_filter(top.astype(float), sigma)
    share = np.maximum(weight, 1e-6)  # no leaf near: 0/0; its cells are no cushion
    height = ndimage.gaussian_filter(np.where(top, crown, 0.0), sigma) / share
    kept = ndimage.gaussian_filter(np.where(top, holds, 0.0), sigma) / share
    complete = np.clip((weight - CLOSED[0]) / (CLOSED[1] - CLOSED[0]), 0, 1)
    most = min(depth, CROWN_HOLDS) * complete * (2 - complete)
    return np.where(complete > 0, height, -np.inf), kept, most


def snow_meshes(meshes: list[Mesh], depth: float) -> list[Mesh]:
    """Return the snow as meshes, one per ring, without the area of finer rings."""
    out = []
    for ring, (_, _, cell) in enumerate(RINGS):
        inner = RINGS[ring - 1][:2] if ring else (0.0, 0.0)
        for where, cover in zip(("", "-leaves"), snow_cover(meshes, depth, ring), strict=True):
            assert cell == cover.cell
            mesh = cover_mesh(cover, inner)
            out.append(mesh.tagged(f"snow{where}-{ring}", "snow", "terrain"))
    return out


def cover_mesh(cover: Cover, inner: tuple[float, float]) -> Mesh:
    """Return the surface of all snowy cells, with vertical sides at its edges.

    Args:
        cover: the snow.
        inner: half widths of the excluded area in x and y, m.
    """
    rows, columns = cover.depth.shape
    x = cover.x0 + cover.cell * np.arange(columns)
    y = cover.y0 + cover.cell * np.arange(rows)
    snowy = cover.depth > 0
    top = np.where(snowy, cover.ground + cover.depth, -np.inf)
    wanted = snowy & ~((np.abs(x)[None] < inner[0]) & (np.abs(y)[:, None] < inner[1]))
    j, i = np.nonzero(wanted)
    padded = np.pad(top, 1, constant_values=-np.inf)
    own = top[j, i]
    corners = []
    for dj, di in ((0, 0), (0, 1), (1, 1), (1, 0)):
        total, count = np.zeros(len(own)), np.zeros(len(own))
        for a, b in ((0, 0), (0, 1), (1, 0), (1, 1)):
            z = padded[j + dj + a, i + di + b]
            near = np.abs(z - own) < MAX_RISE * cover.cell
            total += np.where(near, z, 0.0)
            count += near
        px, py = x[i] + (di - 0.5) * cover.cell, y[j] + (dj - 0.5) * cover.cell
        corners.append(np.stack([px, py, total / count], -1))
    tops = np.stack(corners, 1)  # n 4 3
    parts = [tops]
    foot = cover.ground[j, i] - 0.5 * cover.cell
    for (dj, di), (a, b) in (
        ((-1, 0), (0, 1)),
        ((0, 1), (1, 2)),
        ((1, 0), (2, 3)),
        ((0, -1), (3, 0)),
    ):
        z = padded[j + 1 + dj, i + 1 + di]
        open_side = ~(np.abs(z - own) < MAX_RISE * cover.cell)
        upper = tops[open_side][:, [a, b]]
        lower = upper.copy()
        lower[..., 2] = foot[open_side, None]
        parts.append(np.stack([lower[:, 0], lower[:, 1], upper[:, 1], upper[:, 0]], 1))
    quads = np.concatenate(parts)
    first = 4 * np.arange(len(quads))[:, None]
    faces = np.concatenate([first + [0, 1, 2], first + [0, 2, 3]])
    vertices = quads.reshape(-1, 3)
    return Mesh(vertices, faces, np.full((len(vertices), 2), 0.5))


@numba.njit(cache=True)
def _from_above(triangles, x0, y0, cell, ground, level):
    """Find the highest surface over each cell's centre, and |n_z| of its triangle, in place."""
    rows, columns = ground.shape
    for t in range(len(triangles)):
        a, b, c = triangles[t]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if abs(area) < 1e-12:  # vertical triangle, 0/0
            continue
        i0 = max(int(np.ceil((min(a[0], b[0], c[0]) - x0) / cell)), 0)
        i1 = min(int(np.floor((max(a[0], b[0], c[0]) - x0) / cell)), columns - 1)
        j0 = max(int(np.ceil((min(a[1], b[1], c[1]) - y0) / cell)), 0)
        j1 = min(int(np.floor((max(a[1], b[1], c[1]) - y0) / cell)), rows - 1)
        n = np.cross(b - a, c - a)
        upright = abs(n[2]) / np.sqrt((n**2).sum())
        for j in range(j0, j1 + 1):
            y = y0 + j * cell
            for i in range(i0, i1 + 1):
                x = x0 + i * cell
                u = ((b[0] - x) * (c[1] - y) - (b[1] - y) * (c[0] - x)) / area
                v = ((c[0] - x) * (a[1] - y) - (c[1] - y) * (a[0] - x)) / area
                w = 1.0 - u - v
                if u < 0 or v < 0 or w < 0:
                    continue
                z = u * a[2] + v * b[2] + w * c[2]
                if z > ground[j, i]:
                    ground[j, i], level[j, i] = z, upright


@numba.njit(cache=True)
def _steepest_side(depth):
    """Rise over run up to which snow of a depth (m) stands."""
    degrees = 30.0 + np.log(HELD_AT_30 / max(depth, 1e-6)) / PER_DEGREE
    return np.tan(np.deg2rad(min(degrees, STEEPEST)))


@numba.njit(cache=True)
def _settle(ground, keeps, crown, holds, most, flake, cell, rng):
    """Drop all flakes one by one; return the depths of snow on surfaces and in crowns.

    Crowns keep the fraction `holds` of the flakes until their depth is `most`.

    A flake that slides continues until a surface that keeps all snow, or over an edge.
    """
    rows, columns = ground.shape
    depth, held = np.zeros_like(ground), np.zeros_like(ground)
    for _ in range(FLAKES * rows * columns):
        j, i = int(rng.random() * rows), int(rng.random() * columns)
        slides, slid = False, False
        if held[j, i] < most[j, i] and rng.random() < holds[j, i]:
            held[j, i] += flake
            continue
        if ground[j, i] == -np.inf:
            continue
        for _ in range(MAX_MOVES):
            own = ground[j, i] + depth[j, i]
            best, best_j, best_i, rise = LEVEL, j, i, 0.0
            first = int(rng.random() * 8)
            for k in range(8):
                dj, di = _STEPS[(first + k) % 8]
                jj, ii = j + dj, i + di
                if jj < 0 or ii < 0 or jj >= rows or ii >= columns or ground[jj, ii] == -np.inf:
                    continue
                length = np.sqrt(float(dj * dj + di * di))
                fall = (own - ground[jj, ii] - depth[jj, ii]) / length
                # Snow at an edge stands on its own surface.
                rise = max(rise, min(fall, depth[j, i] / length))
                if fall > best:
                    best, best_j, best_i = fall, jj, ii
            slides = keeps[j, i] < 1.0 and (slides or rng.random() >= keeps[j, i])
            slid = slid or slides
            # The steepest side is that of snow; `keeps` applies to bare surfaces.
            lies = depth[j, i] < MIN_DEPTH or rise <= _steepest_side(depth[j, i]) * cell
            if best <= LEVEL or (lies and not slides):
                depth[j, i] += flake * PACKED if slid else flake
                break
            drop = own - ground[best_j, best_i] - depth[best_j, best_i]
            if drop > FROM_DROP:
                dj, di = rng.normal(), rng.normal()
                for outwards in (1, -1):  # what would land on a wall lands before it
                    jj = best_j + round(outwards * dj * SCATTER * drop / cell)
                    ii = best_i + round(outwards * di * SCATTER * drop / cell)
                    inside = 0 <= jj < rows and 0 <= ii < columns and np.isfinite(ground[jj, ii])
                    if inside and ground[jj, ii] + depth[jj, ii] < own - FROM_DROP:
                        best_j, best_i = jj, ii
                        break
            j, i = best_j, best_i
    return depth, held


_STEPS = np.array([(-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)])


@numba.njit(cache=True)
def _smooth(depth, ground, steepest):
    """Average each depth (weight 4) with those of its four neighbours on the same surface.

    Cells without a surface do not count: their height difference is inf - inf.
    """
    rows, columns = depth.shape
    out = depth.copy()
    for j in range(1, rows - 1):
        for i in range(1, columns - 1):
            total, count = 4 * depth[j, i], 4
            for k in (1, 3, 4, 6):
                dj, di = _STEPS[k]
                difference = abs(ground[j + dj, i + di] - ground[j, i])
                if difference < steepest:
                    total += depth[j + dj, i + di]
                    count += 1
            out[j, i] = total / count
    return out
