"""Where snow goes that does not stay: what slides, falls over edges and comes to rest."""

import math

import numpy as np
import pytest

from climatenerf.weather.snow.lattice import _THINNEST, Catch, _columns
from climatenerf.weather.snow.sliding import EDGE_SIDE, settled, slid, steepest_side

H = 0.05


def test_what_slides_arrives_below_and_nothing_is_invented():
    """A slope of 50 degrees between two level grounds."""
    x = np.arange(80) * H
    height = np.broadcast_to(np.clip((x - 1.5) * math.tan(math.radians(50)), 0, 1.5), (40, 80))
    slope = (height > 0.01) & (height < 1.49)
    share = np.where(slope, 1 / 3, 1.0)
    arrived = slid(1 - share, share, height, H)
    assert arrived.sum() == pytest.approx((2 / 3) * slope.sum(), rel=0.05)
    assert arrived[:, :31].sum() > 0.98 * arrived.sum(), "at the foot"
    assert not arrived[slope].any()
    assert slid(np.zeros((20, 20)), np.ones((20, 20)), np.zeros((20, 20)), H).max() == 0
    holed = height.copy()
    holed[10:14, 5:9] = np.nan
    assert np.isfinite(slid(1 - share, share, holed, H)).all()


def test_what_slides_passes_over_hollows_of_a_rough_roof():
    x = np.arange(120) * H
    across = np.abs(x - 3.0)
    plane = np.clip(1.5 - np.maximum(*np.meshgrid(across, across)), 0, None)  # a pyramid
    roof = plane > 0.01
    rough = plane + roof * 0.1 * np.random.default_rng(0).normal(size=plane.shape)
    share = np.where(roof, 0.5, 1.0)
    arrived = slid(1 - share, share, rough, H)
    assert arrived[~roof].sum() == pytest.approx(0.5 * roof.sum(), rel=0.05)


def test_snow_stands_as_steeply_as_slopes_hold_it():
    held = {30.0: 3.08, 45.0: 1.11, 60.0: 0.45, 75.0: 0.15}
    for degrees, depth in held.items():
        found = math.degrees(math.atan(steepest_side(depth)))
        assert found == pytest.approx(degrees, abs=1.6), depth
    slopes = [steepest_side(depth) for depth in (0.0, 1e-9, 0.01, 0.1, 0.2, 0.5, 1.0, 2.0, 8.0)]
    assert slopes[0] == slopes[2] == pytest.approx(math.tan(math.radians(80)))
    assert np.all(np.diff(slopes) <= 0) and slopes[-1] > 0


def steepest_step(found, base):
    """The steepest rise of the surface over a neighbour, or over its own base, over the steepest
    that snow of its depth has."""
    top, worst = base + found, 0.0
    for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
        other = np.roll(top, sign, axis)
        rise = np.minimum(top - other, found)
        cut = [slice(None), slice(None)]
        cut[axis] = slice(1, -1)
        limit = H * np.vectorize(steepest_side)(np.nan_to_num(found))
        worst = max(worst, float(np.nanmax((rise / limit)[tuple(cut)])))
    return worst


def test_settled_snow_is_nowhere_steeper_than_it_stands_and_none_is_lost():
    rng = np.random.default_rng(1)
    base = 0.3 * rng.random((50, 50)) * (rng.random((50, 50)) < 0.2)
    base[:, 40:] = np.nan
    thickness = np.where(np.isnan(base), 0.0, 0.8)
    found = settled(base, thickness, H)
    assert np.all(found[:, :40] >= 0)
    assert found[:, :40].sum() == pytest.approx(0.8 * 50 * 40)
    assert steepest_step(found, base) < 1.01 < steepest_step(thickness, base)


def test_snow_that_slides_onto_bare_nodes_stays_there():
    """What falls on half a raster alone heaps up on the other half as well, and none is lost."""
    x, y = np.meshgrid(H * np.arange(9), H * np.arange(9))
    position = np.stack([x, y, 0 * x], -1).astype(np.float32)
    one = np.ones((9, 9), np.float32)
    fall = one * (x < 0.22)
    catch = Catch(position, fall, 0 * one, 0 * one, one, one)
    thickness = _columns((catch,), 0.6, H)[3]
    assert thickness.sum() == pytest.approx(0.6 * fall.sum(), rel=1e-3)
    assert len(thickness) > fall.sum() + 9, "more columns than caught any"


