"""The fit of a field to photographs: `Trainer.step` is the whole method, top to bottom.

A step draws random pixels, marches their rays through occupied space with the present density
(without gradients; opaque matter ends a ray), evaluates selected samples again with gradients,
computes colour for those of some weight, composites in linear light, and compares the result with
the photos in display values.
"""

import math
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.core.classes import SKY, UNKNOWN
from climatenerf.core.device import uniform
from climatenerf.core.samples import MIN_WEIGHT, Samples, offsets_of
from climatenerf.field.hash_field import Field
from climatenerf.field.normalisation import Extent
from climatenerf.ops import compositing, marching, reference
from climatenerf.training import losses
from climatenerf.training.dataset import Batch
from climatenerf.training.evidence.gather import Evidence
from climatenerf.training.evidence.sparse_depth import concatenate
from climatenerf.training.losses import scale_gradient
from climatenerf.training.objective import Objective
from climatenerf.training.optimiser import DiscardedSteps, GridAdam, all_finite, clear_unless
from climatenerf.training.parameter_groups import parameter_groups
from climatenerf.training.poses import PoseCorrections
from climatenerf.training.progress import Report
from climatenerf.training.pruning import raise_pruning_threshold, update_occupancy
from climatenerf.training.rendered_rays import RenderedRays, VisibleSamples
from climatenerf.training.sample_selection import select_samples
from climatenerf.training.static_shapes import Buffers

FAR = 1e9  # m, the end of rays to infinity
STOP = 1e-4  # transmittance at which a marched ray ends


