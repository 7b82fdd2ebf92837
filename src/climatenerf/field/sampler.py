"""Samples of rays in the occupied space of a field; updates of the occupancy by training rays."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.core.samples import Samples
from climatenerf.field.occupancy import Occupancy
from climatenerf.ops import compositing, marching

MIN_STEP = 1.0 / 256
"""Smallest marching step, grid units."""
STEP_PER_LENGTH = 1.0 / 160
"""Marching step per ray length travelled."""


@dataclass(frozen=True)
class Sampler:
    """Marching of rays, given in world metres, through the occupied cells of a field."""

    occupancy: Occupancy
    density: marching.Net
    """Encoding and network of the density."""
    centre: Float[Tensor, "3"]
    """Middle of the scene, world m."""
    unit: float
    """Metres per grid unit."""
    near: float
    """Ray length at which camera rays begin, m."""
    pruning_threshold: float
    """Optical depth below which a sample of a camera ray counts as empty."""

    def to_grid(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Convert world metres to grid units."""
        return (x - self.centre) / self.unit

    def spans(
        self,
        t_min: Float[Tensor, "n"],
        t_max: Float[Tensor, "n"],
        jitter: Float[Tensor, "n"],
    ) -> Float[Tensor, "n 3"]:
        """Return `ops.marching.march`'s spans (grid units) of ray lengths in metres."""
        return torch.stack([t_min / self.unit, t_max / self.unit, jitter], dim=-1)

    def steps(
        self, step_scale: float, pruning_threshold: float | None
    ) -> tuple[float, float, float]:
        """Return `ops.marching.march`'s steps; a threshold of None is the field's own."""
        threshold = self.pruning_threshold if pruning_threshold is None else pruning_threshold
        return MIN_STEP * step_scale, STEP_PER_LENGTH * step_scale, threshold

    def march(
        self,
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        t_min: Float[Tensor, "n"],
        t_max: Float[Tensor, "n"],
        step_scale: float = 1.0,
        jitter: Float[Tensor, "n"] | None = None,
        stop: float = 1e-3,
        pruning_threshold: float | None = None,
        capacity: int | None = None,
    ) -> Samples:
        """Return the samples of rays where there is density, without gradient.

        Args:
            rays_o: origins, world m.
            rays_d: unit directions.
            t_min: ray length at which to begin, m.
            t_max: ray length at which to end (may be infinite), m.
            step_scale: factor on the step length.
            jitter: fraction of the first step by which a ray's samples are shifted; default 0.
            stop: transmittance at which a ray ends.
            pruning_threshold: optical depth below which a sample counts as empty; default: the
                field's, which suits the steps of camera rays. Rays that begin next to a surface
                have finer steps.
            capacity: length of the list of samples, padded with zeros; default: as long as needed.
        """
        if jitter is None:
            jitter = torch.zeros_like(t_min)
        offsets, (t, dt, sigma) = marching.march(
            (self.to_grid(rays_o), rays_d),
            self.spans(t_min, t_max, jitter),
            self.occupancy.cells(),
            self.steps(step_scale, pruning_threshold),
            stop,
            self.density,
            capacity,
        )
        return Samples(offsets, t * self.unit, dt * self.unit, sigma / self.unit)

    @torch.no_grad()
    def record_density(
        self,
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        samples: Samples,
        selected: Int[Tensor, "k"],
    ) -> None:
        """Raise the occupancy's density to that of some samples on rays (world m).

        A thin surface fills little of its cells, so that random positions in a cell miss it.
        """
        ray = samples.ray_index()[selected]
        x = rays_o[ray] + samples.t[selected, None] * rays_d[ray]
        self.occupancy.record(self.to_grid(x), samples.sigma[selected] * self.unit)

    @torch.no_grad()
    def mark_seen(
        self, rays_o: Float[Tensor, "n 3"], rays_d: Float[Tensor, "n 3"], min_weight: float = 0.02
    ) -> None:
        """Mark the cells that training rays (world m) see: samples of at least `min_weight`."""
        near = torch.full_like(rays_o[:, 0], self.near)
        samples = self.march(rays_o, rays_d, near, torch.full_like(near, 1e9))
        weights, _ = compositing.render_weights(samples.sigma * samples.dt, samples.offsets)
        keep = (weights > min_weight).nonzero()[:, 0]
        ray = samples.ray_index()[keep]
        self.occupancy.mark_seen(self.to_grid(rays_o[ray] + samples.t[keep, None] * rays_d[ray]))
