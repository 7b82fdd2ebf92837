"""Opaque surfaces among the samples of a field."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.core.samples import Samples
from climatenerf.ops import compositing

OPTICAL_DEPTH = 14.0
"""Of one inserted sample: 1e-6 of the light passes."""
NO_ID = -1
"""Id of the samples of a field that gives none."""


def with_surface(
    samples: Samples,
    t: Float[Tensor, "rays"],
    hit: Int[Tensor, "k"],
    extent: float,
    number: int,
) -> Samples:
    """Return the samples with one more on each ray that hits an opaque surface.

    Args:
        samples: of the field, front to back.
        t: ray length to the surface, m.
        hit: rays that hit it, ascending.
        extent: of the sample along the ray, m.
        number: id of the samples.
    """
    counts = torch.zeros(t.shape[0] + 1, dtype=torch.long, device=t.device)
    counts[hit + 1] = 1
    order, offsets = compositing.merge_order(samples.t, samples.offsets, t[hit], counts.cumsum(0))
    lengths = torch.full_like(t[hit], extent)
    values = {
        "t": (samples.t, t[hit]),
        "dt": (samples.dt, lengths),
        "sigma": (samples.sigma, OPTICAL_DEPTH / lengths),
    }
    ids = order.new_full(samples.t.shape, NO_ID) if samples.ids is None else samples.ids
    ids = torch.cat([ids, ids.new_full(hit.shape, number)])[order]
    return Samples(offsets, **{k: torch.cat(v)[order] for k, v in values.items()}, ids=ids)
