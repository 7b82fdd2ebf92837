"""One frame: rays of a camera traced, averaged over sub-pixels, with measured layers."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from climatenerf.core.cameras import Camera
from climatenerf.core.colour import encode_srgb
from climatenerf.core.device import CPU, to_device, to_numpy
from climatenerf.core.layer_table import ON_DEMAND, Layer
from climatenerf.field.capabilities import CLASSES, NORMALS
from climatenerf.field.protocol import RadianceField, device_of
from climatenerf.render.depth_normals import plane_normals
from climatenerf.render.heads import see_surface
from climatenerf.render.integrator import trace
from climatenerf.render.progressive import trace_coarse_first
from climatenerf.render.volume import camera_rays
from climatenerf.weather.registry import layer_table
from climatenerf.weather.world import World

Picture = UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True)
class FrameOptions:
    """What is wanted of a frame beside its picture.

    Attributes:
        supersample: rays per pixel along each side, 1 to 8; radiance is averaged, layers are taken
            from the ray next to the pixel's centre.
        normals: also the layer `normal`.
        labels: also the layer `label`, of a field that has learned classes.
        table: all layers that a frame can have; those that the weather does not write are filled
            with their no-data values.
        show: called with the display picture as it becomes finer; see `progressive`.
        cancelled: asked between chunks of rays; see `integrator.trace`.
    """

    supersample: int = 1
    normals: bool = False
    labels: bool = False
    table: Mapping[str, Layer] | None = None
    show: Callable[[Picture], None] | None = None
    cancelled: Callable[[], bool] | None = None


def encoded_8bit(linear: Float[Tensor, "h w 3"]) -> Picture:
    """Linear radiance as 8-bit display sRGB."""
    return to_numpy((encode_srgb(linear).clamp(0, 1) * 255 + 0.5).to(torch.uint8))


def traced_rays(
    camera: Camera, c2w: Float[np.ndarray, "4 4"], device: torch.device = CPU
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"], Float[Tensor, "n"]]:
    """The arguments of `trace` for a camera's pixels (c2w: world m), row by row, on `device`.

    Returns:
        Origins (world m), unit directions and the angle that each pixel spans (rad).
    """
    rays_o, rays_d = camera_rays(camera, c2w, device)
    # Side of the solid angle at the image centre; towards the corners pixels span a little less.
    angle = torch.full((rays_o.shape[0],), 1.0 / camera.fx, device=device)
    return rays_o, rays_d, angle


def render_frame(
    world: World,
    camera: Camera,
    c2w: Float[np.ndarray, "4 4"],
    options: FrameOptions | None = None,
) -> tuple[Picture, dict[str, Float[np.ndarray, "h w *c"]]]:
    """The display picture (8 bit) and the measured layers of one camera (c2w: world m)."""
    linear, layers = see_frame(world, camera, c2w, options)
    return encoded_8bit(linear), layers


def see_frame(
    world: World,
    camera: Camera,
    c2w: Float[np.ndarray, "4 4"],
    options: FrameOptions | None = None,
) -> tuple[Float[Tensor, "h w 3"], dict[str, Float[np.ndarray, "h w *c"]]]:
    """As `render_frame`, but the picture in linear radiance."""
    options = options or FrameOptions()
    height, width, fine = camera.height, camera.width, options.supersample
    fine_camera = camera.resized(width * fine, height * fine)
    rays = traced_rays(fine_camera, c2w, device_of(world.field))
    shape = (height, fine, width, fine)

    def averaged(rgb: Tensor) -> Float[Tensor, "h w 3"]:
        return rgb.reshape(*shape, 3).mean((1, 3))

    show = options.show
    if show is None:
        seen = trace(world, *rays, cancelled=options.cancelled)
    else:
        seen = trace_coarse_first(
            world,
            rays,
            fine_camera.width,
            lambda rgb: show(encoded_8bit(averaged(rgb))),
            options.cancelled,
        )
    table = layer_table() if options.table is None else options.table
    given = {"depth": seen.depth, "transmittance": seen.transmittance, **seen.layers}
    layers = {name: _middle(values, shape) for name, values in given.items()}
    for name in table.keys() - layers.keys() - ON_DEMAND:
        layers[name] = np.full((height, width), table[name].no_data, np.float32)
    if options.normals or options.labels:
        directions, angle = _middle(rays[1], shape), 1.0 / camera.fx
        normal, label = _surface(world.field, c2w[:3, 3], directions, options.cancelled)
        if options.labels and label is not None:
            layers["label"] = label
        if options.normals:
            if normal is None:
                normal = plane_normals(c2w[:3, 3], directions, layers["depth"], angle)
            weather = _middle(seen.normal, shape)
            known = (weather != 0).any(-1, keepdims=True)  # normals of surfaces and matter
            layers["normal"] = np.where(known, weather, normal)
    return averaged(seen.rgb), layers


def _surface(
    field: RadianceField,
    eye: Float[np.ndarray, "3"],
    directions: Float[np.ndarray, "h w 3"],
    cancelled: Callable[[], bool] | None,
) -> tuple[Float[np.ndarray, "h w 3"] | None, UInt8[np.ndarray, "h w"] | None]:
    """Learned normals and classes for a picture's rays; None for those that were not learned."""
    if not field.capabilities & {NORMALS, CLASSES}:
        return None, None
    device = device_of(field)
    rays_d = to_device(directions.reshape(-1, 3), device)
    origin = to_device(np.asarray(eye, np.float32), device).expand(rays_d.shape[0], 3)
    normal, label = see_surface(field, origin, rays_d, cancelled)
    return (
        to_numpy(normal.view(directions.shape)) if NORMALS in field.capabilities else None,
        to_numpy(label.view(directions.shape[:2])) if CLASSES in field.capabilities else None,
    )


def _middle(values: Tensor, shape: tuple[int, int, int, int]) -> np.ndarray:
    """Of each pixel's sub-pixels the one next to its centre."""
    middle = shape[1] // 2
    return to_numpy(values.view(*shape, *values.shape[1:])[:, middle, :, middle])
