"""Where snow goes that does not stay: it slides down slopes, falls over edges and comes to rest.

Rasters as of `weather.snow.cover`: heights are world z, m, NaN where nothing is.
"""

import heapq
import math
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit
from scipy import ndimage

HELD_AT_30, STEEPER = 3.08, 0.0671  # m on a slope of 30 degrees; 1/degree, of `steepest_side`
STEEPEST_SIDE = 80.0  # degrees of the sides of thin snow
KEEPS_ALL = 0.99  # share of a surface on which sliding snow comes to rest
PILE = 0.12  # m, standard deviation of the heap of what slid, before it settles
SCATTERS, DROPS = 0.2, (0.0, 1.0, 2.0, 4.0, 8.0)  # of the drop (m), by which what falls is spread
PACKED = 0.5  # volume of what slid over that before it did
FALLS_FROM = 0.2  # m of a drop over an edge, from which what falls is scattered
PARCELS, GOLDEN = 64, math.pi * (3 - math.sqrt(5))  # of what falls off a node; radian
MAX_FALLS = 20  # edges one below the other
LEDGE = 0.1  # share of level nodes within reach of what arrives
DESCENT = 1e-6  # m a node, of filled depressions, so that a way leads out of them
SETTLED = 1e-3  # of the rise over a cell; what is steeper by less stays
MAX_SWEEPS = 20_000  # of `settled`; 2 m of snow on walls of 6 m need some thousands


def slid(
    lost: Float[np.ndarray, "h w"],
    share: Float[np.ndarray, "h w"],
    height: Float[np.ndarray, "h w"],
    spacing: float,
) -> Float[np.ndarray, "h w"]:
    """Depth that arrives from steeper surfaces above, over the depth that falls.

    What a slope does not keep slides down, over edges as well, to the first surface that keeps all
    snow: below a steep roof lies what the roof sheds. It spreads there over `PILE` m, and over
    `SCATTERS` of its drop from higher edges, so that no spires stand below crowns of a wrong class.
    What slides passes over depressions of a slope, which are roughness of the field.

    Args:
        lost: depth that slides off each node, over the depth that falls.
        share: fraction of the fall that stays.
        height: of the surface, m; NaN without one.
        spacing: of the raster, m.
    """
    known = np.isfinite(height)
    weight = ndimage.gaussian_filter(known.astype(np.float64), 1.0)
    smooth = ndimage.gaussian_filter(np.where(known, height, 0.0), 1.0)
    smooth = np.where(known, smooth / np.maximum(weight, 1e-6), np.nan)
    # Roughness would catch what slides; at edges the surfaces stay apart.
    smooth = np.where(np.abs(smooth - height) < spacing, smooth, height)
    filled = _depressions_filled(smooth, share > KEEPS_ALL)
    order = np.argsort(np.where(known, -filled, np.inf), axis=None, kind="stable")
    arrived, drop = _routed(lost, share, filled, order[: int(known.sum())])
    level = (share > KEEPS_ALL).astype(np.float64)
    heaps = np.zeros_like(level)
    for low, high in pairwise((*DROPS, math.inf)):
        part = np.where((drop >= low) & (drop < high), arrived, 0.0)
        if part.any():
            typical = (low + min(high, 2 * low)) / 2
            sigma = max(PILE, SCATTERS * typical) / spacing
            # What finds no more than a ledge to lie on is lost, and builds no tower there.
            reach = np.maximum(ndimage.gaussian_filter(level, sigma), LEDGE)
            heaps += level * ndimage.gaussian_filter(part / reach, sigma)
    return heaps


