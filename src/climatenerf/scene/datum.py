"""The ground datum of a fitted scene: moved to the terrain where the two disagree.

Before a fit the datum comes from sparse points below the cameras, or from an assumed camera height.
The terrain of the fit is better evidence where the field holds ground below the cameras.
"""

from dataclasses import replace

import numpy as np

from climatenerf.scene.scene import Scene
from climatenerf.scene.terrain import Terrain

MAX_ERROR = 0.1  # m; the terrain below the cameras must be known as well as this
DISAGREEMENT = 0.1  # m, besides two errors of the terrain, from which the datum is wrong


def with_datum(scene: Scene, terrain: Terrain | None) -> Scene:
    """Return the scene with the median terrain height below its cameras as datum, if that differs.

    Only cameras above ground that the field holds count, and only if they are half of all.

    Args:
        scene: the fitted capture.
        terrain: its ground; None keeps the datum.
    """
    views = scene.of_split("train")
    if terrain is None or not views:
        return scene
    below = np.stack([scene.c2w_world(view)[:2, 3] for view in views])
    below = below[terrain.contains(below)]
    column, row = np.rint((below - np.array(terrain.origin)) / terrain.cell).astype(int).T
    below = below[terrain.seen[row, column]]
    if 2 * len(below) < len(views):
        return scene
    height = float(np.median(terrain.sample(terrain.height, below)))
    error = float(np.median(terrain.sample(terrain.error, below)))
    if error > MAX_ERROR or abs(height - scene.ground_z) < DISAGREEMENT + 2 * error:
        return scene
    return replace(scene, ground_z=height, lowest_ground_z=min(scene.lowest_ground_z, height))