def test_a_narrow_table_carries_a_cap_and_the_rest_falls_around_it():
    base = np.zeros((60, 60))
    base[20:40, 28:32] = 1.0
    found = settled(base, np.full(base.shape, 0.3), H)
    table = base > 0
    edge, middle = found[30, 28], found[30, 29]
    assert edge == pytest.approx(H * EDGE_SIDE, rel=0.01)
    assert edge < middle <= 0.3
    assert found.sum() == pytest.approx(0.3 * base.size)
    assert found[~table].min() >= 0.3, "what falls heaps up around it"
    added = found[22:38] - 0.3
    away = np.abs(np.arange(60) - 29.5) * H
    added = np.where(table[22:38], 0, added).sum(0)
    spread = math.sqrt((added * away**2).sum() / added.sum())
    assert 0.15 < spread < 0.35, "a fifth of the drop around the foot"
    assert found[~table].max() < 0.42, "no ridge at the foot"


def test_what_slides_over_steep_sides_does_not_stay_on_them():
    """A stair of 60 degrees that keeps nothing is free but for the heap that rises at its foot."""
    base = np.tile(np.maximum(2.0 - 1.75 * H * np.arange(40), 0.0), (5, 1))
    base[:, :5] = base[:, 5:6]
    fell = np.where((base > 0) & (base < base[0, 0]), 0.0, 0.3)
    found = settled(base, fell, H)
    assert found.sum() == pytest.approx(fell.sum())
    top, heap = base + found, (base + found)[2, base[2] == 0].max()
    side = (fell == 0) & (base > heap + 0.3)
    assert side.any() and found[side].max() < 1e-3
    assert found[:, 0].min() > 0.2 and top.max() < base.max() + 0.31


def test_what_falls_deep_is_scattered():
    """The same snow that slides from edges 3 and 9 m high; a ledge of one node builds no tower."""
    highest = []
    for high in (3.0, 9.0):
        height = np.zeros((120, 120))
        height[:, :40] = high + 1.2 * H * np.arange(40)[::-1]
        share = np.where(height > 0, 0.5, 1.0)
        arrived = slid(1 - share, share, height, H)
        assert arrived.sum() == pytest.approx((1 - share).sum(), rel=0.05)
        highest.append(arrived.max())
    assert highest[1] < 0.45 * highest[0]
    height = 9.0 - 1.2 * H * np.broadcast_to(np.arange(60.0), (60, 60))
    share = np.full((60, 60), 0.5)
    share[30, 30] = 1.0
    assert slid(1 - share, share, height, H).max() < 5


def test_heaps_do_not_depend_on_the_spacing():
    """A heap of .25 m2 before a wall, as high on fine and on coarse lattices."""
    heights = []
    for spacing in (0.06, 0.03):
        nodes = round(2.4 / spacing)
        heap = np.zeros((5, nodes))
        heap[:, : round(0.12 / spacing)] = 0.25 / 0.12
        lying = settled(np.zeros_like(heap), heap, spacing)
        assert lying.sum() * spacing / 5 == pytest.approx(0.25, rel=1e-6)
        slope = -np.diff(lying[2]) / spacing
        steepest = np.array([steepest_side(each) for each in lying[2, :-1]])
        assert np.all(slope < 1.02 * steepest)
        heights.append(lying.max())
    # The profile whose slope everywhere is the steepest: x from dh / steepest_side(h).
    h = np.linspace(1e-4, 1.5, 3000)
    run = np.cumsum([(h[1] - h[0]) / steepest_side(each) for each in h])
    area = np.cumsum(np.diff(run, prepend=0.0) * h)
    assert heights == pytest.approx([np.interp(0.25, area, h)] * 2, rel=0.12)


