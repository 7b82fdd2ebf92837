"""Where snow goes that does not stay: it slides down slopes, falls over edges and comes to rest.

Rasters as of `weather.snow.cover`: heights are world z, m, NaN where nothing is.
"""

import heapq
import math
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit
from scipy import ndimage

HELD_AT_30, PER_DEGREE = 3.08, 0.0671  # m on a slope of 30 degrees; decay, of `steepest_side`
STEEPEST_SIDE = 80.0  # degrees of the sides of thin snow
EDGE_SIDE = math.tan(math.radians(60))  # rise over run of sides above a drop of `MIN_FALL`
KEEPS_ALL = 0.99  # share of a surface on which sliding snow comes to rest
PILE = 0.12  # m, standard deviation of the heap of what slid, before it settles
SCATTER = 0.2  # of the drop: standard deviation, along each axis, of where what falls lands
PACKED = 0.5  # volume of what slid over that before it did
MIN_FALL = 0.2  # m of a drop over an edge, from which what falls is scattered
PARCELS = 64  # of what falls off a node
SLID_PARCELS = 256  # of what slid to a node
GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))  # radian, between parcels
LEDGE = 0.1  # share of level nodes within reach of what arrives
DESCENT = 1e-6  # m a node, of filled depressions, so that a way leads out of them
SETTLED = 3e-3  # of the spacing; what is higher by less stays
FILM = 1e-6  # m; less would slide on and on
COARSE = 30.0  # times `SETTLED`, while snow falls over edges
MAX_SWEEPS = 100_000  # of `settled`; 2 m of snow on walls of 6 m need tens of thousands


def slid(
    lost: Float[np.ndarray, "h w"],
    share: Float[np.ndarray, "h w"],
    height: Float[np.ndarray, "h w"],
    spacing: float,
) -> Float[np.ndarray, "h w"]:
    """Depth that arrives from steeper surfaces above, over the depth that falls.

    What a slope does not keep slides down, over edges as well, to the first surface that keeps all
    snow: below a steep roof lies what the roof sheds. It spreads there over `PILE` m and over
    `SCATTER` of its highest step, so that no spires stand below crowns of a wrong class.
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
    level = share > KEEPS_ALL
    piled = _piled(arrived, drop, smooth, level, spacing)
    # What would lie on a narrow ledge alone is lost; else it would pile up there to a tower.
    reach = np.maximum(ndimage.gaussian_filter(level.astype(np.float64), PILE / spacing), LEDGE)
    return level * ndimage.gaussian_filter(piled / reach, PILE / spacing)


@njit(cache=True)
def _piled(
    arrived: Float[np.ndarray, "h w"],
    drop: Float[np.ndarray, "h w"],
    height: Float[np.ndarray, "h w"],
    level: Bool[np.ndarray, "h w"],
    spacing: float,
) -> Float[np.ndarray, "h w"]:
    """What arrived, normally distributed over the level nodes around, but not on the roof above.

    It lands in parcels. Where fewer than `LEDGE` of them find a place, the others are lost.
    """
    rows, columns = arrived.shape
    piled = np.zeros((rows, columns))
    to = np.zeros((SLID_PARCELS, 2), np.int64)
    for j in range(rows):
        for i in range(columns):
            if arrived[j, i] <= 0:
                continue
            reach = SCATTER * drop[j, i] / spacing
            highest = height[j, i] + max(drop[j, i] / 2, MIN_FALL)
            found = 0
            for k in range(SLID_PARCELS):
                dj, di = _parcel(k, SLID_PARCELS, j * columns + i, reach)
                for side in (1, -1):  # what would land on a wall lands before it
                    jj, ii = j + round(side * dj), i + round(side * di)
                    inside = 0 <= jj < rows and 0 <= ii < columns
                    if inside and level[jj, ii] and height[jj, ii] < highest:
                        to[found, 0], to[found, 1] = jj, ii
                        found += 1
                        break
            for k in range(found):
                piled[to[k, 0], to[k, 1]] += arrived[j, i] / max(found, LEDGE * SLID_PARCELS)
    return piled


@njit(cache=True)
def _parcel(k: int, count: int, source: int, sigma: float) -> tuple[float, float]:
    """Offset of parcel k of `count` from a normal distribution, in the unit of `sigma`.

    A spiral of equal parts by the golden angle, turned from source to source.
    """
    radius = sigma * math.sqrt(-2 * math.log(1 - (k + 0.5) / count))
    angle = GOLDEN_ANGLE * (k + count * source)
    return radius * math.cos(angle), radius * math.sin(angle)


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
    2010, SnowSlide); an exponential fits these. There depths are normal to the slope; taken as
    vertical ones, as here, deep snow stands less steeply.
    """
    degrees = 30 + math.log(HELD_AT_30 / max(depth, 1e-6)) / PER_DEGREE  # no snow: 3.08 / 0
    return math.tan(math.radians(min(max(degrees, 0.0), STEEPEST_SIDE)))


