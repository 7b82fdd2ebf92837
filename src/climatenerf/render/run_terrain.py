"""The terrain of a run folder: read, or made from the field and saved at first use."""

import contextlib
from collections.abc import Callable
from pathlib import Path

from climatenerf.core.errors import UserError
from climatenerf.field.protocol import RadianceField
from climatenerf.render.ground_evidence import find_terrain
from climatenerf.scene.scene import Scene
from climatenerf.scene.terrain import FILE_NAME, Terrain, load_terrain, save_terrain


def terrain_of_run(
    run: Path,
    field: RadianceField,
    scene: Scene,
    checkpoint: str,
    progress: Callable[[str, float], None] | None = None,
) -> Terrain | None:
    """Return the ground of a run; None if its photos show too little of it.

    Args:
        run: the run folder; a raster that is made is saved there, if it can be written.
        field: the fitted field.
        scene: its capture.
        checkpoint: identity of the field; a raster of another one is made again.
        progress: called with "ground" and the fraction that is done.

    Raises:
        UserError: the saved raster is damaged.
    """
    if (run / FILE_NAME).is_file():
        terrain, made_from = load_terrain(run / FILE_NAME)
        if made_from == checkpoint:
            return terrain
    report = progress or (lambda what, fraction: None)
    report("ground", 0.0)
    terrain = find_terrain(field, scene, lambda fraction: report("ground", fraction))
    with contextlib.suppress(UserError):  # a folder of somebody else: made again next time
        save_terrain(terrain, run, checkpoint)
    report("ground", 1.0)
    return terrain
