"""What the fitted scene itself says of its surfaces: predicted normals and classes of pixels."""

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from climatenerf.field.field import Field
from climatenerf.ops import dispatch
from climatenerf.render.samples import offsets_of
from climatenerf.render.view import LEAST_WEIGHT, RAYS_AT_ONCE, RENDER_STEP
from climatenerf.scene.classes import SKY, SOLID


@torch.no_grad()
def see_surface(
    field: Field, rays_o: Float[Tensor, "n 3"], rays_d: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "n 3"], UInt8[Tensor, "n"]]:
    """Composited normals and classes of the dry scene along rays.

    Args:
        field: the fitted field.
        rays_o: origins, m.
        rays_d: unit directions.

    Returns:
        Unit normals towards the eye, 0 where more than half of the light is the sky's; classes
        (`scene.classes`), sky there.
    """
    normals, labels = [], []
    for start in range(0, rays_o.shape[0], RAYS_AT_ONCE):
        o, d = rays_o[start : start + RAYS_AT_ONCE], rays_d[start : start + RAYS_AT_ONCE]
        n = o.shape[0]
        near, far = torch.full((n,), field.near), torch.full((n,), 1e9)
        samples = field.march(o, d, near, far, RENDER_STEP)
        weights, left = dispatch.render_weights(samples.sigma * samples.dt, samples.offsets)
        keep = (weights > LEAST_WEIGHT).nonzero()[:, 0]
        ray = samples.ray_index()[keep]
        offsets = offsets_of(ray, n)
        u = field.sample_positions(o, d, samples)[keep]
        normal, logits = field.surface_at(u)
        solid = left < 0.5
        mean = dispatch.accumulate(weights[keep], normal, offsets)
        mean = torch.nn.functional.normalize(mean, dim=-1) * solid[:, None]
        away = (mean * d).sum(-1, keepdim=True) > 0
        normals.append(torch.where(away, -mean, mean))
        best = dispatch.accumulate(weights[keep], logits, offsets).argmax(-1)
        kind = torch.from_numpy(SOLID)[best].to(torch.uint8)
        labels.append(torch.where(solid, kind, torch.full_like(kind, SKY)))
    return torch.cat(normals), torch.cat(labels)