class Trainer:
    """A field, a schedule, an objective and evidence, with optimisers and counters."""

    def __init__(
        self,
        field: Field,
        objective: Objective,
        extent: Extent,
        first_near: float,
        generator: torch.Generator,
    ):
        """Begin at step 0.

        Args:
            field: untrained.
            objective: the terms of the loss, with settings, pixels and evidence.
            extent: of the scene.
            first_near: ray length at which marching begins at first, m.
            generator: source of all random numbers of the steps, on the CPU.
        """
        self.field, self.objective, self.extent = field, objective, extent
        self.first_near, self.generator = first_near, generator
        self.settings, self.schedule = objective.settings, objective.schedule
        self.pixels, self.masks = objective.pixels, objective.masks
        self.poses = PoseCorrections(len(self.pixels.cameras)).to(self.pixels.device)
        grids = [field.geometry_grid, field.appearance_grid, field.sky_grid]
        grids += [field.surface_grid] if field.size.surface_levels else []
        # With decay of the geometry grid, a twentieth less of the reference street's sky was empty.
        decays = [self.settings.decay if grid is field.appearance_grid else 0.0 for grid in grids]
        self.grid_adam = GridAdam(grids, decays)
        # 1e-15: a parameter whose gradient was always 0 has moments of 0, 0/0.
        nets = field, self.masks, self.poses
        groups = parameter_groups(*nets, self.settings, self.evidence.knows_sky)
        rate = self.settings.net_rate
        self.net_adam = torch.optim.Adam(groups, rate, (0.9, 0.99), eps=1e-15, fused=True)
        self.discarded = DiscardedSteps()
        self.steps = 0
        self.seconds = 0.0
        self.resumed_progress = 0.0  # of the run that is resumed
        self.samples = 0
        self.rays = self.schedule.first_rays
        self.step_scale = self.schedule.max_step_scale
        self.error = 0.0  # running mean of the squared error

    @property
    def evidence(self) -> Evidence:
        """What is known of the scene besides the colours of its pixels."""
        return self.objective.evidence

    @property
    def buffers(self) -> Buffers:
        """Index lists and read-backs of the steps."""
        return self.objective.buffers

    @property
    def elapsed(self) -> float:
        """Fraction of the time or of the steps that has passed, whichever is more, [0,1]."""
        fractions = [0.0]
        if self.settings.minutes is not None:
            fractions.append(self.seconds / (60 * self.settings.minutes))
        if self.settings.steps is not None:
            fractions.append(self.steps / self.settings.steps)
        return min(max(fractions), 1.0)

    @property
    def progress(self) -> float:
        """Training progress, [0,1]: as `elapsed`, but it never falls when a run is resumed."""
        return max(self.resumed_progress, self.elapsed)

    @property
    def near(self) -> float:
        """Ray length (m) at which marching begins now."""
        return self.schedule.near(self.first_near, self.field.near, self.progress)

    def run(self, report: Callable[[Report], None]) -> None:
        """Step until time or steps are over, and call `report` after each step."""
        while self.elapsed < 1:
            start = time.perf_counter()
            update_occupancy(
                self.field,
                self.steps,
                self.schedule.surfaces_found(self.progress),
                self.evidence.free_space,
                self.generator,
            )
            batch = self.draw_batch()
            error, samples = self.step(batch)
            seconds = time.perf_counter() - start
            rays, progress = batch.rays_o.shape[0], self.progress
            per_step = self.settings.samples_per_step
            self.rays = self.schedule.rays(rays, samples, per_step, progress)
            self.step_scale = self.schedule.step_scale(self.step_scale, samples / rays, progress)
            self.steps += 1
            self.seconds += seconds
            self.samples += samples
            if math.isfinite(error):
                self.error += max(0.02, 1.0 / self.steps) * (error - self.error)
            report(
                Report(
                    step=self.steps,
                    seconds=self.seconds,
                    progress=self.elapsed,
                    psnr=-10 * np.log10(max(self.error, 1e-10)),  # a perfect fit: log 0
                    rays_per_second=rays / seconds,
                    samples_per_ray=samples / rays,
                    samples=self.samples,
                )
            )

    def draw_batch(self) -> Batch:
        """Draw the pixels of a step."""
        schedule, progress = self.schedule, self.progress
        planarity = self.settings.losses.planarity and schedule.surfaces_found(progress)
        triples = int(schedule.triple_fraction * self.rays) if planarity else 0
        edges = schedule.sky_edge_fraction if progress > schedule.sky_edges_at else 0.0
        return self.pixels.draw(self.rays, self.generator, triples, edges)

    def step(self, batch: Batch) -> tuple[float, int]:
        """Take one optimiser step on a batch of rays.

        Returns:
            The mean squared error in display values, and the samples used. On a GPU both are of an
            earlier step, the samples scaled to this step's rays.
        """
        field, objective, progress = self.field, self.objective, self.progress
        n = batch.rays_o.shape[0]
        self.buffers.begin_step(n)
        if self.settings.refine_poses:
            rays = self.poses.rays(batch.rays_o, batch.rays_d, batch.image, field.unit)
            batch = replace(batch, rays_o=rays[0], rays_d=rays[1])
        rays_o, rays_d = batch.rays_o.detach(), batch.rays_d.detach()

        far = torch.full_like(rays_o[:, 0], FAR)
        samples = self.march("samples", rays_o, rays_d, self.near, far)
        tau = samples.sigma * samples.dt
        weights, _ = compositing.render_weights(tau, samples.offsets)
        heavy = self.buffers.indices("heavy", weights > self.schedule.occupied_weight)
        field.sampler.record_density(rays_o, rays_d, samples, heavy)
        raise_pruning_threshold(field, tau, weights, self.settings, progress, self.buffers)

        selected, probability = select_samples(
            weights, samples.dt > 0, self.schedule, self.buffers, self.generator
        )
        rays, visible = self.render(batch, samples, tau, selected, probability)
        radiance = self.radiance(batch, visible, rays.transmittance)
        error = losses.colour_error(radiance, batch.rgb)

        loss, batch = objective.colour(radiance.detach(), error, batch, progress, self.error)
        loss = loss + objective.geometry(field, batch, rays, progress)
        loss = loss + objective.surface_heads(field, batch, samples, visible, progress)
        loss = loss + objective.sky_prior(field, self.generator)
        if self.settings.refine_poses:
            loss = loss + self.poses.loss()
        used = samples.offsets[-1]
        if self.settings.losses.sparse_depth and self.evidence.depths:
            depth, more = self.sparse_depth(n)
            loss, used = loss + depth, used + more

        self.update_parameters(loss)
        mean_error = self.buffers.read("error", error.mean())
        used_per_ray = self.buffers.read("used", used / n)
        self.buffers.end_step()
        return mean_error, round(used_per_ray * n)

    def march(
        self,
        name: str,
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        near: float,
        far: Float[Tensor, "n"],
    ) -> Samples:
        """Return the samples of rays (world m) between two ray lengths (m), without gradients.

        With fixed-capacity buffers zeros follow the last sample.
        """
        n = rays_o.shape[0]
        limit = max(4 * self.settings.samples_per_step, 2**16)  # while nothing is recorded
        samples = self.field.march(
            rays_o,
            rays_d,
            torch.full_like(far, near),
            far,
            self.step_scale,
            uniform(self.generator, n, device=far.device),
            stop=STOP,
            capacity=self.buffers.capacity(name, min(n * marching.MAX_RAY_SAMPLES, limit)),
        )
        self.buffers.record(name, samples.offsets[-1])
        return samples

    def render(
        self,
        batch: Batch,
        samples: Samples,
        tau: Float[Tensor, "s"],
        selected: Int[Tensor, "k"],
        probability: Float[Tensor, "k"],
    ) -> tuple[RenderedRays, VisibleSamples]:
        """Evaluate the density of selected samples with gradients, and composite the rays.

        Args:
            batch: the rays.
            samples: all samples of the rays.
            tau: their optical depths, without gradients.
            selected: rows of the samples that get gradients.
            probability: inclusion probability of each.
        """
        field, scaling = self.field, self.settings.near_camera_gradient_scaling
        t, dt = samples.t / field.unit, samples.dt / field.unit
        ray = samples.ray_index()[selected]
        if self.settings.refine_poses:  # with gradients to the poses
            x = batch.rays_o[ray] + samples.t[selected, None] * batch.rays_d[ray]
            u = reference.contract(field.to_grid(x))
        else:
            u = field.sample_positions(batch.rays_o, batch.rays_d, samples)[selected]
        # Near a camera many rays share little space that few other cameras see, so haze there is
        # learned first. Gradients scaled with the distance squared, as the rays' density falls,
        # undo that (Philip & Deschaintre 2023, Eq. 5).
        gradient_scale = torch.ones_like(probability)
        if scaling:
            relative = samples.t[selected] / (scaling * field.near)
            gradient_scale = relative.square().clamp_max(1.0)
        with_gradient = field.density_with_gradient(u) * dt[selected]
        with_gradient = scale_gradient(with_gradient, gradient_scale / probability)
        tau = tau.index_copy(0, selected, with_gradient)
        weights, transmittance = compositing.render_weights(tau, samples.offsets)
        unbiased = weights[selected] / probability
        row = self.buffers.indices("visible", unbiased.detach() > MIN_WEIGHT)
        every = (selected, ray, u, unbiased, gradient_scale)
        visible = VisibleSamples(*(values[row] for values in every))
        return RenderedRays(samples, t, dt, weights, transmittance), visible

    def radiance(
        self, batch: Batch, visible: VisibleSamples, transmittance: Float[Tensor, "n"]
    ) -> Float[Tensor, "n 3"]:
        """Return the linear radiance of a batch's rays: visible samples in front of the sky."""
        field, ray, n = self.field, visible.ray, batch.rays_o.shape[0]
        knows_sky = self.evidence.knows_sky
        appearance = field.embeddings.index_select(0, batch.image)
        if not self.settings.appearance:
            appearance = appearance.detach()
        colour = field.colour_at(visible.u, ray, batch.rays_d, appearance)
        gradient_scale = visible.gradient_scale
        if knows_sky and not self.settings.opaque_sky:
            # Haze in front of the sky would learn its colour and stay.
            gradient_scale = gradient_scale * (batch.label != SKY)[ray]
        colour = scale_gradient(colour, gradient_scale[:, None])
        matter = compositing.accumulate(visible.weights, colour, offsets_of(ray, n))
        # Unbiased weights sum to the ray's opacity on average only. Scaled to sum to it, they are
        # far less noisy. 1e-3: rays without a visible sample, 0/0.
        total = torch.zeros_like(transmittance).index_add(0, ray, visible.weights.detach())
        opacity = 1 - transmittance.detach()
        matter = matter * (opacity / total.clamp_min(1e-3)).clamp_max(4.0)[:, None]
        through = transmittance.detach() > MIN_WEIGHT
        row = self.buffers.rows(through)
        transmittance = transmittance * through
        sky = field.sky_colour(batch.rays_d[row], appearance[row])
        if knows_sky:
            # The sky learns from its own pixels, fast and in detail. Unlabelled pixels may be sky,
            # which would otherwise be painted with matter.
            factor = self.schedule.unlabelled_sky[self.schedule.surfaces_found(self.progress)]
            unlabelled = factor * (batch.label == UNKNOWN)
            sky = scale_gradient(sky, (batch.is_sky + unlabelled)[row, None])
        return matter.index_add(0, row, transmittance[row, None] * sky)

    def sparse_depth(self, rays: int) -> tuple[Float[Tensor, ""], Int[Tensor, ""]]:
        """Return the term on measured depths for a step of `rays` rays, and the samples used."""
        field, kinds = self.field, self.evidence.depths
        count = max(rays // self.schedule.depth_ray_stride, 16)
        measured = concatenate([each.draw(count, self.generator) for each in kinds])
        rays_o, rays_d = measured.rays_o, measured.rays_d
        if self.settings.refine_poses:
            corrected = self.poses.rays(rays_o, rays_d, measured.image, field.unit)
            rays_o, rays_d = (each.detach() for each in corrected)
        # Twice the depth: what is behind the point is not visible there.
        samples = self.march("depth samples", rays_o, rays_d, field.near, 2 * measured.depth)
        u = field.sample_positions(rays_o, rays_d, samples)
        tau = field.density_with_gradient(u) * (samples.dt / field.unit)
        weights, transmittance = compositing.render_weights(tau, samples.offsets)
        t, depth = samples.t / field.unit, measured.depth / field.unit
        loss = losses.sparse_depth_loss(weights, transmittance, t, depth, samples.ray_index())
        # Each kind of measurement counts as if it were alone.
        return len(kinds) * self.settings.losses.sparse_depth * loss, samples.offsets[-1]

    def update_parameters(self, loss: Float[Tensor, ""]) -> None:
        """Take one step of both optimisers down the gradient of a loss.

        Raises:
            Diverged: the gradients of many steps in a row were not finite.
        """
        settings, found = self.settings, self.schedule.surfaces_found(self.progress)
        self.net_adam.zero_grad()
        loss.backward()
        weights = [w for group in self.net_adam.param_groups for w in group["params"]]
        gradients = [w.grad for w in weights if w.grad is not None]
        finite = all_finite(gradients)
        usable = self.buffers.read("finite", finite.float(), 1.0) > 0
        if self.buffers.deferred or not usable:
            clear_unless(finite, [*gradients, *self.grid_adam.gradients])
        self.discarded.record(usable, self.steps)
        if not (usable or self.buffers.deferred):
            return
        rate = self.schedule.learning_rate(settings.final_rate, self.elapsed, self.steps)
        for group in self.net_adam.param_groups:
            group["lr"] = settings.net_rate * rate * group["rates"][found]
        self.net_adam.step()
        self.grid_adam.step(settings.grid_rate * rate)
