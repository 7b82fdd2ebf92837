"""Where the rays of the photos end on the fitted field; terrain and scores start from this."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from climatenerf.core.cameras import Camera
from climatenerf.core.classes import SKY, SOLID
from climatenerf.core.device import to_device, to_numpy
from climatenerf.core.samples import offsets_of
from climatenerf.field.compositing import chunks
from climatenerf.field.protocol import RadianceField, device_of
from climatenerf.ops import compositing
from climatenerf.render.volume import camera_rays
from climatenerf.scene.scene import Scene, View

MAX_RAYS = 150_000  # of all photos together
END_STEP = 2.0  # marching step of those rays; see `RENDER_STEP`
END_WEIGHT = 0.01  # of samples whose normal and class are evaluated


@dataclass(frozen=True)
class PhotoRays:
    """Where the rays of a photo end on the field, at a reduced size."""

    view: View
    camera: Camera
    """Its camera at the reduced size."""
    c2w: Float[np.ndarray, "4 4"]
    x: Float[np.ndarray, "h w 3"]
    """Ends, world m; infinite in the sky."""
    t: Float[np.ndarray, "h w"]
    """Ray lengths, m; +inf in the sky."""
    d: Float[np.ndarray, "h w 3"]
    """Unit directions."""
    normal: Float[np.ndarray, "h w 3"]
    """Unit normals, world axes; 0 in the sky."""
    label: UInt8[np.ndarray, "h w"]
    """Classes of the field."""
    transmittance: Float[np.ndarray, "h w"]
    """Fraction of the light that passes everything."""


@torch.no_grad()
def trace_photos(
    field: RadianceField, scene: Scene, progress: Callable[[float], None] | None = None
) -> list[PhotoRays]:
    """Return the rays of all training photos, about `MAX_RAYS` in all.

    Args:
        field: fitted to the scene, with normals or classes among its capabilities.
        scene: the capture.
        progress: called with the fraction that is done.
    """
    views, device = scene.of_split("train"), device_of(field)
    photos = []
    for index, view in enumerate(views):
        if progress is not None:
            progress(index / len(views))
        camera, c2w = scene.cameras[view.camera], scene.c2w_world(view)
        factor = np.sqrt(camera.width * camera.height * len(views) / MAX_RAYS)
        width = max(round(camera.width / max(factor, 1)), 8)
        small = camera.resized(width, max(round(width * camera.height / camera.width), 8))
        rays_o, rays_d = camera_rays(small, c2w, device)
        parts = [_ends(field, rays_o[chunk], rays_d[chunk]) for chunk in chunks(rays_o)]
        t, normal, label, through = (to_numpy(torch.cat(each)) for each in zip(*parts, strict=True))
        size = (small.height, small.width)
        t, d = t.astype(np.float64), to_numpy(rays_d).astype(np.float64)
        ends = np.isfinite(t)[:, None]
        x = np.where(ends, to_numpy(rays_o) + np.where(ends, t[:, None], 0.0) * d, np.inf)
        x, d, normal = (each.reshape(*size, 3) for each in (x, d, normal))
        t, label, through = (each.reshape(size) for each in (t, label, through))
        photos.append(PhotoRays(view, small, c2w, x, t, d, normal, label, through))
    return photos


def _ends(
    field: RadianceField, rays_o: Float[Tensor, "n 3"], rays_d: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 3"], UInt8[Tensor, "n"], Float[Tensor, "n"]]:
    """Return ray lengths (m), normals, classes and transmittance; +inf, 0, sky without an end."""
    near = torch.full_like(rays_o[:, 0], field.near)
    samples = field.march(rays_o, rays_d, near, torch.full_like(near, 1e9), END_STEP)
    weights, transmittance = compositing.render_weights(samples.sigma * samples.dt, samples.offsets)
    keep = (weights > END_WEIGHT).nonzero()[:, 0]
    weights, offsets = weights[keep], offsets_of(samples.ray_index()[keep], len(near))
    normal, logits = field.surface_heads(rays_o, rays_d, samples, keep)
    solid = transmittance < 0.5

    def mean(values: Float[Tensor, "s c"]) -> Float[Tensor, "n c"]:
        return compositing.accumulate(weights, values, offsets)

    # 1e-6: a ray that meets nothing, 0/0; its length is infinite.
    total = mean(torch.ones_like(weights)[:, None])[:, 0].clamp_min(1e-6)
    t = torch.where(solid, mean(samples.t[keep, None])[:, 0] / total, torch.inf)
    normal = torch.nn.functional.normalize(mean(normal), dim=-1) * solid[:, None]
    kind = to_device(SOLID, t.device)[mean(logits).argmax(-1)].to(torch.uint8)
    return t, normal, torch.where(solid, kind, torch.full_like(kind, SKY)), transmittance
