"""Removal of floaters: which components of occupied cells are emptied, and which stay."""

from pathlib import Path

import numpy as np
import pytest
import torch
from support.toy_scene import TINY

from climatenerf.core.cameras import Camera
from climatenerf.core.classes import BUILDING, ROAD
from climatenerf.field.hash_field import Field
from climatenerf.render.photo_rays import PhotoRays
from climatenerf.scene.scene import View
from climatenerf.scene.terrain import Terrain
from climatenerf.training import floaters
from climatenerf.training.floaters import components, remove_floaters, touches_border

UNIT = 8.0  # m per grid unit
SIDE = 32  # occupancy cells; half a metre each in the first cascade
LUMP = (18, 18, 24)  # a cell four metres above the ground
PHOTOS = 4


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


def photo(cells, rays=3):
    """A photo of the ground, some of whose rays end in given cells."""
    cell = 2 * UNIT / SIDE
    middle = [(np.array(each) + 0.5) * cell - UNIT for each in cells for _ in range(rays)]
    ground = [(x, y, -0.1) for x in np.linspace(-5, 5, 30) for y in np.linspace(-5, 5, 30)]
    x = np.array([*middle, *ground])[None]
    shape = x.shape[:2]
    view = View("a.jpg", Path("a.jpg"), 0, np.eye(4))
    return PhotoRays(
        view,
        Camera(x.shape[1], 1, 1.0, 1.0, 0.0, 0.0),
        np.eye(4),
        x,
        np.ones(shape),
        np.zeros((*shape, 3)),
        np.zeros((*shape, 3)),
        np.full(shape, BUILDING, np.uint8),
        np.zeros(shape, np.float32),
    )


def photos(cells, supporting, rays=3):
    """Photos of which the first ones show the lumps."""
    return [photo(cells if i < supporting else [], rays) for i in range(PHOTOS)]


def is_occupied(field, lump=LUMP):
    return bool(field.occupancy.occupied[(0, *lump)])


@pytest.mark.parametrize(("supporting", "stays"), [(1, False), (2, False), (3, True), (4, True)])
def test_a_lump_in_the_air_that_few_photos_support_is_removed(supporting, stays):
    field = ground_below()
    before = field.occupancy.occupied.clone()
    removed = remove_floaters(field, photos([LUMP], supporting), terrain())
    assert removed == (not stays) and is_occupied(field) == stays
    before[(0, *LUMP)] = int(stays)
    assert torch.equal(field.occupancy.occupied, before)
    assert bool(field.occupancy.forced_empty[(0, *LUMP)]) == (not stays)
    assert int(field.occupancy.forced_empty.sum()) == removed
    assert remove_floaters(field, photos([], 0), terrain()) == 0, "nothing more"


def test_single_rays_are_no_support():
    field = ground_below()
    assert remove_floaters(field, photos([LUMP], PHOTOS, rays=1), terrain()) == 1


def test_what_stands_on_the_ground_or_is_attached_stays():
    on_ground, stack = (10, 10, 16), [(10, 10, 16), (10, 10, 17), (11, 11, 18)]
    for lumps in ([on_ground], stack):
        field = ground_below(lumps)
        assert remove_floaters(field, photos(lumps, 1), terrain()) == 0
        assert all(is_occupied(field, lump) for lump in lumps)


def test_what_no_ray_ends_in_stays_and_what_holds_many_ends():
    field = ground_below()
    assert remove_floaters(field, photos([], 0), terrain()) == 0 and is_occupied(field)
    many = photos([LUMP], 1, rays=int(1.1 * floaters.MAIN * PHOTOS * 900))
    assert remove_floaters(field, many, terrain()) == 0 and is_occupied(field)


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
