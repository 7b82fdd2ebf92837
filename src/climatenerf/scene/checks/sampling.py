"""Views whose sidecars are read, and the sparse points in them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from climatenerf.core.errors import UserError
from climatenerf.scene.checks.visibility import MAX_POINTS, visible
from climatenerf.scene.findings import Finding
from climatenerf.scene.scene import Scene, View

MAX_FILES = 24  # of each kind whose pixels are read
MIN_POINTS = 20  # points of a view on known depths, usable pixels or labels


def sample(views: Sequence[View], path_of: Callable[[View], Path | None]) -> list[View]:
    """Return up to `MAX_FILES` views that have a file, evenly spread."""
    having = [view for view in views if path_of(view) is not None]
    if len(having) <= MAX_FILES:
        return having
    return [having[i * len(having) // MAX_FILES] for i in range(MAX_FILES)]


@dataclass(frozen=True)
class Projected:
    """Sparse points of a view.

    Attributes:
        point: Rows of the points in the scene's.
        row: Pixel rows.
        column: Pixel columns.
        z: Z-depths, m.
        length: Distances from the camera, m.
    """

    point: np.ndarray
    row: np.ndarray
    column: np.ndarray
    z: np.ndarray
    length: np.ndarray


def projected(scene: Scene, view: View) -> Projected:
    """Return a view's own points where they are recorded, otherwise those visible in it."""
    points = np.empty((0, 3)) if scene.points is None else scene.points
    if view.seen is not None and len(view.seen):
        rows = view.seen
    else:
        step = max(1, -(-len(points) // MAX_POINTS))
        rows = np.arange(0, len(points), step)
        camera, c2w = scene.cameras[view.camera], view.c2w
        rows = rows[visible(camera, c2w, points[rows])]
    to_world = scene.world_from_input
    world = points[rows] @ to_world[:3, :3].T + to_world[:3, 3]
    c2w = scene.c2w_world(view)
    camera = scene.cameras[view.camera]
    local = (world - c2w[:3, 3]) @ c2w[:3, :3]
    with np.errstate(all="ignore"):  # points at infinity overflow, and are left out
        x, y = camera.project(local).T
    inside = (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height) & (local[:, 2] > 0)
    local = local[inside]
    return Projected(
        rows[inside],
        y[inside].astype(np.int64),
        x[inside].astype(np.int64),
        local[:, 2],
        np.linalg.norm(local, axis=1),
    )


def unreadable(error: UserError, path: Path | None, code: str = "unreadable") -> Finding:
    """Return the finding for a file that cannot be used, from the sentence of its reader."""
    cause, _, remedy = str(error).removesuffix(".").rpartition("; ")
    return Finding(code, cause or remedy, remedy if cause else "", "error", str(path))
