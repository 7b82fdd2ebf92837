"""One frame: rays of a camera traced, averaged over sub-pixels, encoded."""

from collections.abc import Callable
from dataclasses import fields

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from climatenerf.core.cameras import Camera
from climatenerf.core.colour import encode_srgb
from climatenerf.core.device import to_device, to_numpy
from climatenerf.field.protocol import CLASSES, NORMALS, RadianceField
from climatenerf.render.depth_normals import plane_normals
from climatenerf.render.heads import see_surface
from climatenerf.render.integrator import trace
from climatenerf.render.progressive import trace_coarse_first
from climatenerf.render.volume import camera_rays
from climatenerf.weather.flood.optics import pixel_rotation
from climatenerf.weather.world import World


def render_frame(
    world: World,
    camera: Camera,
    c2w: Float[np.ndarray, "4 4"],
    supersample: int = 1,
    normals: bool = False,
    labels: bool = False,
    show: Callable[[UInt8[np.ndarray, "h w 3"]], None] | None = None,
) -> tuple[UInt8[np.ndarray, "h w 3"], dict[str, Float[np.ndarray, "h w *c"]]]:
    """The display picture (8 bit) and the measured layers of one camera.

    Args:
        world: field and weather at this moment.
        camera: intrinsics of the frame.
        c2w: its pose, world m.
        supersample: rays per pixel along each side; colours are averaged in linear light, layers
            taken from the ray next to the pixel's centre.
        normals: also the layer `normal`.
        labels: also the layer `label`, of a field that has learned classes.
        show: called with the display picture as it becomes finer; see `progressive`.
    """
    linear, layers = see_frame(world, camera, c2w, supersample, normals, labels, show)
    return encoded_8bit(linear), layers


def encoded_8bit(linear: Float[Tensor, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Linear radiance as a screen shows it."""
    return to_numpy((encode_srgb(linear).clamp(0, 1) * 255 + 0.5).to(torch.uint8))


def traced_rays(
    camera: Camera, c2w: Float[np.ndarray, "4 4"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"], Float[Tensor, "n"], Float[Tensor, "n"]]:
    """What `trace` wants of a camera's pixels (c2w: world m), row by row.

    Returns:
        Origins (world m), unit directions, the angle each pixel spans, and the turn of its glossy
        reflection (both rad).
    """
    rays_o, rays_d = camera_rays(camera, c2w)
    # Solid angle's side at the image centre; towards the corners pixels see a little less.
    angle = torch.full((rays_o.shape[0],), 1.0 / camera.fx)
    row, column = torch.meshgrid(
        torch.arange(camera.height), torch.arange(camera.width), indexing="ij"
    )
    roll = pixel_rotation(torch.stack([column.flatten(), row.flatten()], dim=-1).float())
    return rays_o, rays_d, angle, roll


def see_frame(
    world: World,
    camera: Camera,
    c2w: Float[np.ndarray, "4 4"],
    supersample: int = 1,
    normals: bool = False,
    labels: bool = False,
    show: Callable[[UInt8[np.ndarray, "h w 3"]], None] | None = None,
) -> tuple[Float[Tensor, "h w 3"], dict[str, Float[np.ndarray, "h w *c"]]]:
    """As `render_frame`, but the picture in linear light."""
    height, width = camera.height, camera.width
    fine = camera.resized(width * supersample, height * supersample)
    rays = traced_rays(fine, c2w)
    rays_d = rays[1]
    shape = (height, supersample, width, supersample)

    def averaged(rgb: Tensor) -> Float[Tensor, "h w 3"]:
        return rgb.reshape(*shape, 3).mean((1, 3))

    if show is None:
        seen = trace(world, *rays)
    else:
        seen = trace_coarse_first(
            world, rays, fine.width, lambda rgb: show(encoded_8bit(averaged(rgb)))
        )
    linear = averaged(seen.rgb)
    layers = {
        each.name: _middle(getattr(seen, each.name), shape)
        for each in fields(seen)
        if each.name != "rgb" and (each.name != "normal" or normals)
    }
    if normals or labels:
        directions, angle = _middle(rays_d, shape), 1.0 / camera.fx
        solid, kind = _surface(world.field, c2w[:3, 3], directions)
        if labels and kind is not None:
            layers["label"] = kind
        if solid is None:
            solid = plane_normals(c2w[:3, 3], directions, layers["depth"], angle)
    if normals:
        known = (layers["normal"] != 0).any(-1, keepdims=True)  # of water and snow
        layers["normal"] = np.where(known, layers["normal"], solid)
    return linear, layers


def _surface(
    field: RadianceField, eye: Float[np.ndarray, "3"], directions: Float[np.ndarray, "h w 3"]
) -> tuple[Float[np.ndarray, "h w 3"] | None, UInt8[np.ndarray, "h w"] | None]:
    """Normals and classes that the field has learned for a picture's rays; None what it has not."""
    if not field.capabilities & {NORMALS, CLASSES}:
        return None, None
    rays_d = to_device(directions.reshape(-1, 3))
    origin = to_device(np.asarray(eye, np.float32)).expand(rays_d.shape[0], 3)
    normal, label = see_surface(field, origin, rays_d)
    return (
        to_numpy(normal.view(directions.shape)) if NORMALS in field.capabilities else None,
        to_numpy(label.view(directions.shape[:2])) if CLASSES in field.capabilities else None,
    )


def _middle(values: Tensor, shape: tuple[int, int, int, int]) -> np.ndarray:
    """Of each pixel's sub-pixels the one next to its centre."""
    middle = shape[1] // 2
    return to_numpy(values.view(*shape, *values.shape[1:])[:, middle, :, middle])
