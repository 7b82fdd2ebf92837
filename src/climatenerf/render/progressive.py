"""A frame that shows early: a sixteenth of its pixels all over it, then a quarter, then all.

What a ray sees does not depend on the rays beside it, so none is traced twice, and the last picture
is that of `render_frame`, but for roundings.
"""

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Float, UInt8

from climatenerf.render.frame import encoded_8bit, traced_rays
from climatenerf.render.trace import trace
from climatenerf.render.world import World
from climatenerf.scene.cameras import Camera

SPACINGS = (4, 2, 1)  # pixels between those that are known after each pass


def progressive_frames(
    world: World, camera: Camera, c2w: Float[np.ndarray, "4 4"]
) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Display pictures (8 bit) of one camera, each finer than the one before, the last complete.

    A pixel that is not known yet shows the nearest known one above and left of it. World, camera
    and c2w as in `render_frame`; one ray a pixel, no layers.
    """
    rays = traced_rays(camera, c2w)
    row, column = torch.meshgrid(
        torch.arange(camera.height), torch.arange(camera.width), indexing="ij"
    )
    linear = torch.zeros(camera.height, camera.width, 3)
    known = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    for spacing in SPACINGS:
        asked = (row % spacing == 0) & (column % spacing == 0) & ~known
        some = asked.flatten().nonzero()[:, 0]
        if some.numel():
            linear[asked] = trace(world, *(each[some] for each in rays)).rgb
            known |= asked
        yield encoded_8bit(linear[row // spacing * spacing, column // spacing * spacing])
