"""Removal of floaters at the end of a fit: pieces of density that few photos support.

Occupied cells that touch form components. Rays of all photos are traced on the fitted field, and
each ray supports the component that it ends in. A component is removed if too few photos support
it, and it neither stands on the ground nor holds much of what the photos show. A lump before one
camera explains a corner of that photo, and every other photo sees through it or past it.
"""

from typing import Any

import numpy as np
from jaxtyping import Bool, Int
from scipy import ndimage

from climatenerf.core.device import to_device, to_numpy
from climatenerf.field.hash_field import Field
from climatenerf.render.photo_rays import PhotoRays
from climatenerf.scene.terrain import Terrain

MIN_PHOTOS = 3  # that support a component
MIN_RAYS = 2  # of a photo that supports it: its rays are a sample of its pixels
MAIN = 0.01  # fraction of all ends that makes a component part of the scene
STANDS = 0.3  # m above the terrain within which a component stands on the ground
TOUCHING = np.ones((3, 3, 3), int)  # cells that share a face, an edge or a corner


def remove_floaters(field: Field, photos: list[PhotoRays], terrain: Terrain | None) -> int:
    """Empty the cells of floaters for good, and return their number.

    Args:
        field: a fitted field; its occupancy is changed in place.
        photos: rays of all photos on it, with unobserved density.
        terrain: its ground; None: nothing is removed, since lumps could be ground.
    """
    if terrain is None:
        return 0
    occupancy = field.occupancy
    component, count = components(to_numpy(occupancy.occupied))
    ends = np.zeros(count + 1)
    supports = np.zeros(count + 1, int)
    lowest = np.full(count + 1, np.inf)
    for photo in photos:
        x = photo.x[np.isfinite(photo.t)]
        q = field.to_grid(to_device(x.astype(np.float32), field.centre.device))
        cell, inside = (to_numpy(each) for each in occupancy.cell_index(q))
        found = component.reshape(-1)[cell[inside]]
        rays = np.bincount(found, minlength=count + 1)
        ends += rays
        supports += rays >= MIN_RAYS
        above = x[inside, 2] - terrain.sample(terrain.height, x[inside, :2])
        np.minimum.at(lowest, found, above)
    floats = (ends > 0) & (supports < MIN_PHOTOS) & (ends < MAIN * ends.sum()) & (lowest > STANDS)
    floats[0] = False  # ends in no occupied cell
    floats &= ~touches_border(component, count)
    cells = to_device(floats[component], occupancy.occupied.device)
    occupancy.occupied[cells] = 0
    occupancy.forced_empty |= cells
    return int(floats.sum())


def components(
    occupied: Bool[np.ndarray, "cascades side side side"],
) -> tuple[Int[np.ndarray, "cascades side side side"], int]:
    """Return the component of each occupied cell, from 1 on, and their number; 0 elsewhere."""
    found, count = np.zeros(occupied.shape, np.int32), 0
    for cascade, cells in enumerate(occupied):
        labelled: Any = ndimage.label(cells, TOUCHING)
        found[cascade] = np.where(labelled[0] > 0, labelled[0] + count, 0)
        count += labelled[1]
    return found, count


def touches_border(
    component: Int[np.ndarray, "cascades side side side"], count: int
) -> Bool[np.ndarray, "count+1"]:
    """Return which components touch the border of their cascade, beyond which they may go on."""
    touching = np.zeros(count + 1, bool)
    side = component.shape[-1]
    quarter = side // 4
    inner = slice(quarter - 1, side - quarter + 1)
    for cascade, cells in enumerate(component):
        shell = np.zeros(cells.shape, bool)
        if cascade:  # the next finer cascade holds what is inside
            shell[inner, inner, inner] = True
        shell[[0, -1]] = shell[:, [0, -1]] = shell[:, :, [0, -1]] = True
        touching[cells[shell]] = True
    return touching
