"""Sparse points that photos show, where no file records them.

A point is taken as visible in a photo if it lies inside it and no other point in the same cell of a
coarse grid is much nearer: a z-buffer (Catmull 1974) of points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from climatenerf.core.cameras import Camera
from climatenerf.scene.scene import Scene

MAX_POINTS = 20_000  # of a scene that are projected
CELLS = 48  # of the grid along the longer side
THICKNESS = 1.05  # depth over the least one of the cell up to which points are visible


def with_visible_points(scene: Scene, chosen: Sequence[int]) -> Scene:
    """Return the scene with the rows of visible points in `seen` of the chosen views.

    Args:
        scene: Scene with points.
        chosen: Indices of views.
    """
    points = scene.points
    assert points is not None
    count = min(len(points), MAX_POINTS)
    rows = np.arange(count) * len(points) // max(count, 1)
    views = list(scene.views)
    for i in chosen:
        camera = scene.cameras[views[i].camera]
        views[i] = replace(views[i], seen=rows[visible(camera, views[i].c2w, points[rows])])
    return replace(scene, views=tuple(views))


def visible(
    camera: Camera, c2w: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "n 3"]
) -> Int[np.ndarray, " m"]:
    """Return the rows of the points that no other point hides.

    Args:
        camera: Intrinsics.
        c2w: Pose in the frame of the points.
        points: Positions.
    """
    with np.errstate(all="ignore"):  # points at infinity overflow, and are left out
        local = (points - c2w[:3, 3]) @ c2w[:3, :3]
        x, y = camera.project(local).T
    inside = (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height) & (local[:, 2] > 0)
    rows = np.flatnonzero(inside)
    depth = local[rows, 2]
    cell = CELLS * np.stack([y[rows], x[rows]]) // max(camera.width, camera.height)
    index = (cell[0] * CELLS + cell[1]).astype(np.int64)
    nearest = np.full(CELLS * CELLS, np.inf)
    np.minimum.at(nearest, index, depth)
    return rows[depth < THICKNESS * nearest[index]]
