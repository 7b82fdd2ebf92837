"""Rays of cameras, and the clean view: the field with nothing added. No gradients."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.core.cameras import Camera
from climatenerf.core.colour import encode_srgb
from climatenerf.core.device import CPU, to_device, to_numpy
from climatenerf.field.compositing import chunks, composited
from climatenerf.field.protocol import RadianceField, device_of


def camera_rays(
    camera: Camera, c2w: Float[np.ndarray, "4 4"], device: torch.device = CPU
) -> tuple[Float[Tensor, "hw 3"], Float[Tensor, "hw 3"]]:
    """Origins (world m) and unit directions of all pixels, row by row, on `device`."""
    directions = to_device(camera.directions().reshape(-1, 3).astype(np.float32), device)
    pose = to_device(np.asarray(c2w, np.float32), device)
    rays_d = directions @ pose[:3, :3].T
    return pose[:3, 3].expand(rays_d.shape[0], 3).contiguous(), rays_d.contiguous()


@torch.no_grad()
def field_radiance(
    field: RadianceField,
    rays_o: Float[Tensor, "n 3"],
    rays_d: Float[Tensor, "n 3"],
    appearance: Float[Tensor, "1 e"] | None = None,
) -> Float[Tensor, "n 3"]:
    """Linear radiance along camera rays; `appearance` None: the mean of all photos."""
    out = []
    for chunk in chunks(rays_o):
        o, d = rays_o[chunk], rays_d[chunk]
        near = torch.full((o.shape[0],), field.near, device=o.device)
        matter, transmittance, _ = composited(field, o, d, near, appearance=appearance)
        out.append(matter + transmittance[:, None] * field.sky(d, appearance))
    return torch.cat(out)


def render_view(
    field: RadianceField,
    camera: Camera,
    c2w: Float[np.ndarray, "4 4"],
    appearance: Float[Tensor, "1 e"] | None = None,
) -> Float[np.ndarray, "h w 3"]:
    """Display picture in [0,1] of the clean scene from one camera (c2w in world metres)."""
    linear = field_radiance(field, *camera_rays(camera, c2w, device_of(field)), appearance)
    return to_numpy(encode_srgb(linear).clamp(0, 1).reshape(camera.height, camera.width, 3))
