"""The clean view: what cameras see of the field, with nothing added. No gradients."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.core.cameras import Camera
from climatenerf.core.colour import encode_srgb
from climatenerf.core.device import to_device, to_numpy
from climatenerf.core.samples import MIN_WEIGHT, offsets_of
from climatenerf.field.protocol import FUSED, RadianceField
from climatenerf.ops import compositing

RAYS_AT_ONCE = 16384  # bounds memory; the march buffers take 12 kB a ray
GPU_RAYS_AT_ONCE = 2**16  # there each launch costs; a wet ray sends five, all traced together
# Of the step that fits end with. Longer ones meet what is thin and dense by chance: with .5, 1, 1.5
# and 2 fox has 30.66, 30.56, 29.98 and 29.01 dB (`benchmarks/render_step.py`).
RENDER_STEP = 1.0


def camera_rays(
    camera: Camera, c2w: Float[np.ndarray, "4 4"]
) -> tuple[Float[Tensor, "hw 3"], Float[Tensor, "hw 3"]]:
    """Origins (world m) and unit directions of all pixels, row by row."""
    directions = to_device(camera.directions().reshape(-1, 3).astype(np.float32))
    pose = to_device(np.asarray(c2w, np.float32))
    rays_d = directions @ pose[:3, :3].T
    return pose[:3, 3].expand(rays_d.shape[0], 3).contiguous(), rays_d.contiguous()


def rays_at_once(rays: Tensor) -> int:
    """How many rays are traced together on the device that these are on."""
    return RAYS_AT_ONCE if rays.device.type == "cpu" else GPU_RAYS_AT_ONCE


@torch.no_grad()
def composited(
    field: RadianceField,
    rays_o: Float[Tensor, "n 3"],
    rays_d: Float[Tensor, "n 3"],
    t_min: Float[Tensor, "n"],
    step_scale: float = RENDER_STEP,
    stop: float = 1e-3,
    pruning_threshold: float | None = None,
    appearance: Float[Tensor, "1 e"] | None = None,
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"], Float[Tensor, "n"]]:
    """March rays through a field and composite its samples, without the sky behind them.

    Args:
        field: any field.
        rays_o: origins, m.
        rays_d: unit directions.
        t_min: ray length at which each ray begins, m.
        step_scale: factor on the marching step.
        stop: transmittance at which a ray ends.
        pruning_threshold: see `RadianceField.march`.
        appearance: exposure and light of a photo; None: the mean of all photos.

    Returns:
        Linear radiance, transmittance, and the weighted sum of the samples' ray lengths (m).
    """
    if FUSED in field.capabilities:
        return field.composite(
            rays_o, rays_d, t_min, step_scale, stop, pruning_threshold, appearance
        )
    endless = torch.full_like(t_min, 1e9)
    samples = field.march(
        rays_o, rays_d, t_min, endless, step_scale, stop=stop, pruning_threshold=pruning_threshold
    )
    weights, left = compositing.render_weights(samples.sigma * samples.dt, samples.offsets)
    far = compositing.accumulate(weights, samples.t[:, None], samples.offsets)[:, 0]
    keep = (weights > MIN_WEIGHT).nonzero()[:, 0]
    ray = samples.ray_index()[keep]
    x = rays_o[ray] + samples.t[keep, None] * rays_d[ray]
    ids = None if samples.ids is None else samples.ids[keep]
    colour = field.colour(x, rays_d, ray, ids=ids, appearance=appearance)
    offsets = offsets_of(ray, t_min.shape[0])
    return compositing.accumulate(weights[keep], colour, offsets), left, far


@torch.no_grad()
def field_radiance(
    field: RadianceField,
    rays_o: Float[Tensor, "n 3"],
    rays_d: Float[Tensor, "n 3"],
    appearance: Float[Tensor, "1 e"] | None = None,
) -> Float[Tensor, "n 3"]:
    """Linear radiance along camera rays; `appearance` None: the mean of all photos."""
    out = []
    size = rays_at_once(rays_o)
    for o, d in zip(rays_o.split(size), rays_d.split(size), strict=True):
        near = torch.full((o.shape[0],), field.near)
        matter, left, _ = composited(field, o, d, near, appearance=appearance)
        out.append(matter + left[:, None] * field.sky(d, appearance))
    return torch.cat(out)


def render_view(
    field: RadianceField,
    camera: Camera,
    c2w: Float[np.ndarray, "4 4"],
    appearance: Float[Tensor, "1 e"] | None = None,
) -> Float[np.ndarray, "h w 3"]:
    """Display picture in [0,1] of the clean scene from one camera (c2w in world metres)."""
    linear = field_radiance(field, *camera_rays(camera, c2w), appearance)
    return to_numpy(encode_srgb(linear).clamp(0, 1).reshape(camera.height, camera.width, 3))
