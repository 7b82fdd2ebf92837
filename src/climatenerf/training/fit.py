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
from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.field.extent import Extent
from climatenerf.field.field import Field
from climatenerf.field.presets import PRESETS
from climatenerf.ops import dispatch
from climatenerf.render.samples import Samples, offsets_of
from climatenerf.render.view import LEAST_WEIGHT
from climatenerf.training import losses
from climatenerf.training.optimiser import GridAdam
from climatenerf.training.pixels import Batch, TrainingPixels
from climatenerf.training.points import PointRays


@dataclass(frozen=True)
class FitSettings:
    """How a field is fitted."""

    preset: str = "cpu"
    minutes: float | None = 5.0
    """Stop after this many minutes; None: by steps alone."""
    steps: int | None = None
    """Stop after this many steps; None: by minutes alone."""
    samples_per_step: int = 2**16
    grid_rate: float = 2e-2
    """Learning rate of the hash grids at the start."""
    net_rate: float = 1e-2
    """Learning rate of networks, sky and appearance at the start."""
    final_rate: float = 0.1
    """Both rates end at this share of their start."""
    distortion_weight: float = 1e-2
    opacity_weight: float = 2e-4
    solid_weight: float = 0.1
    """Of light left on rays that point below the horizon, where no sky is."""
    sky_weight: float = 1e-1
    depth_weight: float = 1e-1
    """Of the distance of matter from sparse points, where photos are known to show them."""
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

    def __init__(
        self,
        pixels: TrainingPixels,
        images: int,
        extent: Extent,
        settings: FitSettings,
        points: PointRays | None = None,
    ):
        """Begins with an untrained field."""
        torch.manual_seed(settings.seed)
        self.points = points
        self.first_near = FIRST_NEAR * extent.unit
        if points is not None:  # a street that was driven along lies nearer than that
            nearest = float(np.quantile(points.depth.numpy(), 0.02))
            self.first_near = min(self.first_near, nearest / 2)
        self.pixels = pixels
        self.extent = extent
        self.settings = settings
        size = PRESETS[settings.preset]
        self.field = Field(size, images, np.array(extent.centre), extent.unit, extent.near)
        labelled = pixels.sky is not None
        self.field.sky_grid.requires_grad_(labelled)
        grids = [self.field.geometry_grid, self.field.appearance_grid, self.field.sky_grid]
        self.grid_adam = GridAdam(grids)
        named = dict(self.field.named_parameters())
        # Appearance learns slowly: a vector per image is enough to paint every photo onto haze.
        groups = [
            {"params": _of(named, "geometry_net", "colour_net"), "shares": (1.0, 1.0)},
            {"params": _of(named, "view_net"), "shares": VIEW_SHARES},
            {"params": _of(named, "sky_net"), "shares": (1.0, 1.0) if labelled else SKY_SHARES},
            {"params": _of(named, "embeddings"), "shares": EMBEDDING_SHARES},
        ]
        self.net_adam = torch.optim.Adam(groups, lr=settings.net_rate, betas=(0.9, 0.99), eps=1e-15)
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
        twin = Fitting(self.pixels, images, self.extent, self.settings, self.points)
        twin.step(twin.pixels.draw(16, twin.generator))
        twin.field.grid_density(torch.zeros(16, 3))

    def step(self, batch: Batch) -> tuple[float, int]:
        """One optimiser step; returns the mean squared display error and the samples used."""
        settings, field = self.settings, self.field
        n = batch.rays_o.shape[0]
        samples = field.march(
            batch.rays_o,
            batch.rays_d,
            torch.full((n,), self.near()),
            torch.full((n,), 1e9),
            self.step_scale,
            torch.rand(n, generator=self.generator),
            stop=1e-4,
        )
        # Lengths from here on in grid units.
        t, dt = samples.t / field.unit, samples.dt / field.unit
        tau = samples.sigma * samples.dt
        before, _ = dispatch.render_weights(tau, samples.offsets)
        if self.progress > KEEP_AT:
            field.keep_occupied(batch.rays_o, batch.rays_d, samples, before > SEEN_WEIGHT)
        kept, chance = self.choose(before)
        u = field.sample_positions(batch.rays_o, batch.rays_d, samples)[kept]
        # Near a camera many rays crowd into little space that few other cameras see, and haze there
        # is learned first. Gradients scaled with the distance squared, as the rays' spread, undo
        # that (Philip & Deschaintre 2023, Eq. 5).
        spread = (samples.t[kept] / (CROWDED * field.near)).square().clamp_max(1.0)
        own = field.density_with_gradient(u) * dt[kept]
        tau = tau.index_copy(0, kept, scale_gradient(own, spread / chance))
        weights, left = dispatch.render_weights(tau, samples.offsets)
        radiance = self.radiance(batch, u, samples, kept, weights, left, spread, chance)

        error = losses.colour_loss(radiance, batch.rgb)
        loss = error
        if settings.distortion_weight:
            loss = loss + settings.distortion_weight * losses.distortion_loss(
                weights, t, dt, samples.offsets
            )
        if settings.opacity_weight:
            loss = loss + settings.opacity_weight * losses.opacity_loss(left)
        if settings.solid_weight:
            below = (batch.rays_d[:, 2] < HORIZON) & (batch.is_sky == 0)
            grown = min(1.0, max(0.0, self.progress / REFINE_AT - 0.5))
            loss = loss + grown * settings.solid_weight * losses.solid_loss(left, below)
        if settings.sky_weight and self.pixels.sky is not None:
            loss = loss + settings.sky_weight * losses.sky_loss(left, batch.is_sky)

        used = samples.t.shape[0]
        if settings.depth_weight and self.points is not None:
            measured = self.points.draw(max(n // POINT_SHARE, 16), self.generator)
            loss_of_depth, more = self.depth_loss(measured)
            loss, used = loss + settings.depth_weight * loss_of_depth, used + more

        self.net_adam.zero_grad()
        loss.backward()
        decay = settings.final_rate**self.progress * min(1.0, (self.steps + 1) / 50)
        for group in self.net_adam.param_groups:
            group["lr"] = settings.net_rate * decay * group["shares"][self.progress > REFINE_AT]
        self.net_adam.step()
        self.grid_adam.step(settings.grid_rate * decay)
        return error.item(), used

    def depth_loss(self, measured: PointRays) -> tuple[Tensor, int]:
        """How far matter is from the sparse points on their rays; and the samples used."""
        field, n = self.field, measured.depth.shape[0]
        samples = field.march(
            measured.rays_o,
            measured.rays_d,
            torch.full((n,), field.near),
            2 * measured.depth,  # what is far behind the point shows nowhere
            self.step_scale,
            torch.rand(n, generator=self.generator),
            stop=1e-4,
        )
        u = field.sample_positions(measured.rays_o, measured.rays_d, samples)
        tau = field.density_with_gradient(u) * (samples.dt / field.unit)
        weights, left = dispatch.render_weights(tau, samples.offsets)
        loss = losses.depth_loss(
            weights, left, samples.t / field.unit, measured.depth / field.unit, samples.ray_index()
        )
        return loss, samples.t.shape[0]

    def near(self) -> float:
        """Ray length (m) from which matter is believed at present."""
        return max(self.field.near, self.first_near * (1 - self.progress / REFINE_AT))

    def choose(self, weights: Float[Tensor, "s"]) -> tuple[Tensor, Tensor]:
        """The samples that get colour and gradients, and the chance that each had.

        Early on rays cross haze, with hundreds of samples that hardly weigh: about `CHOSEN` a ray
        are drawn in proportion to their weights, each standing for those like it. Where surfaces
        are found all that weigh are taken.
        """
        chance = (CHOSEN * weights).clamp(LEAST_CHANCE, 1.0)
        # Systematic sampling: drawn ones are spread evenly among those like them.
        passed = chance.double().cumsum(0) + torch.rand(1, generator=self.generator).double()
        kept = (passed.floor() > (passed - chance).floor()).nonzero()[:, 0]
        return kept, chance[kept]

    def radiance(
        self,
        batch: Batch,
        u: Float[Tensor, "k 3"],
        samples: Samples,
        kept: Int[Tensor, "k"],
        weights: Float[Tensor, "s"],
        left: Float[Tensor, "n"],
        spread: Float[Tensor, "k"],
        chance: Float[Tensor, "k"],
    ) -> Float[Tensor, "n 3"]:
        """Linear radiance of a batch's rays: matter in front of the directional sky."""
        n = batch.rays_o.shape[0]
        share = weights[kept] / chance
        seen = (share.detach() > LEAST_WEIGHT).nonzero()[:, 0]
        ray = samples.ray_index()[kept][seen]
        offsets = offsets_of(ray, n)
        appearance = self.field.embeddings[batch.image]
        colour = self.field.colour_at(u[seen], ray, batch.rays_d, appearance)
        colour = scale_gradient(colour, spread[seen, None])
        own = dispatch.accumulate(share[seen], colour, offsets)
        # The drawn shares sum to the ray's opacity on average only; made to sum to it, they are far
        # less noisy.
        drawn = torch.zeros(n).index_add(0, ray, share[seen].detach())
        own = own * ((1 - left.detach()) / drawn.clamp_min(1e-3)).clamp_max(4.0)[:, None]
        sky = self.field.sky_colour(batch.rays_d, appearance)
        if self.pixels.sky is not None:
            # It learns from its own pixels alone; then it may learn fast, and in detail.
            sky = scale_gradient(sky, batch.is_sky[:, None])
        return own + left[:, None] * sky

    def update_occupancy(self) -> None:
        """Looks at every cell in the first steps, at a share of them later."""
        occupancy = self.field.occupancy
        if self.steps in (16, 32, 64, 128):
            occupancy.update(self.field.grid_density, 1.0, 0.9, self.generator)
        elif self.steps % 16 == 0 and self.steps > 128:
            occupancy.update(self.field.grid_density, 0.04, 0.8, self.generator)
        late = self.progress > REFINE_AT and self.steps > 128
        if late and occupancy.side < self.field.size.occupancy_side:
            occupancy.refine()

    def adapt(self, rays: int, samples: int) -> None:
        """Keeps the samples per step at their budget, and makes marching finer with time.

        Coarse steps while the grid is full, so that early steps are many; but not for long, since
        surfaces cannot become thinner than a step. The budget grows at first: early on, many small
        steps learn faster.
        """
        budget = self.settings.samples_per_step * min(1.0, 0.25 + 2.5 * self.progress)
        factor = min(2.0, max(0.5, budget / max(samples, 1)))
        self.rays = int(min(16384, max(256, rays * factor)))
        self.step_scale *= 1.03 if samples > SAMPLES_PER_RAY * rays else 0.98
        coarsest = 1 + (MAX_STEP_SCALE - 1) * max(0.0, 1 - self.progress / FINE_AT)
        self.step_scale = min(coarsest, max(1.0, self.step_scale))


def _of(named: dict[str, torch.nn.Parameter], *starts: str) -> list[torch.nn.Parameter]:
    return [p for n, p in named.items() if n.startswith(starts)]


def scale_gradient(value: Tensor, factor: Tensor) -> Tensor:
    """The same value, its gradient multiplied by a factor."""
    return value * factor + (value * (1 - factor)).detach()


# The sky's share before and after surfaces are found, where no labels tell it from matter: it may
# not paint the view before there is matter.
SKY_SHARES = (0.03, 0.3)
# The same of the view's: as long as colours depend on place alone, matter before one camera cannot
# show that camera its photo.
VIEW_SHARES = (0.0, 1.0)
# Of appearance vectors. They begin with the view's: alone they would take up what the direction
# explains better, and frames in their mean would be off in colour.
EMBEDDING_SHARES = (0.0, 0.02)
# Matter nearer than this to a camera (grid units) is not believed at first: what stands near is
# seen from elsewhere too, and a wall before each camera would satisfy every photo.
FIRST_NEAR = 0.6
HORIZON = -0.05  # rays that sink more than this end on matter
CROWDED = 3.0  # rays of one camera crowd within this many times the nearest distance
CHOSEN = 32  # samples of a ray that get colour and gradients, about
SEEN_WEIGHT = 0.05  # samples that weigh more show that their cell is occupied
KEEP_AT = 0.5  # progress from which this is so: before, haze is to be pruned
LEAST_CHANCE = 0.25  # of any sample; with less, the noise lets walls grow before the cameras
POINT_SHARE = 16  # rays of photos for one to a sparse point
MAX_STEP_SCALE = 8.0
SAMPLES_PER_RAY = 40  # steps are coarser while rays have more samples than this
FINE_AT = 0.8  # progress from which steps are as fine as when rendering
REFINE_AT = 0.25  # progress at which occupancy cells are halved
