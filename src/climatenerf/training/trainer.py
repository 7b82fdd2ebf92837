"""Fitting a field to photographs: the whole method, top to bottom.

A step draws random pixels, marches their rays through occupied space with the present density (no
gradient; opaque matter ends a ray), evaluates the samples again with gradients, gives colour to
those that weigh, composites in linear light, and compares with the photos as displayed.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from climatenerf.core.classes import SKY, SOLID_OF, UNKNOWN, VEGETATION
from climatenerf.core.colour import encode_srgb
from climatenerf.core.device import to_device, to_numpy, uniform
from climatenerf.core.samples import MIN_TAU, MIN_WEIGHT, Samples, offsets_of
from climatenerf.core.vectors import unit
from climatenerf.field.hash_field import Field
from climatenerf.field.normalisation import Extent
from climatenerf.field.presets import PRESETS, FieldSize
from climatenerf.ops import compositing, marching, reference
from climatenerf.training import losses
from climatenerf.training.dataset import HORIZON, Batch, TrainingPixels
from climatenerf.training.evidence.free_space import FreeSpace, is_ground
from climatenerf.training.evidence.monocular_depth import DepthAlignment
from climatenerf.training.evidence.sky_prior import fit_sky_prior
from climatenerf.training.evidence.sparse_depth import SparseDepth, concatenate
from climatenerf.training.gradients import scale_gradient
from climatenerf.training.optimiser import GridAdam
from climatenerf.training.poses import RATE as POSE_RATE
from climatenerf.training.poses import PoseCorrections
from climatenerf.training.sample_selection import choose
from climatenerf.training.settings import FitSettings
from climatenerf.training.static_shapes import Rooms
from climatenerf.training.transients import (
    MASKED,
    TransientMasks,
    prices_of_masks,
    still_cells,
)


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
        points: SparseDepth | None = None,
        matched: SparseDepth | None = None,
        size: FieldSize | None = None,
    ):
        """Begins with an untrained field (its size: the preset's); some of `matched` are wrong."""
        initial = torch.Generator(device="cpu").manual_seed(settings.seed)
        self.points = points
        self.first_near = FIRST_NEAR * extent.unit if settings.warm_up else 0.0
        if points is not None:  # a street that was driven along lies nearer than that
            nearest = float(np.quantile(to_numpy(points.depth), 0.02))
            self.first_near = min(self.first_near, nearest / 2)
        self.pixels = pixels
        self.extent = extent
        self.settings = settings
        size = size or PRESETS[settings.preset]
        self.field = Field(size, images, np.array(extent.centre), extent.unit, extent.near, initial)
        self.masks, self.poses = TransientMasks(images, initial), PoseCorrections(images)
        self.relative = DepthAlignment(images)
        self.rooms = Rooms(torch.get_default_device().type == "cuda")
        self.generator = torch.Generator().manual_seed(settings.seed)
        if not settings.sky_labels:
            self.pixels = pixels = pixels.without_sky()
        self.knows_sky = pixels.knows_sky
        sky_shares = (1.0, 1.0) if self.knows_sky else SKY_SHARES
        view_shares = VIEW_SHARES if settings.warm_up else (1.0, 1.0)
        self.fill = fit_sky_prior(pixels, self.generator)
        self.carving = FreeSpace(self.field, pixels, points, settings)
        if matched is not None and self.carving.ground is not None:
            # A map is better than what is matched on ground: windows mix fences with lawns behind.
            label = pixels.label_towards(matched.image, matched.rays_d)
            matched = matched.select(~is_ground(label))
        self.measured = [each for each in (points, matched) if each is not None]
        kinds = pixels.kinds()
        self.still = still_cells(pixels, self.measured, images)
        self.solid_of = to_device(SOLID_OF.astype(np.int64))
        kinds = kinds[self.solid_of[kinds.long()] != UNKNOWN]
        # A head that has met one class alone, or nothing but ground, would say so of everything.
        classed = kinds.numel() > 1 and not bool(is_ground(kinds).all())
        self.learns_classes = settings.losses.classes > 0 and classed
        # Normals are learned later.
        self.field.learned[:] = torch.tensor([False, self.learns_classes])
        self.field.sky_grid.requires_grad_(self.knows_sky)
        grids = [self.field.geometry_grid, self.field.appearance_grid, self.field.sky_grid]
        grids += [self.field.surface_grid] if size.surface_levels else []
        # With the geometry's the reference street had a twentieth less of its sky empty.
        decays = [settings.decay if grid is self.field.appearance_grid else 0.0 for grid in grids]
        self.grid_adam = GridAdam(grids, decays)
        named = dict(self.field.named_parameters())
        # Appearance learns slowly: a vector per image is enough to paint every photo onto haze.
        groups = [
            {"params": _of(named, "geometry_net", "colour_net"), "shares": (1.0, 1.0)},
            {"params": _of(named, "surface_net"), "shares": (1.0, 1.0)},
            {"params": _of(named, "view_net"), "shares": view_shares},
            {"params": _of(named, "sky_net"), "shares": sky_shares},
            {"params": _of(named, "embeddings"), "shares": EMBEDDING_SHARES},
            {"params": list(self.masks.parameters()), "shares": MASK_SHARES},
            {"params": list(self.poses.parameters()), "shares": (0.0, POSE_SHARE)},
        ]
        # 1e-15: a gradient that was always 0 has moments of 0, 0/0.
        self.net_adam = torch.optim.Adam(
            groups, lr=settings.net_rate, betas=(0.9, 0.99), eps=1e-15, fused=True
        )
        self.steps = 0
        self.seconds = 0.0
        self.reached = 0.0  # stage of the run that is resumed
        self.classed_at = REFINE_AT  # stage from which the field's own classes are believed
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

    @property
    def stage(self) -> float:
        """How far the fit has come, [0,1]: as `progress`, but a later limit takes nothing back."""
        return max(self.reached, self.progress)

    def run(self, report: Callable[[Report], None]) -> None:
        """Steps until time or steps are over; calls `report` after each."""
        self.compile_kernels()
        while self.progress < 1:
            start = time.perf_counter()
            self.update_occupancy()
            wants_triples = self.settings.losses.planarity and self.stage > REFINE_AT
            triples = int(TRIPLE_SHARE * self.rays) if wants_triples else 0
            edges = EDGE_SHARE if self.stage > EDGES_AT else 0.0
            batch = self.pixels.draw(self.rays, self.generator, triples, edges)
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
                    psnr=-10 * np.log10(max(self.error, 1e-10)),  # a perfect fit: log 0
                    rays_per_second=rays / seconds,
                    samples_per_ray=samples / rays,
                    samples=self.samples,
                )
            )

    def compile_kernels(self) -> None:
        """Runs every kernel once on a few rays, so that compiling is not taken for fitting."""
        images = self.field.embeddings.shape[0]
        losses_ = replace(self.settings.losses, ground_height=0.0)
        quick = replace(self.settings, free_space=False, losses=losses_)
        small = replace(self.field.size, geometry_log2_rows=10, appearance_log2_rows=10)
        twin = Fitting(self.pixels, images, self.extent, quick, self.points, size=small)
        twin.step(twin.pixels.draw(16, twin.generator))
        twin.field.grid_density(torch.zeros(16, 3))
        twin.field.density_normal(torch.zeros(16, 3))

    def step(self, batch: Batch) -> tuple[float, int]:
        """One optimiser step; returns the mean squared display error and the samples used.

        On a GPU those of two steps before, samples as they would be of so many rays.
        """
        settings, field = self.settings, self.field
        n = batch.rays_o.shape[0]
        if settings.refine_poses:
            rays = self.poses.rays(batch.rays_o, batch.rays_d, batch.image, field.unit)
            batch = replace(batch, rays_o=rays[0], rays_d=rays[1])
        rays_o, rays_d = batch.rays_o.detach(), batch.rays_d.detach()
        self.rooms.begin(n)
        samples = self.march("samples", rays_o, rays_d, self.near(), torch.full((n,), 1e9))
        # Lengths from here on in grid units.
        t, dt = samples.t / field.unit, samples.dt / field.unit
        tau = samples.sigma * samples.dt
        before, _ = compositing.render_weights(tau, samples.offsets)
        heavy = self.rooms.chosen("heavy", before > SEEN_WEIGHT)
        field.sampler.record_density(rays_o, rays_d, samples, heavy)
        self.thin_out(tau, before)
        kept, chance = choose(before, samples.dt > 0, self.rooms, self.generator)
        u = self.positions(batch, samples, kept)
        # Near a camera many rays crowd into little space that few other cameras see, and haze there
        # is learned first. Gradients scaled with the distance squared, as the rays' spread, undo
        # that (Philip & Deschaintre 2023, Eq. 5).
        spread = torch.ones_like(chance)
        if settings.near_camera_gradient_scaling:
            spread = (
                (samples.t[kept] / (settings.near_camera_gradient_scaling * field.near))
                .square()
                .clamp_max(1.0)
            )
        own = field.density_with_gradient(u) * dt[kept]
        tau = tau.index_copy(0, kept, scale_gradient(own, spread / chance))
        weights, left = compositing.render_weights(tau, samples.offsets)

        share = weights[kept] / chance
        seen = self.rooms.chosen("seen", share.detach() > MIN_WEIGHT)
        ray = samples.ray_index()[kept][seen]
        radiance = self.radiance(batch, u[seen], ray, share[seen], left, spread[seen])
        error = losses.colour_error(radiance, batch.rgb)
        loss, batch = self.colour_loss(radiance.detach(), error, batch)
        loss = loss + self.geometry_loss(batch, samples, weights, left, t, dt)
        loss = loss + self.surface_loss(
            batch, u[seen], ray, share[seen].detach(), samples, kept[seen]
        )
        if settings.losses.sky_prior:
            d, colour, unseen = self.fill.draw(SKY_LOOKS, self.generator)
            shown = field.sky_colour(d, field.mean_embedding.detach().expand(SKY_LOOKS, -1))
            apart = losses.colour_error(shown, encode_srgb(colour)) * unseen
            loss = loss + settings.losses.sky_prior * apart.mean()
        if settings.refine_poses:
            loss = loss + self.poses.loss()

        used = samples.offsets[-1]
        if settings.losses.sparse_depth and self.measured:
            some = max(n // POINT_SHARE, 16)
            drawn = [each.draw(some, self.generator) for each in self.measured]
            loss_of_depth, more = self.depth_loss(concatenate(drawn))
            weight = len(drawn) * settings.losses.sparse_depth  # of each kind as if it were alone
            loss, used = loss + weight * loss_of_depth, used + more

        self.net_adam.zero_grad()
        loss.backward()
        decay = settings.final_rate**self.progress * min(1.0, (self.steps + 1) / 50)
        for group in self.net_adam.param_groups:
            group["lr"] = settings.net_rate * decay * group["shares"][self.stage > REFINE_AT]
        self.net_adam.step()
        self.grid_adam.step(settings.grid_rate * decay)
        told = self.rooms.late("error", error.mean()), self.rooms.late("used", used / n)
        self.rooms.next_step()
        return told[0], round(told[1] * n)

    def positions(
        self, batch: Batch, samples: Samples, kept: Int[Tensor, "k"]
    ) -> Float[Tensor, "k 3"]:
        """Unit-cube coordinates of some samples; with gradients to the cameras if they move."""
        if not self.settings.refine_poses:
            return self.field.sample_positions(batch.rays_o, batch.rays_d, samples)[kept]
        ray = samples.ray_index()[kept]
        x = batch.rays_o[ray] + samples.t[kept, None] * batch.rays_d[ray]
        return reference.contract(self.field.to_grid(x))

    def colour_loss(
        self, radiance: Float[Tensor, "n 3"], error: Float[Tensor, "n"], batch: Batch
    ) -> tuple[Float[Tensor, ""], Batch]:
        """Mean squared error of the colours, without what is taken for transient.

        Also the batch without labels, relative depth and triples there: they are of the passer-by.
        """
        price = self.settings.losses.transient
        if not price or self.stage <= REFINE_AT:
            return error.mean(), batch
        # As long as all is wrong, nothing stands out.
        price = max(price, OUTSTANDING * self.error)
        prices = prices_of_masks(price, batch.label, batch.image, batch.place, self.still)
        mask = self.masks(batch.image, batch.place)
        gone = mask.detach() > MASKED
        label = batch.label.masked_fill(gone, UNKNOWN)
        relative = None if batch.relative is None else batch.relative.masked_fill(gone, torch.nan)
        in_line = batch.in_line & ~gone[triples(gone.shape[0], batch.in_line.shape[0])].any(0)
        stays = replace(batch, label=label, relative=relative, in_line=in_line)
        # Fine texture is never met pixel by pixel, but its neighbours have such colours.
        low, high = self.pixels.colours_nearby(batch.image, batch.place)
        unexplained = losses.colour_error(radiance, encode_srgb(radiance).clamp(low, high))
        return losses.masked_colour_loss(error, unexplained, mask, prices), stays

    def geometry_loss(
        self,
        batch: Batch,
        samples: Samples,
        weights: Float[Tensor, "s"],
        left: Float[Tensor, "n"],
        t: Float[Tensor, "s"],
        dt: Float[Tensor, "s"],
    ) -> Float[Tensor, ""]:
        """All that moves matter beside the colours and the points; t and dt in grid units."""
        weigh, n = self.settings.losses, left.shape[0]
        loss = left.sum() * 0.0
        if weigh.distortion:
            loss = loss + weigh.distortion * losses.distortion_loss(weights, t, dt, samples.offsets)
        if weigh.opacity_entropy:
            loss = loss + weigh.opacity_entropy * losses.opacity_entropy_loss(left)
        if weigh.below_horizon_opacity:
            below = (batch.rays_d[:, 2] < HORIZON) & (batch.label != SKY)
            grown = min(1.0, max(0.0, self.stage / REFINE_AT - 0.5))
            loss = loss + grown * weigh.below_horizon_opacity * losses.below_horizon_loss(
                left, below
            )
        distance = compositing.accumulate(weights, t[:, None], samples.offsets)[:, 0]
        mean_distance = distance / (1 - left).clamp_min(1e-3)  # nothing there: 0/0
        if weigh.sky and self.knows_sky:
            if self.settings.opaque_sky:
                loss = loss + weigh.sky * losses.far_sky_loss(distance, batch.is_sky)
            else:
                which, empty = self.sky_samples(batch, samples, weights.detach())
                # Leaves against the sky come first, clean edges last: too early, crowns are lost.
                grown = min(1.0, max(SKY_AT_FIRST, 2 * self.stage - 0.5))
                loss = loss + grown * weigh.sky * losses.sky_loss(weights[which] * empty, n)
        if weigh.ground_height and self.carving.ground is not None:
            loss = loss + weigh.ground_height * self.ground_loss(batch, samples, weights, t)
        solid = left.detach() < 0.5
        z = (mean_distance * batch.cosine).clamp_min(1e-3)  # of rays without matter: not counted
        m = batch.in_line.shape[0]
        if weigh.planarity and m:
            rows = triples(n, m)
            label = batch.label[rows]
            alike = (label == label[0]).all(0) & (label[0] != VEGETATION) & (label[0] != SKY)
            counts = (batch.in_line & alike & solid[rows].all(0)).float()
            counts = torch.where(label[0] == UNKNOWN, UNSURE_FLAT, 1.0) * counts
            loss = loss + weigh.planarity * losses.planarity_loss(z[rows].T, counts)
        if weigh.monocular_depth and batch.relative is not None and self.stage > REFINE_AT:
            counts = solid & (batch.label != SKY) & torch.isfinite(batch.relative)
            loss = loss + weigh.monocular_depth * self.relative.loss(
                1 / z, batch.relative, batch.image, counts
            )
        return loss

    def ground_loss(
        self,
        batch: Batch,
        samples: Samples,
        weights: Float[Tensor, "s"],
        t: Float[Tensor, "s"],
    ) -> Float[Tensor, ""]:
        """How far matter on rays labelled ground is from the ground that points show.

        `weights` and `t` (grid units) are the samples'; the result: `losses.ground_height_loss`.
        """
        ray = samples.ray_index()
        heavy = weights.detach() > GROUND_WEIGHT
        some = self.rooms.chosen("ground", is_ground(batch.label)[ray] & heavy)
        own = ray[some]
        d = batch.rays_d.detach()[own]
        q = self.field.to_grid(batch.rays_o.detach()[own] + samples.t[some, None] * d)
        # Later the field has learned what is ground, so lumps by what stands are pulled as well,
        # and all harder: less goes with them.
        classed = self.stage > self.classed_at and self.learns_classes
        far, goal, pulled = self.carving.ground_offsets(q, d, t[some], self.rooms, classed)
        some, pull = some[far], SURE_PULL if classed else 1.0
        own = weights[some] * pulled
        return pull * losses.ground_height_loss(own, t[some], goal, batch.rays_o.shape[0])

    def sky_samples(
        self, batch: Batch, samples: Samples, weights: Float[Tensor, "s"]
    ) -> tuple[Int[Tensor, "k"], Bool[Tensor, "k"]]:
        """Samples on sky rays; whether other photos see sky there too, and no point is known."""
        ray = samples.ray_index()
        asked = self.rooms.chosen("sky", (batch.label == SKY)[ray] & (weights > MIN_WEIGHT))
        own = ray[asked]
        x = batch.rays_o.detach()[own] + samples.t[asked, None] * batch.rays_d.detach()[own]
        return asked, self.carving.in_sky_hull(x)

    def surface_loss(
        self,
        batch: Batch,
        u: Float[Tensor, "k 3"],
        ray: Int[Tensor, "k"],
        share: Float[Tensor, "k"],
        samples: Samples,
        index: Int[Tensor, "k"],
    ) -> Float[Tensor, ""]:
        """Classes and normals of some of the rays' samples (those that weigh, `index`).

        `u`, `ray` and `share` are their places in the unit cube, rays and detached weights.
        """
        weigh = self.settings.losses
        if not (weigh.classes or weigh.normals or weigh.normal_consistency):
            return u.sum() * 0.0
        n = max(batch.rays_o.shape[0] // SURFACE_SHARE, 1)
        some = self.rooms.below("surface", ray, n)
        raw = self.field.surface_raw(u[some].detach())
        of = ray[some]
        own = share[some] * (of < n)
        q = goal = None
        if (weigh.normals or weigh.normal_consistency) and self.stage > REFINE_AT:
            at = samples.t[index[some], None]
            q = self.field.to_grid(batch.rays_o.detach()[of] + at * batch.rays_d.detach()[of])
            if weigh.normals:
                self.field.learned[0].fill_(self.stage > NORMALS_AT)
                goal = self.field.density_normal(q)
        logits, apart = compositing.surface(own, raw, goal, offsets_of(of, n))
        loss = weigh.normals * apart.sum() / n
        if weigh.classes and self.pixels.label is not None and self.learns_classes:
            target = self.solid_of[batch.label[:n].long()]
            loss = loss + weigh.classes * losses.class_loss(logits, target, target != UNKNOWN)
        if weigh.normal_consistency and q is not None:
            step = BEND_STEP * samples.dt[index[some]] / self.field.unit
            bent, shown = (
                self.field.finite_difference_normal(q, step),
                unit(raw[:, :3].detach(), 1e-6),
            )
            loss = loss + weigh.normal_consistency * losses.normal_loss(own, bent, shown, n)
        return loss

    def march(
        self,
        name: str,
        rays_o: Float[Tensor, "n 3"],
        rays_d: Float[Tensor, "n 3"],
        near: float,
        far: Float[Tensor, "n"],
    ) -> Samples:
        """`Field.march` as a fit does it; in fixed rooms with zeros behind the last sample."""
        n, room = rays_o.shape[0], None
        if self.rooms.fixed:
            most = max(4 * self.settings.samples_per_step, 2**16)  # where nothing is known yet
            room = self.rooms.room(name, min(n * marching.CAPACITY, most))
        samples = self.field.march(
            rays_o,
            rays_d,
            torch.full((n,), near),
            far,
            self.step_scale,
            uniform(self.generator, n),
            stop=1e-4,
            capacity=room,
        )
        self.rooms.took(name, samples.offsets[-1])
        return samples

    def depth_loss(self, measured: SparseDepth) -> tuple[Float[Tensor, ""], Int[Tensor, ""]]:
        """`losses.sparse_depth_loss` of rays to sparse points; and the samples used."""
        field = self.field
        if self.settings.refine_poses:
            rays = (measured.rays_o, measured.rays_d, measured.image)
            rays_o, rays_d = (each.detach() for each in self.poses.rays(*rays, field.unit))
            measured = replace(measured, rays_o=rays_o, rays_d=rays_d)
        far = 2 * measured.depth  # what is behind that shows nowhere
        samples = self.march("points", measured.rays_o, measured.rays_d, field.near, far)
        u = field.sample_positions(measured.rays_o, measured.rays_d, samples)
        tau = field.density_with_gradient(u) * (samples.dt / field.unit)
        weights, left = compositing.render_weights(tau, samples.offsets)
        loss = losses.sparse_depth_loss(
            weights, left, samples.t / field.unit, measured.depth / field.unit, samples.ray_index()
        )
        return loss, samples.offsets[-1]

    def near(self) -> float:
        """Ray length (m) from which matter is believed at present."""
        return max(self.field.near, self.first_near * (1 - self.stage / REFINE_AT))

    def thin_out(self, tau: Float[Tensor, "s"], weights: Float[Tensor, "s"]) -> None:
        """From `THIN_FROM` on ever denser samples count as empty, unless much light ends on them.

        Once surfaces are found, what is thin are veils, above all between leaves and the sky.
        """
        grown = min(1.0, max(0.0, (self.stage - THIN_FROM) / (FINE_AT - THIN_FROM)))
        goal = MIN_TAU * (self.settings.pruning_threshold / MIN_TAU) ** grown
        denser = 2 * self.field.pruning_threshold
        if goal <= self.field.pruning_threshold:
            return
        share = (weights * (tau < denser)).sum() / weights.sum()  # no light at all: NaN, not less
        name = f"thinner by {round(math.log2(denser / MIN_TAU))}"  # not those of a lower bound
        if self.rooms.late(name, share, math.inf) < THIN_SHARE:
            self.field.pruning_threshold = min(goal, denser)

    def radiance(
        self,
        batch: Batch,
        u: Float[Tensor, "k 3"],
        ray: Int[Tensor, "k"],
        share: Float[Tensor, "k"],
        left: Float[Tensor, "n"],
        spread: Float[Tensor, "k"],
    ) -> Float[Tensor, "n 3"]:
        """Linear radiance of a batch's rays: matter (the samples given) in front of the sky."""
        n = batch.rays_o.shape[0]
        appearance = self.field.embeddings.index_select(0, batch.image)
        if not self.settings.appearance:
            appearance = appearance.detach()
        colour = self.field.colour_at(u, ray, batch.rays_d, appearance)
        if self.knows_sky and not self.settings.opaque_sky:
            # Haze before the sky would take its colour and stay.
            spread = spread * (batch.label != SKY)[ray]
        colour = scale_gradient(colour, spread[:, None])
        own = compositing.accumulate(share, colour, offsets_of(ray, n))
        # The drawn shares sum to the ray's opacity on average only; made to sum to it, they are far
        # less noisy.
        drawn = torch.zeros(n).index_add(0, ray, share.detach())
        # 1e-3: rays of which nothing was drawn, 0/0.
        own = own * ((1 - left.detach()) / drawn.clamp_min(1e-3)).clamp_max(4.0)[:, None]
        through = left.detach() > MIN_WEIGHT
        skyward = torch.arange(n) if self.rooms.fixed else through.nonzero()[:, 0]
        left = left * through
        sky = self.field.sky_colour(batch.rays_d[skyward], appearance[skyward])
        if self.knows_sky:
            # It learns from its own pixels; then it may learn fast, and in detail. What nobody has
            # labelled may be sky, and would have to be painted with matter else.
            unknown = SKY_SHARES[self.stage > REFINE_AT] * (batch.label == UNKNOWN)
            sky = scale_gradient(sky, (batch.is_sky + unknown)[skyward, None])
        return own.index_add(0, skyward, left[skyward, None] * sky)

    def update_occupancy(self) -> None:
        """Looks at every cell in the first steps, at a share of them later."""
        occupancy = self.field.occupancy
        if self.steps in (16, 32, 64, 128):
            occupancy.update(self.field.grid_density, 1.0, 0.9, self.generator)
        elif self.steps % 16 == 0 and self.steps > 128:
            occupancy.update(self.field.grid_density, 0.04, 0.8, self.generator)
        late = self.stage > REFINE_AT and self.steps > 128
        if late and occupancy.side < self.field.size.occupancy_side:
            occupancy.refine()
            self.carving.force_empty(everywhere=False)

    def adapt(self, rays: int, samples: int) -> None:
        """Keeps the samples per step at their budget, and makes marching finer with time.

        Coarse steps while the grid is full, so that early steps are many; but not for long, since
        surfaces cannot become thinner than a step. The budget grows at first: early on, many small
        steps learn faster.
        """
        budget = self.settings.samples_per_step * min(1.0, 0.25 + 2.5 * self.stage)
        factor = min(2.0, max(0.5, budget / max(samples, 1)))
        most = max(16384, self.settings.samples_per_step // MIN_SAMPLES)
        self.rays = int(min(most, max(256, rays * factor)))
        self.step_scale *= 1.03 if samples > SAMPLES_PER_RAY * rays else 0.98
        coarsest = 1 + (MAX_STEP_SCALE - 1) * max(0.0, 1 - self.stage / FINE_AT)
        self.step_scale = min(coarsest, max(1.0, self.step_scale))


def _of(named: dict[str, torch.nn.Parameter], *starts: str) -> list[torch.nn.Parameter]:
    return [p for n, p in named.items() if n.startswith(starts)]


def triples(n: int, m: int) -> Int[Tensor, "3 m"]:
    """Rows of a batch of n rays that are the middles, first and other sides of its m triples."""
    return torch.stack([torch.arange(m), torch.arange(n - 2 * m, n - m), torch.arange(n - m, n)])


# The sky's share before and after surfaces are found, where no labels tell it from matter: it may
# not paint the view before there is matter.
SKY_SHARES = (0.03, 0.3)
# The same of the view's, of a fit that is `cautious`: as long as colours depend on place alone,
# matter before one camera cannot show that camera its photo.
VIEW_SHARES = (0.0, 1.0)
# Of appearance vectors. They begin with the view's: alone they would take up what the direction
# explains better, and frames in their mean would be off in colour.
EMBEDDING_SHARES = (0.0, 0.02)
# Of masks. They race the field, which otherwise explains what one photo shows by haze before that
# camera.
MASK_SHARES = (0.0, 10.0)
# Matter nearer than this to a camera (grid units) is not believed at first: what stands near is
# seen from elsewhere too, and a wall before each camera would satisfy every photo.
FIRST_NEAR = 0.6
# Samples that weigh more show that their cell is occupied. A lamp post fills a tenth of the first,
# large cells, and what is pruned hardly ever comes back.
SEEN_WEIGHT = 0.05
SURFACE_SHARE = 4  # rays for one whose classes and normals are learned from
UNSURE_FLAT = 0.3  # of the flatness's weight where no label says what it is: a statue is not flat
TRIPLE_SHARE = 1 / 6  # of the rays that are the middle of three in a line
SKY_AT_FIRST = 0.2  # of the sky loss's weight, whole from three quarters of the fit
EDGE_SHARE = 0.1  # of the other rays that are drawn from the sky's edges,
EDGES_AT = 0.5  # from this stage on
SKY_LOOKS = 64  # directions in which the sky is filled, a step
OUTSTANDING = 6.0  # times the mean error: the least price of a mask
BEND_STEP = 1.0  # of a marching step: over it the density's slope is taken
POSE_SHARE = POSE_RATE / 1e-2  # of the networks' rate
SURE_PULL = 4.0  # of the ground loss's weight, once the field's own classes tell ground
GROUND_WEIGHT = 1e-3  # of samples that are asked for their height
POINT_SHARE = 16  # rays of photos for one to a sparse point, and one to a matched one
MAX_STEP_SCALE = 8.0
MIN_SAMPLES = 4  # of a ray in the mean: empty ones cost too
SAMPLES_PER_RAY = 40  # steps are coarser while rays have more samples than this
THIN_FROM = 0.5  # stage from which ever denser samples count as empty, until `FINE_AT`,
THIN_SHARE = 0.2  # while samples up to twice as dense take no more of the light that matter does
FINE_AT = 0.8  # stage from which steps are as fine as when rendering
REFINE_AT = 0.25  # stage at which occupancy cells are halved
NORMALS_AT = 0.35  # stage from which predicted normals, learned since then, are shown