@njit(cache=True)
def settled(
    base: Float[np.ndarray, "h w"], thickness: Float[np.ndarray, "h w"], spacing: float
) -> Float[np.ndarray, "h w"]:
    """Thickness of snow whose surface nowhere falls more steeply than `steepest_side`.

    That holds for the surface over a node above that over any neighbour, or above the node's own
    base where that is higher: snow on a roof ends in a slope at its eaves. There no more stays than
    was deposited, so that the sides of a car stay free; and above a drop of `MIN_FALL` no more than
    `EDGE_SIDE` allows, so that a thin rail carries no ball. What slides goes to that neighbour;
    over an edge it falls, and lands scattered around the foot.

    Args:
        base: height of what the snow lies on, m; NaN where nothing is.
        thickness: of the snow before it slides, m.
        spacing: of the nodes, m.
    """
    rows, columns = base.shape
    top = base + thickness
    tolerance = COARSE * SETTLED * spacing  # until no more falls
    falling = np.zeros((rows, columns))  # off each node and not yet landed, m
    received = np.zeros((rows, columns))  # the same at its foot
    falls = False
    waiting = np.ones((rows, columns), np.bool_)  # nodes near a change since they were looked at
    busy = np.ones(rows, np.bool_)  # rows of such nodes
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
                if not own - base[j, i] > FILM:  # NaN compares False
                    continue
                rise = spacing * steepest_side(own - base[j, i])
                limit, lower, to_j, to_i, part = own, own, -1, -1, 0.5
                for dj in range(-1, 2):
                    for di in range(-1, 2):
                        jj, ii = j + dj, i + di
                        if jj < 0 or ii < 0 or jj >= rows or ii >= columns:
                            continue
                        other = top[jj, ii]
                        if math.isnan(other):
                            continue
                        slack = rise * math.sqrt(dj * dj + di * di)
                        # Nothing below supports more than what was deposited here.
                        free = other < base[j, i] and slack > thickness[j, i]
                        if free:
                            slack = thickness[j, i]
                        if other < base[j, i] - MIN_FALL:
                            slack = min(slack, EDGE_SIDE * spacing * math.sqrt(dj * dj + di * di))
                        highest = max(other, base[j, i]) + slack
                        if highest < limit or (highest == limit and other < lower):
                            limit, lower, to_j, to_i = highest, other, jj, ii
                            # Else by half: a neighbour rises by as much, and thinner snow stands
                            # more steeply.
                            part = 1.0 if free else 0.5
                if limit < own - (FILM if part == 1.0 else tolerance):
                    drop, moved = base[j, i] - lower, part * (own - limit)
                    if drop > MIN_FALL:
                        if received[to_j, to_i] > drop and (
                            received[to_j, to_i]
                            > drop * _width(top, base[j, i], to_j, to_i, spacing)
                        ):
                            continue  # the gap below is full when that has landed
                        falling[j, i] += moved
                        received[to_j, to_i] += moved
                        falls = True
                    else:
                        top[to_j, to_i] += moved
                        _wake(waiting, busy, to_j, to_i)
                    top[j, i] = own - moved
                    _wake(waiting, busy, j, i)
                    changed = True
        if changed:
            continue
        if falls:
            _land(top, base, falling, waiting, busy, spacing)
            falling[:], received[:], falls = 0, 0, False
        elif tolerance > SETTLED * spacing:
            tolerance = SETTLED * spacing
            waiting[:], busy[:] = True, True
        else:
            break
    if falls:
        _land(top, base, falling, waiting, busy, spacing)
    return np.maximum(top - base, 0.0)


