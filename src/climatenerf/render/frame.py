"""One frame: rays of a camera traced, averaged over sub-pixels, encoded."""

from dataclasses import fields

import numpy as np
import torch
from jaxtyping import Float, UInt8

from climatenerf.field.colour_space import encode_srgb
from climatenerf.render.trace import trace
from climatenerf.render.view import camera_rays
from climatenerf.render.world import Seen, World
from climatenerf.scene.cameras import Camera
from climatenerf.weather.flood import pixel_roll


def render_frame(
    world: World,
    camera: Camera,
    c2w: Float[np.ndarray, "4 4"],
    supersample: int = 1,
    normals: bool = False,
) -> tuple[UInt8[np.ndarray, "h w 3"], dict[str, Float[np.ndarray, "h w *c"]]]:
    """The display picture (8 bit) and the measured layers of one camera.

    Args:
        world: field and weather at this moment.
        camera: intrinsics of the frame.
        c2w: its pose, world m.
        supersample: rays per pixel along each side; colours are averaged in linear light, layers
            taken from the ray next to the pixel's centre.
        normals: also the layer `normal`.
    """
    height, width = camera.height, camera.width
    fine = camera.resized(width * supersample, height * supersample)
    rays_o, rays_d = camera_rays(fine, c2w)
    # Solid angle's side at the image centre; towards the corners pixels see a little less.
    angle = torch.full((rays_o.shape[0],), 1.0 / fine.fx)
    row, column = torch.meshgrid(torch.arange(fine.height), torch.arange(fine.width), indexing="ij")
    roll = pixel_roll(torch.stack([column.flatten(), row.flatten()], dim=-1).float())
    seen = trace(world, rays_o, rays_d, angle, roll, normals)
    linear = seen.rgb.view(height, supersample, width, supersample, 3).mean((1, 3))
    display = (encode_srgb(linear).clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy()
    return display, _layers(seen, height, width, supersample, normals)


def _layers(
    seen: Seen, height: int, width: int, supersample: int, normals: bool
) -> dict[str, np.ndarray]:
    layers = {}
    middle = supersample // 2
    for each in fields(seen):
        if each.name == "rgb" or (each.name == "normal" and not normals):
            continue
        values = getattr(seen, each.name)
        grid = values.view(height, supersample, width, supersample, *values.shape[1:])
        layers[each.name] = grid[:, middle, :, middle].numpy()
    return layers
