"""What the fitted scene itself says of its surfaces: predicted normals and classes of pixels."""

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from climatenerf.core.classes import SKY, SOLID
from climatenerf.core.device import to_device
from climatenerf.field.hash_field import Field
from climatenerf.ops import dispatch
from climatenerf.render.volume import rays_at_once, weighed_samples


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
    size = rays_at_once(rays_o)
    for o, d in zip(rays_o.split(size), rays_d.split(size), strict=True):
        seen = weighed_samples(field, o, d)
        normal, logits = field.surface_at(seen.u)
        solid = seen.left < 0.5
        mean = dispatch.accumulate(seen.weights, normal, seen.offsets)
        mean = torch.nn.functional.normalize(mean, dim=-1) * solid[:, None]
        away = (mean * d).sum(-1, keepdim=True) > 0
        normals.append(torch.where(away, -mean, mean))
        best = dispatch.accumulate(seen.weights, logits, seen.offsets).argmax(-1)
        kind = to_device(SOLID)[best].to(torch.uint8)
        labels.append(torch.where(solid, kind, torch.full_like(kind, SKY)))
    return torch.cat(normals), torch.cat(labels)