@njit(cache=True)
def _wake(
    waiting: Bool[np.ndarray, "h w"], busy: Bool[np.ndarray, "h"], row: int, column: int
) -> None:
    """Note that a node has changed, for itself and its neighbours."""
    for j in range(max(row - 1, 0), min(row + 2, waiting.shape[0])):
        busy[j] = True
        for i in range(max(column - 1, 0), min(column + 2, waiting.shape[1])):
            waiting[j, i] = True


@njit(cache=True)
def _land(
    top: Float[np.ndarray, "h w"],
    base: Float[np.ndarray, "h w"],
    falling: Float[np.ndarray, "h w"],
    waiting: Bool[np.ndarray, "h w"],
    busy: Bool[np.ndarray, "h"],
    spacing: float,
) -> None:
    """Add what fell off nodes to the surface, in place, normally distributed around their feet.

    It lands in parcels. What would land on a wall lands before it, on the other side of the foot.
    """
    rows, columns = top.shape
    before = top.copy()
    for j in range(rows):
        for i in range(columns):
            if falling[j, i] <= 0:
                continue
            foot_j, foot_i = j, i
            for jj in range(max(j - 1, 0), min(j + 2, rows)):
                for ii in range(max(i - 1, 0), min(i + 2, columns)):
                    if before[jj, ii] < before[foot_j, foot_i]:  # NaN compares False
                        foot_j, foot_i = jj, ii
            _wake(waiting, busy, foot_j, foot_i)  # nodes above a full gap go on
            reach = SCATTER * max(base[j, i] - before[foot_j, foot_i], 0.0) / spacing
            for k in range(PARCELS):
                source = j * columns + i
                to_j, to_i = _landing(before, base[j, i], foot_j, foot_i, reach, k, source)
                top[to_j, to_i] += falling[j, i] / PARCELS
                _wake(waiting, busy, to_j, to_i)


@njit(cache=True)
def _landing(
    top: Float[np.ndarray, "h w"],
    high: float,
    foot_j: int,
    foot_i: int,
    reach: float,
    k: int,
    source: int,
) -> tuple[int, int]:
    """The node at which parcel k lands that fell from a height (m), `reach` nodes from the foot."""
    dj, di = _parcel(k, PARCELS, source, reach)
    for side in (1, -1):
        j, i = foot_j + round(side * dj), foot_i + round(side * di)
        inside = 0 <= j < top.shape[0] and 0 <= i < top.shape[1]
        if inside and top[j, i] < high - MIN_FALL:  # NaN compares False
            return j, i
    return foot_j, foot_i


@njit(cache=True)
def _width(
    top: Float[np.ndarray, "h w"], high: float, foot_j: int, foot_i: int, spacing: float
) -> float:
    """Nodes across an edge over which what falls from it is spread; 1 in a pit."""
    reach = SCATTER * (high - top[foot_j, foot_i]) / spacing
    stays = 0
    for k in range(PARCELS):
        stays += _landing(top, high, foot_j, foot_i, reach, k, 0) == (foot_j, foot_i)
    return 1 / max(stays / PARCELS, 1 / (1 + math.sqrt(2 * math.pi) * reach))
