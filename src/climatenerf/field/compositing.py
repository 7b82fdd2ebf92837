"""Rays through any field: in chunks that bound memory and time, marched and composited."""

import time
from collections.abc import Callable, Iterator

import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.core.samples import MIN_WEIGHT, offsets_of
from climatenerf.field.capabilities import FUSED
from climatenerf.field.protocol import RadianceField
from climatenerf.ops import compositing

RAYS_AT_ONCE = 16384  # bounds memory; the march buffers take 12 kB a ray
GPU_RAYS_AT_ONCE = (
    2**16
)  # each launch has a cost; a ray that hits water sends five, traced together
# Of the step that fits end with. Longer steps hit thin, dense matter by chance: with .5, 1, 1.5 and
# 2 the capture `fox` has 30.66, 30.56, 29.98 and 29.01 dB (`benchmarks/render_step.py`).
RENDER_STEP = 1.0
CHUNK_SECONDS = 0.01  # aim for a chunk that can be cancelled; half of the 20 ms that are promised
FIRST_CHUNK = 256  # rays of the first such chunk, whose pace is not known


class RenderCancelled(Exception):
    """The caller of a render has cancelled it."""


def rays_at_once(rays: Tensor) -> int:
    """How many rays are traced together on the device that these are on."""
    return RAYS_AT_ONCE if rays.device.type == "cpu" else GPU_RAYS_AT_ONCE


def chunks(rays: Tensor, cancelled: Callable[[], bool] | None = None) -> Iterator[slice]:
    """Slices of a list of rays, to be traced one after the other.

    Without `cancelled` they are as long as memory allows. With it, each is as long as takes about
    `CHUNK_SECONDS`, judged by the time that the caller spent on the one before.

    Raises:
        RenderCancelled: `cancelled` answers True; asked before each slice.
    """
    most, start = rays_at_once(rays), 0
    size = most if cancelled is None else FIRST_CHUNK
    while start < rays.shape[0]:
        if cancelled is not None and cancelled():
            raise RenderCancelled
        begun = time.perf_counter()
        yield slice(start, start + size)
        start += size
        if cancelled is not None:
            # 1e-6 s: a clock too coarse to see the chunk would divide by 0.
            pace = CHUNK_SECONDS / max(time.perf_counter() - begun, 1e-6)
            size = int(min(most, max(16, size * min(2.0, pace))))


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