@njit(cache=True)
def _depressions_filled(
    height: Float[np.ndarray, "h w"], outlet: Bool[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w"]:
    """Fill depressions: each node has a descending way to an outlet or to the raster's border.

    The priority flood of Barnes, Lehman and Mulla (2014), algorithm 3. Nodes that no way joins to
    an outlet keep their height.

    Args:
        height: of the surface, m; NaN without one.
        outlet: where what slides may come to rest.
    """
    rows, columns = height.shape
    filled = height.copy()
    reached = np.isnan(height)
    queue: Any = [(0.0, 0)]
    queue.pop()  # Numba takes the type of an empty list from what was in it
    for j in range(rows):
        for i in range(columns):
            border = j == 0 or i == 0 or j == rows - 1 or i == columns - 1
            if (outlet[j, i] or border) and not reached[j, i]:
                reached[j, i] = True
                heapq.heappush(queue, (height[j, i], j * columns + i))
    while len(queue) > 0:
        level, q = heapq.heappop(queue)
        j, i = q // columns, q % columns
        for dj in range(-1, 2):
            for di in range(-1, 2):
                jj, ii = j + dj, i + di
                if jj < 0 or ii < 0 or jj >= rows or ii >= columns or reached[jj, ii]:
                    continue
                reached[jj, ii] = True
                filled[jj, ii] = max(height[jj, ii], level + DESCENT)
                heapq.heappush(queue, (filled[jj, ii], jj * columns + ii))
    return filled


@njit(cache=True)
def _routed(
    lost: Float[np.ndarray, "h w"],
    share: Float[np.ndarray, "h w"],
    height: Float[np.ndarray, "h w"],
    order: Int[np.ndarray, "n"],
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Carry what does not stay to the lowest neighbours, from the highest node to the lowest.

    Returns:
        What arrives at nodes that keep all, over the depth that falls, and the highest step that it
        has dropped, m.
    """
    rows, columns = share.shape
    carried = np.zeros((rows, columns))
    arrived = np.zeros((rows, columns))
    drop = np.zeros((rows, columns))
    for q in order:
        j, i = q // columns, q % columns
        if share[j, i] > KEEPS_ALL:
            arrived[j, i] = carried[j, i]
            continue
        best, to_j, to_i = 0.0, -1, -1
        for dj in range(-1, 2):
            for di in range(-1, 2):
                jj, ii = j + dj, i + di
                if jj < 0 or ii < 0 or jj >= rows or ii >= columns or (dj == 0 and di == 0):
                    continue
                fall = (height[j, i] - height[jj, ii]) / math.sqrt(dj * dj + di * di)
                if fall > best:  # NaN compares False
                    best, to_j, to_i = fall, jj, ii
        if to_j >= 0:
            carried[to_j, to_i] += carried[j, i] + lost[j, i]
            if carried[j, i] + lost[j, i] > 0:
                step = height[j, i] - height[to_j, to_i]
                drop[to_j, to_i] = max(drop[to_j, to_i], drop[j, i], step)
    return arrived, drop


@njit(cache=True)
def steepest_side(depth: float) -> float:
    """Rise over run up to which snow of a depth (m) stands: the thinner, the steeper.

    Slopes of 30, 45, 60 and 75 degrees hold 3.08, 1.11, .45 and .15 m of snow (Bernhardt and Schulz
    2010, SnowSlide); an exponential fits these.
    """
    degrees = 30 + math.log(HELD_AT_30 / max(depth, 1e-6)) / STEEPER  # no snow: log of infinity
    return math.tan(math.radians(min(degrees, STEEPEST_SIDE)))


def settled(
    base: Float[np.ndarray, "h w"], thickness: Float[np.ndarray, "h w"], spacing: float
) -> Float[np.ndarray, "h w"]:
    """Thickness of snow whose surface nowhere falls more steeply than `steepest_side`.

    That holds for the surface over a node above that over any neighbour, or above the node's own
    base where that is higher: snow on a roof ends in a slope at its eaves. There no more stays than
    fell, so that the sides of a car stay free. What slides goes to that neighbour; over an edge it
    falls, and lands scattered around the foot.

    Args:
        base: height of what the snow lies on, m; NaN where nothing is.
        thickness: of the snow before it slides, m.
        spacing: of the nodes, m.
    """
    top = base + thickness
    for _ in range(MAX_FALLS):
        fell = _come_to_rest(top, base, thickness, spacing)
        if not fell.any():
            break
        top = _scattered(top, base, fell, spacing)
    return np.maximum(top - base, 0.0)


@njit(cache=True)
def _come_to_rest(
    top: Float[np.ndarray, "h w"],
    base: Float[np.ndarray, "h w"],
    thickness: Float[np.ndarray, "h w"],
    spacing: float,
) -> Float[np.ndarray, "h w"]:
    """Let snow slide until it rests, in place; return what fell off each node over an edge, m."""
    rows, columns = base.shape
    waiting = np.ones((rows, columns), np.bool_)  # nodes near a change since they were looked at
    busy = np.ones(rows, np.bool_)  # rows of such nodes
    fell = np.zeros((rows, columns))
    for sweep in range(MAX_SWEEPS):
        changed = False
        for a in range(rows):
            j = a if sweep % 2 == 0 else rows - 1 - a
            if not busy[j]:
                continue
            busy[j] = False
            for b in range(columns):
                i = b if sweep % 4 < 2 else columns - 1 - b
                if not waiting[j, i]:
                    continue
                waiting[j, i] = False
                own = top[j, i]
                if not own - base[j, i] > 1e-6:  # NaN compares False
                    continue
                rise = spacing * steepest_side(own - base[j, i])
                limit, lower, to_j, to_i = own, own, -1, -1
                for dj in range(-1, 2):
                    for di in range(-1, 2):
                        jj, ii = j + dj, i + di
                        if jj < 0 or ii < 0 or jj >= rows or ii >= columns:
                            continue
                        other = top[jj, ii]
                        if math.isnan(other):
                            continue
                        slack = rise * math.sqrt(dj * dj + di * di)
                        if other < base[j, i]:  # nothing below supports more than what fell here
                            slack = min(slack, thickness[j, i])
                        highest = max(other, base[j, i]) + slack
                        if highest < limit or (highest == limit and other < lower):
                            limit, lower, to_j, to_i = highest, other, jj, ii
                if limit < own - SETTLED * rise:
                    # By half: a neighbour rises by as much, and thinner snow stands more steeply.
                    moved = 0.5 * (own - limit)
                    top[j, i] = own - moved
                    if lower < base[j, i] - FALLS_FROM:
                        fell[j, i] += moved
                    else:
                        top[to_j, to_i] += moved
                    changed = True
                    for jj in range(max(min(j, to_j) - 1, 0), min(max(j, to_j) + 2, rows)):
                        busy[jj] = True
                        for ii in range(max(min(i, to_i) - 1, 0), min(max(i, to_i) + 2, columns)):
                            waiting[jj, ii] = True
        if not changed:
            break
    return fell


@njit(cache=True)
def _scattered(
    top: Float[np.ndarray, "h w"],
    base: Float[np.ndarray, "h w"],
    fell: Float[np.ndarray, "h w"],
    spacing: float,
) -> Float[np.ndarray, "h w"]:
    """The surface with what fell over edges: in parcels normally distributed around their feet."""
    rows, columns = base.shape
    risen = top.copy()
    for j in range(rows):
        for i in range(columns):
            if fell[j, i] <= 0:
                continue
            foot_j, foot_i = j, i
            for jj in range(max(j - 1, 0), min(j + 2, rows)):
                for ii in range(max(i - 1, 0), min(i + 2, columns)):
                    if top[jj, ii] < top[foot_j, foot_i]:  # NaN compares False
                        foot_j, foot_i = jj, ii
            reach = SCATTERS * (base[j, i] - top[foot_j, foot_i]) / spacing
            for k in range(PARCELS):
                radius = reach * math.sqrt(-2 * math.log(1 - (k + 0.5) / PARCELS))
                angle = GOLDEN * (k + PARCELS * (j * columns + i))
                dj, di = radius * math.cos(angle), radius * math.sin(angle)
                to_j, to_i = foot_j, foot_i
                for outwards in (1, -1):  # what would land on a wall lands before it
                    jj, ii = foot_j + round(outwards * dj), foot_i + round(outwards * di)
                    inside = 0 <= jj < rows and 0 <= ii < columns
                    if inside and top[jj, ii] < base[j, i] - FALLS_FROM:  # NaN compares False
                        to_j, to_i = jj, ii
                        break
                risen[to_j, to_i] += fell[j, i] / PARCELS
    return risen
