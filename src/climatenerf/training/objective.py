"""The loss of a training step: one method a term, each returned with its weight.

Formulas are in `losses.py`; here is which rays and samples a term applies to, and when. Lengths
along rays are in grid units.
"""

from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from climatenerf.core.classes import SKY, SOLID_OF, UNKNOWN, VEGETATION
from climatenerf.core.colour import encode_srgb
from climatenerf.core.device import to_device
from climatenerf.core.samples import MIN_WEIGHT, Samples, offsets_of
from climatenerf.core.vectors import unit
from climatenerf.field.density_slope import finite_difference_normal
from climatenerf.field.hash_field import Field
from climatenerf.ops import compositing
from climatenerf.training import losses
from climatenerf.training.dataset import HORIZON, Batch, TrainingPixels, is_ground, is_standing
from climatenerf.training.evidence.gather import Evidence
from climatenerf.training.evidence.monocular_depth import DepthAlignment
from climatenerf.training.rendered_rays import RenderedRays, VisibleSamples
from climatenerf.training.schedule import Schedule
from climatenerf.training.settings import FitSettings
from climatenerf.training.static_shapes import Buffers
from climatenerf.training.transients import MASK_THRESHOLD, TransientMasks, mask_prices


@dataclass
class Objective:
    """The terms of the loss, with all that they need besides the field and the rays."""

    settings: FitSettings
    evidence: Evidence
    pixels: TrainingPixels
    masks: TransientMasks
    depth_alignment: DepthAlignment
    buffers: Buffers
    learns_classes: bool
    classes_used_from: float
    """Progress from which the field's own classes decide what is ground."""
    logit_of_class: Int[Tensor, "256"] = field(init=False)
    """Class logit of each merged class, `UNKNOWN` for sky and unlabelled pixels."""

    def __post_init__(self) -> None:
        """Put the table of classes next to the pixels."""
        self.logit_of_class = to_device(SOLID_OF.astype(np.int64), self.pixels.device)

    @property
    def schedule(self) -> Schedule:
        """The schedule of the settings."""
        return self.settings.schedule

    def colour(
        self,
        radiance: Float[Tensor, "n 3"],
        error: Float[Tensor, "n"],
        batch: Batch,
        progress: float,
        mean_error: float,
    ) -> tuple[Float[Tensor, ""], Batch]:
        """Return the mean squared colour error outside transient masks, and what masks leave.

        Args:
            radiance: linear radiance of the rays, without gradient.
            error: squared error of their display values.
            batch: the rays.
            progress: training progress.
            mean_error: running mean of the squared error.

        Returns:
            The loss; and the batch without the labels, relative depths and triples that are masked,
            since they belong to a passer-by.
        """
        price = self.settings.losses.transient
        if not price or not self.schedule.surfaces_found(progress):
            return error.mean(), batch
        price = max(price, self.schedule.relative_mask_price * mean_error)
        static = self.evidence.static_cells
        prices = mask_prices(price, batch.label, batch.image, batch.xy, static)
        mask = self.masks(batch.image, batch.xy)
        masked = mask.detach() > MASK_THRESHOLD
        label = batch.label.masked_fill(masked, UNKNOWN)
        relative = None if batch.relative is None else batch.relative.masked_fill(masked, torch.nan)
        rows = triple_rows(masked.shape[0], batch.in_line.shape[0], masked.device)
        in_line = batch.in_line & ~masked[rows].any(0)
        unmasked = replace(batch, label=label, relative=relative, in_line=in_line)
        # Fine texture never matches pixel by pixel, but a neighbouring pixel has its colour.
        low, high = self.pixels.colours_nearby(batch.image, batch.xy)
        unexplained = losses.colour_error(radiance, encode_srgb(radiance).clamp(low, high))
        return losses.masked_colour_loss(error, unexplained, mask, prices), unmasked

    def geometry(
        self, field: Field, batch: Batch, rays: RenderedRays, progress: float
    ) -> Float[Tensor, ""]:
        """Return the sum of all terms on the density of a batch's rays besides the colours."""
        weight, transmittance = self.settings.losses, rays.transmittance
        loss = transmittance.sum() * 0.0
        if weight.distortion:
            loss = loss + weight.distortion * losses.distortion_loss(
                rays.weights, rays.t, rays.dt, rays.samples.offsets
            )
        if weight.opacity_entropy:
            loss = loss + weight.opacity_entropy * losses.opacity_entropy_loss(transmittance)
        if weight.below_horizon_opacity:
            below = (batch.rays_d[:, 2] < HORIZON) & (batch.label != SKY)
            risen = self.schedule.below_horizon_weight(progress) * weight.below_horizon_opacity
            loss = loss + risen * losses.below_horizon_loss(transmittance, below)
        distance = compositing.accumulate(rays.weights, rays.t[:, None], rays.samples.offsets)[:, 0]
        mean_distance = distance / (1 - transmittance).clamp_min(1e-3)  # an empty ray: 0/0
        if weight.sky and self.evidence.knows_sky:
            loss = loss + self.sky(batch, rays, distance, progress)
        occlusion = self.schedule.occlusion_weight(progress) * weight.occlusion
        if occlusion > 0:
            near = losses.nearness(rays.weights, rays.t, rays.samples.offsets)
            loss = loss + occlusion * (near * is_standing(batch.label)).mean()
        if weight.ground_height and self.evidence.free_space.ground is not None:
            loss = loss + self.ground_height(field, batch, rays, progress)
        opaque = transmittance.detach() < 0.5
        # 1e-3: 1/0 of empty rays, which do not count.
        z = (mean_distance * batch.cosine).clamp_min(1e-3)
        if weight.planarity and batch.in_line.shape[0]:
            loss = loss + self.planarity(batch, z, opaque)
        found = self.schedule.surfaces_found(progress)
        if weight.monocular_depth and batch.relative is not None and found:
            loss = loss + self.monocular_depth(batch, z, opaque)
        return loss

    def sky(
        self,
        batch: Batch,
        rays: RenderedRays,
        distance: Float[Tensor, "n"],
        progress: float,
    ) -> Float[Tensor, ""]:
        """Return the term on the density of rays to the sky; `distance`: composited length."""
        weight = self.settings.losses.sky
        if self.settings.opaque_sky:
            return weight * losses.far_sky_loss(distance, batch.is_sky)
        index, empty = self.sky_samples(batch, rays.samples, rays.weights.detach())
        loss = losses.sky_loss(rays.weights[index] * empty, batch.rays_o.shape[0])
        return self.schedule.sky_weight(progress) * weight * loss

    def sky_samples(
        self, batch: Batch, samples: Samples, weights: Float[Tensor, "s"]
    ) -> tuple[Int[Tensor, "k"], Bool[Tensor, "k"]]:
        """Return samples on sky rays, and whether the photos agree to see sky there.

        Cells that hold a sparse point count as matter whatever the labels are.
        """
        ray = samples.ray_index()
        index = self.buffers.indices("sky", (batch.label == SKY)[ray] & (weights > MIN_WEIGHT))
        ray = ray[index]
        x = batch.rays_o.detach()[ray] + samples.t[index, None] * batch.rays_d.detach()[ray]
        return index, self.evidence.free_space.in_sky_hull(x)

    def ground_height(
        self, field: Field, batch: Batch, rays: RenderedRays, progress: float
    ) -> Float[Tensor, ""]:
        """Return the term on the distance of matter from the ground, on rays labelled ground."""
        samples, n = rays.samples, batch.rays_o.shape[0]
        ray = samples.ray_index()
        heavy = rays.weights.detach() > self.schedule.ground_weight
        index = self.buffers.indices("ground", is_ground(batch.label)[ray] & heavy)
        d = batch.rays_d.detach()[ray[index]]
        x = batch.rays_o.detach()[ray[index]] + samples.t[index, None] * d
        # Later the field's own classes separate ground from obstacles, so clutter next to obstacles
        # is moved as well, and all of it with a larger weight.
        classified = progress > self.classes_used_from and self.learns_classes
        far, goal, applies = self.evidence.free_space.ground_offsets(
            field.to_grid(x), d, rays.t[index], self.buffers, classified
        )
        index = index[far]
        weights = rays.weights[index] * applies
        loss = losses.ground_height_loss(weights, rays.t[index], goal, n)
        factor = self.schedule.confident_ground if classified else 1.0
        return self.settings.losses.ground_height * (factor * loss)

    def planarity(
        self, batch: Batch, z: Float[Tensor, "n"], opaque: Bool[Tensor, "n"]
    ) -> Float[Tensor, ""]:
        """Return the term on the curvature of surfaces along a batch's triples of pixels."""
        rows = triple_rows(z.shape[0], batch.in_line.shape[0], z.device)
        label = batch.label[rows]
        alike = (label == label[0]).all(0) & (label[0] != VEGETATION) & (label[0] != SKY)
        counts = (batch.in_line & alike & opaque[rows].all(0)).float()
        unlabelled = self.schedule.unlabelled_planarity
        counts = torch.where(label[0] == UNKNOWN, unlabelled, 1.0) * counts
        return self.settings.losses.planarity * losses.planarity_loss(z[rows].T, counts)

    def monocular_depth(
        self, batch: Batch, z: Float[Tensor, "n"], opaque: Bool[Tensor, "n"]
    ) -> Float[Tensor, ""]:
        """Return the term on the difference from relative depth."""
        assert batch.relative is not None
        counts = opaque & (batch.label != SKY) & torch.isfinite(batch.relative)
        loss = self.depth_alignment.loss(1 / z, batch.relative, batch.image, counts)
        return self.settings.losses.monocular_depth * loss

    def surface_heads(
        self,
        field: Field,
        batch: Batch,
        samples: Samples,
        visible: VisibleSamples,
        progress: float,
    ) -> Float[Tensor, ""]:
        """Return the terms on classes and normals, on a prefix of the rays."""
        weight = self.settings.losses
        if not (weight.classes or weight.normals or weight.normal_consistency):
            return visible.u.sum() * 0.0
        n = max(batch.rays_o.shape[0] // self.schedule.surface_ray_stride, 1)
        selected = self.buffers.prefix("surface", visible.ray, n)
        raw = field.surface_raw(visible.u[selected].detach())
        ray, index = visible.ray[selected], visible.index[selected]
        weights = visible.weights.detach()[selected] * (ray < n)
        q = target = None
        if (weight.normals or weight.normal_consistency) and self.schedule.surfaces_found(progress):
            t = samples.t[index, None]
            q = field.to_grid(batch.rays_o.detach()[ray] + t * batch.rays_d.detach()[ray])
            if weight.normals:
                field.learned[0].fill_(progress > self.schedule.normals_at)
                target = field.density_normal(q)
        logits, difference = compositing.surface(weights, raw, target, offsets_of(ray, n))
        loss = weight.normals * difference.sum() / n
        if weight.classes and self.pixels.label is not None and self.learns_classes:
            classes = self.logit_of_class[batch.label[:n].long()]
            loss = loss + weight.classes * losses.class_loss(logits, classes, classes != UNKNOWN)
        if weight.normal_consistency and q is not None:
            step = self.schedule.normal_step * samples.dt[index] / field.unit
            normal = finite_difference_normal(field.raw_density, q, step)
            predicted = unit(raw[:, :3].detach(), 1e-6)
            difference = losses.normal_loss(weights, normal, predicted, n)
            loss = loss + weight.normal_consistency * difference
        return loss

    def sky_prior(self, field: Field, generator: torch.Generator) -> Float[Tensor, ""] | float:
        """Return the term on the sky in directions that no photo shows."""
        weight, n = self.settings.losses.sky_prior, self.schedule.sky_prior_directions
        if not weight:
            return 0.0
        d, radiance, unseen = self.evidence.sky_prior.draw(n, generator)
        sky = field.sky_colour(d, field.mean_embedding.detach().expand(n, -1))
        return weight * (losses.colour_error(sky, encode_srgb(radiance)) * unseen).mean()


def triple_rows(n: int, m: int, device: torch.device) -> Int[Tensor, "3 m"]:
    """Return the rows of a batch of n rays that are the middles and two sides of its m triples."""
    middle = torch.arange(m, device=device)
    return torch.stack([middle, middle + (n - 2 * m), middle + (n - m)])
