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
GPU_RAYS_AT_ONCE = 2**16  # each launch has a cost; a ray that hits water sends five more
# Marching step of a render, relative to the last step of a fit. Longer steps miss thin, dense
# matter: with .5, 1, 1.5 and 2 the capture `fox` has 30.66, 30.56, 29.98 and 29.01 dB
# (`benchmarks/render_step.py`).
RENDER_STEP = 1.0
STAGE_SECONDS = 0.01  # aimed at between two questions whether to stop; 20 ms are promised
FIRST_CHUNK = 512  # rays of the first chunk of a render that can be cancelled
MIN_CHUNK = 256  # rays; smaller chunks cost more than they gain


class RenderCancelled(Exception):
    """The caller of a render has cancelled it."""


class Checkpoints:
    """Asks at many points of a render whether to stop, and keeps the longest time between two."""

    def __init__(self, cancelled: Callable[[], bool] | None):
        """Takes the caller's question; None: the render cannot be cancelled.

        Its attribute `every`, if it has one, replaces `STAGE_SECONDS`: larger chunks cost less.
        """
        self._cancelled = cancelled
        self.every: float = getattr(cancelled, "every", STAGE_SECONDS)
        self._last = time.perf_counter()
        self.longest = 0.0

    @property
    def active(self) -> bool:
        """Whether there is anybody to ask."""
        return self._cancelled is not None

    def __call__(self) -> None:
        """Ask.

        Raises:
            RenderCancelled: the answer is True.
        """
        if self._cancelled is None:
            return
        now = time.perf_counter()
        self.longest, self._last = max(self.longest, now - self._last), now
        if self._cancelled():
            raise RenderCancelled


NEVER = Checkpoints(None)
"""For renders that cannot be cancelled."""


def rays_at_once(rays: Tensor) -> int:
    """How many rays are traced together on the device that these are on."""
    return RAYS_AT_ONCE if rays.device.type == "cpu" else GPU_RAYS_AT_ONCE


def chunks(rays: Tensor, checkpoint: Checkpoints = NEVER) -> Iterator[slice]:
    """Slices of a list of rays, to be traced one after the other.

    They are as long as memory allows, or, if the render can be cancelled, so long that about
    `STAGE_SECONDS` pass between two checkpoints.

    Raises:
        RenderCancelled: see `Checkpoints`; asked before each slice.
    """
    most, start = rays_at_once(rays), 0
    size = FIRST_CHUNK if checkpoint.active else most
    while start < rays.shape[0]:
        checkpoint()
        checkpoint.longest = 0.0
        yield slice(start, start + size)
        start += size
        if checkpoint.active:
            checkpoint()
            # 1e-6 s: a clock too coarse to see the stage would divide by 0.
            pace = checkpoint.every / max(checkpoint.longest, 1e-6)
            size = int(min(most, max(MIN_CHUNK, size * min(2.0, pace))))


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
    weights, transmittance = compositing.render_weights(samples.sigma * samples.dt, samples.offsets)
    length = compositing.accumulate(weights, samples.t[:, None], samples.offsets)[:, 0]
    keep = (weights > MIN_WEIGHT).nonzero()[:, 0]
    ray = samples.ray_index()[keep]
    x = rays_o[ray] + samples.t[keep, None] * rays_d[ray]
    ids = None if samples.ids is None else samples.ids[keep]
    colour = field.colour(x, rays_d, ray, ids=ids, appearance=appearance)
    offsets = offsets_of(ray, t_min.shape[0])
    return compositing.accumulate(weights[keep], colour, offsets), transmittance, length
