"""Removal of floaters: which components of occupied cells are emptied, and which stay."""

from pathlib import Path

import numpy as np
import pytest
import torch
from support.toy_scene import TINY

from climatenerf.core.cameras import Camera
from climatenerf.core.classes import BUILDING, ROAD
from climatenerf.field.hash_field import Field
from climatenerf.scene.photo_rays import PhotoRays
from climatenerf.scene.scene import View
from climatenerf.scene.terrain import Terrain
from climatenerf.training import floaters
from climatenerf.training.floaters import components, remove_floaters, touches_border

UNIT = 8.0  # m per grid unit
SIDE = 32  # occupancy cells; half a metre each in the first cascade
LUMP = (18, 18, 24)  # a cell four metres above the ground
PHOTOS = 6


def ground_below(lumps=(LUMP,)):
    """A field whose occupied cells are a layer of ground and some lumps of one cell."""
    field = Field(TINY, PHOTOS, np.zeros(3), UNIT, 0.1)
    field.occupancy = type(field.occupancy)(field.occupancy.cascades, SIDE)
    occupied = torch.zeros_like(field.occupancy.occupied)
    occupied[0, 4:-4, 4:-4, SIDE // 2 - 1] = 1
    for lump in lumps:
        occupied[(0, *lump)] = 1
    field.occupancy.occupied = occupied
    return field


def terrain():
    shape = (3, 3)
    flags = np.ones(shape, bool)
    height = np.zeros(shape, np.float32)
    label = np.full(shape, ROAD, np.uint8)
    return Terrain((-8.0, -8.0), 8.0, height, height + 0.01, label, flags, ~flags)


def photo(lumps, sees):
    """A photo of the ground from beside the lumps, which end some of its rays if it sees them.

    It looks along +x from 4 m away at the height of the lumps, or the other way.
    """
    cell = 2 * UNIT / SIDE
    middle = np.array([(np.array(each) + 0.5) * cell - UNIT for each in lumps]).reshape(-1, 3)
    aim = middle.mean(0) if len(lumps) else np.array([2.25, 2.25, 4.25])
    c2w = np.eye(4)
    towards = 1.0 if sees else -1.0
    c2w[:3, :3] = np.array([[0, -towards, 0], [0, 0, -1], [towards, 0, 0]]).T
    c2w[:3, 3] = aim - (4.0, 0.0, 0.0)
    size = 41
    camera = Camera(size, size, 20.0, 20.0, size / 2, size / 2)
    x = np.full((size, size, 3), np.inf)
    x[size // 2 + 1 :] = np.random.default_rng(0).uniform((-5, -5, -0.1), (5, 5, 0), (20, size, 3))
    t = np.full((size, size), 30.0)
    if sees:
        x[size // 2, : len(lumps)] = middle
        t[size // 2, size // 2] = 4.0
    t[np.isinf(x).all(-1)] = np.inf
    shape = (size, size)
    return PhotoRays(
        View("a.jpg", Path("a.jpg"), 0, c2w),
        camera,
        c2w,
        x,
        t,
        np.zeros((*shape, 3)),
        np.zeros((*shape, 3)),
        np.full(shape, BUILDING, np.uint8),
        np.zeros(shape, np.float32),
    )


def photos(lumps, seeing, count=PHOTOS):
    """Photos of which the first ones see the lumps."""
    return [photo(lumps, i < seeing) for i in range(count)]


def is_occupied(field, lump=LUMP):
    return bool(field.occupancy.occupied[(0, *lump)])


@pytest.mark.parametrize(("seeing", "stays"), [(1, False), (2, False), (3, True), (4, True)])
def test_a_lump_in_the_air_that_few_photos_see_is_removed(seeing, stays):
    field = ground_below()
    before = field.occupancy.occupied.clone()
    removed = remove_floaters(field, photos([LUMP], seeing), terrain())
    assert removed == (not stays) and is_occupied(field) == stays
    before[(0, *LUMP)] = int(stays)
    assert torch.equal(field.occupancy.occupied, before)
    assert bool(field.occupancy.forced_empty[(0, *LUMP)]) == (not stays)
    assert int(field.occupancy.forced_empty.sum()) == removed
    assert remove_floaters(field, photos([], 0), terrain()) == 0, "nothing more"


def test_what_stands_on_ground_that_holds_no_density_stays():
    """A component of its own, less than `STANDING_HEIGHT` above the terrain."""
    low, high = (18, 18, 16), (18, 18, 17)
    for lump, removed in ((low, 0), (high, 1)):
        field = ground_below([lump])
        field.occupancy.occupied[0, 14:23, 14:23, SIDE // 2 - 1] = 0
        assert remove_floaters(field, photos([lump], 1), terrain()) == removed
        assert is_occupied(field, lump) != removed


def test_a_photo_that_has_the_lump_in_its_frame_sees_it_though_no_ray_meets_it():
    """Of a thousand photos each has few rays."""
    field = ground_below()
    many = [photo([LUMP], True) for _ in range(PHOTOS)]
    for each in many[1:]:
        each.x[20, 0] = np.inf  # its ray to the lump
        each.t[20, 20] = np.inf
    assert remove_floaters(field, many, terrain()) == 0 and is_occupied(field)
    for each in many[1:]:
        each.t[20, 20] = 2.0  # something in front hides it
    assert remove_floaters(field, many, terrain()) == 1


def test_nothing_is_removed_from_captures_of_few_photos():
    field = ground_below()
    assert remove_floaters(field, photos([LUMP], 1, count=5), terrain()) == 0


def test_what_stands_on_the_ground_or_is_attached_stays():
    on_ground, stack = (10, 10, 16), [(10, 10, 16), (10, 10, 17), (11, 11, 18)]
    for lumps in ([on_ground], stack):
        field = ground_below(lumps)
        assert remove_floaters(field, photos(lumps, 1), terrain()) == 0
        assert all(is_occupied(field, lump) for lump in lumps)


def test_what_no_ray_ends_in_stays_and_what_holds_many_ends(monkeypatch):
    field = ground_below()
    assert remove_floaters(field, photos([], 0), terrain()) == 0 and is_occupied(field)
    monkeypatch.setattr(floaters, "MAIN_FRACTION", 1e-5)
    assert remove_floaters(field, photos([LUMP], 1), terrain()) == 0 and is_occupied(field)


def test_nothing_is_removed_without_a_terrain():
    field = ground_below()
    assert remove_floaters(field, photos([LUMP], 1), None) == 0 and is_occupied(field)


def test_a_component_at_the_border_of_its_cascade_may_go_on_beyond():
    border = (18, 18, SIDE - 1)
    field = ground_below([border])
    assert remove_floaters(field, photos([border], 1), terrain()) == 0
    cells = np.zeros((2, SIDE, SIDE, SIDE), np.uint8)
    quarter = SIDE // 4
    inside, at_finer, free = (16, 16, 16), (quarter - 1, 16, 16), (2, 16, 16)
    for cell in (inside, at_finer, free):
        cells[(1, *cell)] = 1
    found, count = components(cells)
    assert count == 3
    touching = touches_border(found, count)
    assert [bool(touching[found[(1, *cell)]]) for cell in (inside, at_finer, free)] == [
        True,
        True,
        False,
    ]


def test_components_join_at_corners_and_are_numbered_through():
    cells = np.zeros((2, 8, 8, 8), np.uint8)
    cells[0, 1, 1, 1] = cells[0, 2, 2, 2] = cells[0, 5, 5, 5] = cells[1, 1, 1, 1] = 1
    found, count = components(cells)
    assert count == 3 and found[0, 1, 1, 1] == found[0, 2, 2, 2]
    assert len({int(found[0, 1, 1, 1]), int(found[0, 5, 5, 5]), int(found[1, 1, 1, 1]), 0}) == 4
    assert (found > 0).sum() == 4
