"""Normals and classes of pixels, composited from a field's surface heads."""

from collections.abc import Callable

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from climatenerf.core.classes import SKY, SOLID
from climatenerf.core.device import to_device
from climatenerf.core.samples import MIN_WEIGHT, offsets_of
from climatenerf.field.compositing import RENDER_STEP, Checkpoints, chunks
from climatenerf.field.protocol import RadianceField
from climatenerf.ops import compositing


@torch.no_grad()
def see_surface(
    field: RadianceField,
    rays_o: Float[Tensor, "n 3"],
    rays_d: Float[Tensor, "n 3"],
    cancelled: Callable[[], bool] | None = None,
) -> tuple[Float[Tensor, "n 3"], UInt8[Tensor, "n"]]:
    """Composited normals and classes of the dry scene along rays.

    Args:
        field: a field with normals or classes among its capabilities.
        rays_o: origins, m.
        rays_d: unit directions.
        cancelled: asked between chunks of rays.

    Returns:
        Unit normals towards the eye, 0 where more than half of the light is the sky's; classes
        (`scene.classes`), sky there.
    """
    normals, labels = [], []
    for chunk in chunks(rays_o, Checkpoints(cancelled)):
        o, d = rays_o[chunk], rays_d[chunk]
        near = torch.full((len(o),), field.near, device=o.device)
        far = torch.full_like(near, 1e9)
        samples = field.march(o, d, near, far, RENDER_STEP)
        weights, transmittance = compositing.render_weights(
            samples.sigma * samples.dt, samples.offsets
        )
        keep = (weights > MIN_WEIGHT).nonzero()[:, 0]
        weights, offsets = weights[keep], offsets_of(samples.ray_index()[keep], len(o))
        normal, logits = field.surface_heads(o, d, samples, keep)
        solid = transmittance < 0.5
        mean = compositing.accumulate(weights, normal, offsets)
        mean = torch.nn.functional.normalize(mean, dim=-1) * solid[:, None]
        away = (mean * d).sum(-1, keepdim=True) > 0
        normals.append(torch.where(away, -mean, mean))
        best = compositing.accumulate(weights, logits, offsets).argmax(-1)
        kind = to_device(SOLID, best.device)[best].to(torch.uint8)
        labels.append(torch.where(solid, kind, torch.full_like(kind, SKY)))
    return torch.cat(normals), torch.cat(labels)