def test_deep_snow_on_an_overhang_ends_in_a_slope():
    """Snow of .6 m on eaves two nodes wide is no higher there than its side stands."""
    position = np.full((9, 9, 3), np.nan, np.float32)
    position[2:7, 4:6] = [0.0, 0.0, 3.0]
    weight = np.zeros((9, 9), np.float32)
    weight[2:7, 4:6] = 1
    one, none = np.ones((9, 9), np.float32), np.zeros((9, 9), np.float32)
    thickest = []
    for ends in (True, False):
        catch = Catch(position, one, none, none, weight, none, ends)
        thickest.append(float(_columns((catch,), 0.6, H)[3].max()))
    assert thickest[0] == pytest.approx(H * EDGE_SIDE, rel=0.01)
    assert thickest[1] == pytest.approx(0.6)


def test_deep_snow_on_a_high_block_settles():
    """A block of 6 m under 2 m of snow, on a lattice of 3 cm, ends in slopes as snow stands."""
    spacing = 0.03
    base = np.zeros((3, 400))
    base[:, :200] = 6.0
    found = settled(base, np.full(base.shape, 2.0), spacing)
    assert found.sum() == pytest.approx(2.0 * base.size)
    for part in (found[1, :200], found[1, 200:]):
        limit = np.array([steepest_side(each) for each in part])
        slope = np.abs(np.diff(part)) / spacing
        assert np.all(slope < 1.01 * np.maximum(limit[1:], limit[:-1]))
    assert found[1, 199] < 1.01 * spacing * steepest_side(found[1, 199])


@pytest.mark.parametrize("depth", [0.3, 1.0, 2.0])
@pytest.mark.parametrize("width", [1, 3])
def test_a_pit_and_a_gap_hold_no_more_than_their_room(depth, width):
    for pit in (True, False):
        base = np.full((41, 41), 3.0)
        base[20 : 20 + width if pit else None, 20 : 20 + width] = 0.0
        found = settled(base, np.full(base.shape, depth), H)
        assert found.sum() == pytest.approx(depth * base.size)
        assert (base + found).max() <= 3.0 + depth + 1e-3


@pytest.mark.parametrize("spacing", [0.06, 0.12, 0.48])
def test_sides_and_banks_that_keep_nothing_are_free(spacing):
    """The upper half of a bank of 68 degrees below a plateau; no skin is thick enough to show."""
    base = np.tile(np.clip((70 - np.arange(120)) * 2.5 * spacing, 0, 150 * spacing), (3, 1))
    fell = np.where((base > 0) & (base < base.max()), 0.0, 0.3)
    found = settled(base, fell, spacing)
    assert found.sum() == pytest.approx(fell.sum())
    side = (fell == 0) & (base > base.max() / 2) & (np.arange(120) > 12)
    assert side.sum() > 60 and found[side].max() < _THINNEST


def test_nothing_that_falls_lands_above_where_it_came_from():
    """A narrow steep strip between a level roof and the ground, 3 and 6 m below."""
    for high in (3.0, 6.0):
        height = np.zeros((60, 160))
        height[:, :80] = high
        height[:, 80:86] = high - 1.5 * H * np.arange(1, 7)
        share = np.ones(height.shape)
        share[:, 80:86] = 0.0
        arrived = slid(1 - share, share, height, H)
        assert arrived[:, :80].sum() < 0.01 * arrived.sum()
        assert arrived.sum() == pytest.approx((1 - share).sum(), rel=0.02)
        foot = (np.arange(160) - 86) * H
        spread = math.sqrt((arrived * foot**2).sum() / arrived.sum())
        assert spread == pytest.approx(math.hypot(0.2 * high, 0.12), rel=0.25)


def test_what_falls_from_a_roof_lands_on_neither_side_of_a_wall_above_it():
    """A platform of 1 m beside a wall of 3 m: mirrored at the foot, nothing lands on the wall."""
    base = np.zeros((60, 120))
    base[:, 40:44], base[:, :40] = 1.0, 3.0
    fell = np.where(base == 1.0, 0.6, 0.0)
    found = settled(base, fell, H)
    assert found[:, :40].max() == 0
    assert found.sum() == pytest.approx(fell.sum())
    landed, away = found[:, 44:].sum(0), (np.arange(76) + 1) * H
    spread = math.sqrt((landed * away**2).sum() / landed.sum())
    assert spread == pytest.approx(0.24, abs=0.04)
    assert landed[0] < 0.2 * landed.sum(), "what would land on the wall lands before it"
