"""Fitting a field to photographs: the whole method, top to bottom.

A step draws random pixels, marches their rays through occupied space with the present density (no
gradient; opaque matter ends a ray), evaluates the samples again with gradients, gives colour to
those that weigh, composites in linear light, and compares with the photos as displayed.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.field.extent import Extent
from climatenerf.field.field import Field
from climatenerf.field.presets import PRESETS
from climatenerf.ops import dispatch
from climatenerf.render.view import LEAST_WEIGHT
from climatenerf.training import losses
from climatenerf.training.optimiser import GridAdam
from climatenerf.training.pixels import Batch, TrainingPixels


@dataclass(frozen=True)
class FitSettings:
    """How a field is fitted."""

    preset: str = "cpu"
    minutes: float | None = 5.0
    """Stop after this many minutes; None: by steps alone."""
    steps: int | None = None
    """Stop after this many steps; None: by minutes alone."""
    samples_per_step: int = 2**17
    grid_rate: float = 1e-2
    """Learning rate of the hash grids at the start."""
    net_rate: float = 3e-3
    """Learning rate of networks, sky and appearance at the start."""
    final_rate: float = 0.03
    """Both rates end at this share of their start."""
    distortion_weight: float = 3e-4
    opacity_weight: float = 2e-4
    sky_weight: float = 1e-1
    seed: int = 0


@dataclass(frozen=True)
class Report:
    """Where a fit is, after a step."""

    step: int
    seconds: float
    progress: float
    """Share of the time or steps that is over, [0,1]."""
    psnr: float
    """Of the training pixels, running mean, dB."""
    rays_per_second: float
    samples_per_ray: float
    samples: int
    """Samples evaluated so far."""


class Fitting:
    """The state of a fit: field, optimisers, counters; `step` advances it."""

    def __init__(self, pixels: TrainingPixels, images: int, extent: Extent, settings: FitSettings):
        """Begins with an untrained field."""
        torch.manual_seed(settings.seed)
        self.pixels = pixels
        self.extent = extent
        self.settings = settings
        size = PRESETS[settings.preset]
        self.field = Field(size, images, np.array(extent.centre), extent.unit, extent.near)
        self.grid_adam = GridAdam([self.field.geometry_grid, self.field.appearance_grid])
        nets = [p for n, p in self.field.named_parameters() if not n.endswith("_grid")]
        self.net_adam = torch.optim.Adam(nets, lr=settings.net_rate, betas=(0.9, 0.99), eps=1e-15)
        self.generator = torch.Generator().manual_seed(settings.seed)
        self.steps = 0
        self.seconds = 0.0
        self.samples = 0
        self.rays = 1024
        self.step_scale = MAX_STEP_SCALE
        self.error = 0.0  # running mean of the squared error

    @property
    def progress(self) -> float:
        """Share of the time or of the steps that is over, whichever is more."""
        shares = [0.0]
        if self.settings.minutes is not None:
            shares.append(self.seconds / (60 * self.settings.minutes))
        if self.settings.steps is not None:
            shares.append(self.steps / self.settings.steps)
        return min(max(shares), 1.0)

    def run(self, report: Callable[[Report], None]) -> None:
        """Steps until time or steps are over; calls `report` after each."""
        self.compile_kernels()
        while self.progress < 1:
            start = time.perf_counter()
            self.update_occupancy()
            batch = self.pixels.draw(self.rays, self.generator)
            error, samples = self.step(batch)
            seconds = time.perf_counter() - start
            rays = batch.rays_o.shape[0]
            self.adapt(rays, samples)
            self.steps += 1
            self.seconds += seconds
            self.samples += samples
            share = max(0.02, 1.0 / self.steps)
            self.error += share * (error - self.error)
            report(
                Report(
                    step=self.steps,
                    seconds=self.seconds,
                    progress=self.progress,
                    psnr=-10 * np.log10(max(self.error, 1e-10)),
                    rays_per_second=rays / seconds,
                    samples_per_ray=samples / rays,
                    samples=self.samples,
                )
            )

    def compile_kernels(self) -> None:
        """Runs every kernel once on a few rays, so that compiling is not taken for fitting."""
        images = self.field.embeddings.shape[0]
        twin = Fitting(self.pixels, images, self.extent, self.settings)
        twin.step(twin.pixels.draw(16, twin.generator))
        twin.field.grid_density(torch.zeros(16, 3))

    def step(self, batch: Batch) -> tuple[float, int]:
        """One optimiser step; returns the mean squared display error and the samples used."""
        settings, field = self.settings, self.field
        n = batch.rays_o.shape[0]
        samples = field.march(
            batch.rays_o,
            batch.rays_d,
            torch.full((n,), field.near),
            torch.full((n,), 1e9),
            self.step_scale,
            torch.rand(n, generator=self.generator),
            stop=1e-4,
        )
        # Lengths from here on in grid units.
        t, dt = samples.t / field.unit, samples.dt / field.unit
        u = field.sample_positions(batch.rays_o, batch.rays_d, samples)
        tau = field.density_with_gradient(u) * dt
        weights, left = dispatch.render_weights(tau, samples.offsets)
        radiance = self.radiance(batch, u, weights, left, samples)

        error = losses.colour_loss(radiance, batch.rgb)
        loss = error
        if settings.distortion_weight:
            loss = loss + settings.distortion_weight * losses.distortion_loss(
                weights, t, dt, samples.offsets
            )
        if settings.opacity_weight:
            loss = loss + settings.opacity_weight * losses.opacity_loss(left)
        if settings.sky_weight and self.pixels.sky is not None:
            loss = loss + settings.sky_weight * losses.sky_loss(left, batch.is_sky)

        self.net_adam.zero_grad()
        loss.backward()
        decay = settings.final_rate**self.progress * min(1.0, (self.steps + 1) / 50)
        for group in self.net_adam.param_groups:
            group["lr"] = settings.net_rate * decay
        self.net_adam.step()
        self.grid_adam.step(settings.grid_rate * decay)
        return error.item(), samples.t.shape[0]

    def radiance(
        self, batch: Batch, u: Tensor, weights: Tensor, left: Tensor, samples
    ) -> Float[Tensor, "n 3"]:
        """Linear radiance of a batch's rays: matter in front of the directional sky."""
        n = batch.rays_o.shape[0]
        keep = (weights.detach() > LEAST_WEIGHT).nonzero()[:, 0]
        ray = samples.ray_index()[keep]
        offsets = torch.zeros(n + 1, dtype=torch.long)
        offsets[1:] = torch.bincount(ray, minlength=n).cumsum(0)
        appearance = self.field.embeddings[batch.image]
        colour = self.field.colour_at(u[keep], ray, batch.rays_d, appearance)
        sky = self.field.sky_colour(batch.rays_d, appearance)
        return dispatch.accumulate(weights[keep], colour, offsets) + left[:, None] * sky

    def update_occupancy(self) -> None:
        """Looks at every cell in the first steps, at a share of them later."""
        occupancy = self.field.occupancy
        if self.steps in (16, 32, 64, 128):
            occupancy.update(self.field.grid_density, 1.0, 0.9, self.generator)
        elif self.steps % 16 == 0 and self.steps > 128:
            occupancy.update(self.field.grid_density, 0.06, 0.95, self.generator)
        late = self.progress > REFINE_AT and self.steps > 128
        if late and occupancy.side < self.field.size.occupancy_side:
            occupancy.refine()

    def adapt(self, rays: int, samples: int) -> None:
        """Keeps the samples per step at their budget and the samples per ray affordable.

        Steps are coarse while the grid is full, so that early steps are many; they become fine as
        space empties. The budget grows at first: early on, many small steps learn faster.
        """
        budget = self.settings.samples_per_step * min(1.0, 0.25 + 2.5 * self.progress)
        factor = min(2.0, max(0.5, budget / max(samples, 1)))
        self.rays = int(min(16384, max(256, rays * factor)))
        change = 1.05 if samples / rays > SAMPLES_PER_RAY else 0.97
        self.step_scale = min(MAX_STEP_SCALE, max(1.0, self.step_scale * change))


MAX_STEP_SCALE = 6.0
SAMPLES_PER_RAY = 64  # coarser steps while rays have more samples than this
REFINE_AT = 0.25  # progress at which occupancy cells are halved
