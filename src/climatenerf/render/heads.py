"""Normals and classes of pixels, composited from a field's surface heads."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from climatenerf.core.classes import SKY, SOLID
from climatenerf.core.device import to_device
from climatenerf.core.samples import MIN_WEIGHT, offsets_of
from climatenerf.field.compositing import RENDER_STEP, Checkpoints, chunks
from climatenerf.field.protocol import RadianceField
from climatenerf.ops import compositing


@dataclass(frozen=True)
class RayEnds:
    """Where n rays end on a field."""

    t: Float[Tensor, "n"]
    """Mean ray length, m; +inf where more than half of the light is the sky's."""
    normal: Float[Tensor, "n 3"]
    """Unit normals towards the eye, world axes; 0 in the sky."""
    label: UInt8[Tensor, "n"]
    """Classes of `core.classes`."""
    transmittance: Float[Tensor, "n"]
    """Fraction of the light that passes everything."""


@torch.no_grad()
def ray_ends(
    field: RadianceField,
    rays_o: Float[Tensor, "n 3"],
    rays_d: Float[Tensor, "n 3"],
    step_scale: float = RENDER_STEP,
    min_weight: float = MIN_WEIGHT,
) -> RayEnds:
    """Composite lengths, normals and classes of the dry scene along rays.

    Args:
        field: a field with normals or classes among its capabilities.
        rays_o: origins, m.
        rays_d: unit directions.
        step_scale: factor on the marching step.
        min_weight: rendering weight below which a sample does not count.
    """
    near = torch.full_like(rays_o[:, 0], field.near)
    samples = field.march(rays_o, rays_d, near, torch.full_like(near, 1e9), step_scale)
    weights, transmittance = compositing.render_weights(samples.sigma * samples.dt, samples.offsets)
    keep = (weights > min_weight).nonzero()[:, 0]
    weights, offsets = weights[keep], offsets_of(samples.ray_index()[keep], len(near))
    normal, logits = field.surface_heads(rays_o, rays_d, samples, keep)
    solid = transmittance < 0.5

    def total(values: Float[Tensor, "s c"]) -> Float[Tensor, "n c"]:
        return compositing.accumulate(weights, values, offsets)

    # 1e-6: a ray that meets nothing, 0/0; its length is infinite.
    opacity = total(torch.ones_like(weights)[:, None])[:, 0].clamp_min(1e-6)
    t = torch.where(solid, total(samples.t[keep, None])[:, 0] / opacity, torch.inf)
    mean = torch.nn.functional.normalize(total(normal), dim=-1) * solid[:, None]
    away = (mean * rays_d).sum(-1, keepdim=True) > 0
    kind = to_device(SOLID, t.device)[total(logits).argmax(-1)].to(torch.uint8)
    label = torch.where(solid, kind, torch.full_like(kind, SKY))
    return RayEnds(t, torch.where(away, -mean, mean), label, transmittance)


def see_surface(
    field: RadianceField,
    rays_o: Float[Tensor, "n 3"],
    rays_d: Float[Tensor, "n 3"],
    cancelled: Callable[[], bool] | None = None,
) -> tuple[Float[Tensor, "n 3"], UInt8[Tensor, "n"]]:
    """Normals and classes of `ray_ends`, of any number of rays.

    Args:
        field: a field with normals or classes among its capabilities.
        rays_o: origins, m.
        rays_d: unit directions.
        cancelled: asked between chunks of rays.
    """
    parts = [
        ray_ends(field, rays_o[chunk], rays_d[chunk])
        for chunk in chunks(rays_o, Checkpoints(cancelled))
    ]
    return torch.cat([part.normal for part in parts]), torch.cat([part.label for part in parts])
