"""Removal of floaters at the end of a fit: pieces of density that few photos see.

Occupied cells that touch form components. Rays of all photos, a sample of their pixels, are traced
on the fitted field. A component in the air that holds few of their ends is a candidate. It is
removed if only one or two photos have it in their frame with nothing in front: a lump before one
camera explains a corner of that photo, and no other photo contradicts it.
"""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy import ndimage

from climatenerf.core.device import to_device, to_numpy
from climatenerf.field.hash_field import Field
from climatenerf.scene.photo_rays import PhotoRays
from climatenerf.scene.terrain import Terrain

MIN_PHOTOS = 3  # that see a component
MIN_CAPTURE = 6  # photos; in smaller captures nothing is removed
MAIN_FRACTION = 0.01  # of all ends, that makes a component part of the scene
STANDING_HEIGHT = 0.3  # m above the terrain within which a component stands on the ground
MAX_CELLS = 32  # of a component, that are looked for in photos
HIDDEN = 0.02  # relative, besides a cell: what ends so much nearer hides a cell
TOUCHING = np.ones((3, 3, 3), int)  # cells that share a face, an edge or a corner


def remove_floaters(field: Field, photos: list[PhotoRays], terrain: Terrain | None) -> int:
    """Empty the cells of floaters for good, and return the number of components removed.

    Args:
        field: a fitted field; its occupancy is changed in place.
        photos: rays of all photos on it.
        terrain: its ground; None: nothing is removed, since lumps could be ground.
    """
    if terrain is None or len(photos) < MIN_CAPTURE:
        return 0
    occupancy = field.occupancy
    component, count = components(to_numpy(occupancy.occupied))
    ends = np.zeros(count + 1)
    lowest = np.full(count + 1, np.inf)
    for photo in photos:
        x = photo.x[np.isfinite(photo.t)]
        q = field.to_grid(to_device(x.astype(np.float32), field.centre.device))
        cell, inside = (to_numpy(each) for each in occupancy.cell_index(q))
        found = component.reshape(-1)[cell[inside]]
        ends += np.bincount(found, minlength=count + 1)
        above = x[inside, 2] - terrain.sample(terrain.height, x[inside, :2])
        np.minimum.at(lowest, found, above)
    floats = (ends > 0) & (ends < MAIN_FRACTION * ends.sum()) & (lowest > STANDING_HEIGHT)
    floats[0] = False  # ends in no occupied cell
    floats &= ~touches_border(component, count)
    occupied = np.flatnonzero(component)
    occupied = occupied[np.argsort(component.reshape(-1)[occupied], kind="stable")]
    last = np.cumsum(np.bincount(component.reshape(-1)[occupied], minlength=count + 1))
    for number in np.flatnonzero(floats):
        cells = occupied[last[number - 1] : last[number]]
        cells = cells[:: -(-len(cells) // MAX_CELLS)]
        q, size = occupancy.cell_centres(to_device(cells, field.centre.device))
        x = to_numpy(q * field.unit + field.centre).astype(np.float64)
        floats[number] = photos_seeing(x, float(size[0]) * field.unit, photos) < MIN_PHOTOS
    emptied = to_device(floats[component], occupancy.occupied.device)
    occupancy.occupied[emptied] = 0
    occupancy.forced_empty |= emptied
    return int(floats.sum())


def photos_seeing(x: Float[np.ndarray, "n 3"], size: float, photos: list[PhotoRays]) -> int:
    """Return how many photos have one of some cells in their frame with nothing in front of it.

    Args:
        x: centres of the cells, world m.
        size: side of a cell, m.
        photos: rays of all photos.
    """
    seeing = 0
    for photo in photos:
        local = (x - photo.c2w[:3, 3]) @ photo.c2w[:3, :3]
        pixel = photo.camera.project(local)
        height, width = photo.t.shape
        inside = ((pixel >= 0) & (pixel < (width, height))).all(-1)  # NaN behind: False
        column, row = pixel[inside].astype(int).T
        distance = np.linalg.norm(local[inside], axis=-1)
        seeing += bool((photo.t[row, column] > (1 - HIDDEN) * distance - size).any())
    return seeing


def components(
    occupied: UInt8[np.ndarray, "cascades side side side"],
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
