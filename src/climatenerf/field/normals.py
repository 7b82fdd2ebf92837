"""Normals and classes of a field at positions, from its learned heads or from its density."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.core.samples import Samples
from climatenerf.field.capabilities import CLASSES, DENSITY, NORMALS
from climatenerf.field.protocol import RadianceField

STEP = 0.05  # m, of differences of density


@torch.no_grad()
def normals_at(
    field: RadianceField, x: Float[Tensor, "n 3"], d: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "n 3"], Int[Tensor, "n"]]:
    """Unit normals at positions (world m) that rays of direction d meet, and classes there.

    A field without normals and density gives surfaces that face the eye; one without classes has
    the first class everywhere.

    Returns:
        Normals towards the eye, and indices in `core.classes.SOLID`.
    """
    kind = torch.zeros(x.shape[0], dtype=torch.long, device=x.device)
    if not x.shape[0]:
        return torch.zeros_like(x), kind
    learned = torch.zeros_like(x)
    if field.capabilities & {NORMALS, CLASSES}:
        count = x.shape[0]
        index = torch.arange(count + 1, device=x.device)
        zero = torch.zeros(count, device=x.device)
        samples = Samples(index, zero, zero, zero)
        learned, logits = field.surface_heads(x, d, samples, index[:-1])
        if CLASSES in field.capabilities:
            kind = logits.argmax(-1)
    if NORMALS in field.capabilities:
        normal = learned
    elif DENSITY in field.capabilities:
        normal = torch.zeros_like(x)
        for axis in range(3):
            offset = torch.zeros_like(x)
            offset[:, axis] = STEP
            ahead, behind = field.density(x + offset), field.density(x - offset)
            # Opacities: density differs by orders of magnitude.
            normal[:, axis] = torch.exp(-ahead * STEP) - torch.exp(-behind * STEP)
    else:
        normal = -d
    length = normal.norm(dim=-1, keepdim=True)
    # 1e-6: density without a gradient has no normal.
    normal = torch.where(length > 1e-6, normal / length.clamp_min(1e-6), -d)
    return torch.where((normal * d).sum(-1, keepdim=True) > 0, -normal, normal), kind
