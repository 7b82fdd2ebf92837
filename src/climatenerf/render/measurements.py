"""Depth, normals and measured layers of camera rays, from how their light is divided."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from climatenerf.core.samples import COMPLETED, MIN_WEIGHT, offsets_of
from climatenerf.ops import compositing
from climatenerf.weather import media
from climatenerf.weather.world import SKY_OPACITY, TINY, RaySamples, RenderOutput, World

MIN_FRACTION = 1.0 / 2048  # of a pixel, below an 8-bit step: less is neither shaded nor measured


@dataclass(frozen=True)
class LightFractions:
    """How the light of n rays is divided among samples, surfaces and sky."""

    along: RaySamples
    kind: Int[Tensor, "s"]
    """What each sample shows: 0 the field, k the k-th matter."""
    of_field: Bool[Tensor, "s"]
    """Whether a sample is the field's, though matter may cover it."""
    front: Float[Tensor, "s"]
    """Weight of each sample in front of the surface."""
    surface: Float[Tensor, "n"]
    """Weight of what the surface shows."""
    sky: Float[Tensor, "n"]
    """Weight of the sky."""
    t_surface: Float[Tensor, "n"]
    """Ray length to the surface, m; +inf without."""


def measure(
    world: World,
    rays_o: Float[Tensor, "n 3"],
    rays_d: Float[Tensor, "n 3"],
    rgb: Float[Tensor, "n 3"],
    shares: LightFractions,
    surface_normal: Float[Tensor, "n 3"],
    layers: dict[str, Float[Tensor, "n"]],
) -> RenderOutput:
    """Measure what camera rays see; `layers` holds those of the surfaces, others are added."""
    samples, ray, n = shares.along.samples, shares.along.ray, rgb.shape[0]
    matter_weight = total(shares.front, samples.offsets)
    # Of the nearer kind alone: a trace of far water must not move the depth of near matter.
    depth = total(shares.front * samples.t, samples.offsets) / matter_weight.clamp_min(TINY)
    depth = torch.where(shares.surface > matter_weight, shares.t_surface, depth)
    depth = torch.where(shares.sky < SKY_OPACITY, depth, torch.inf)
    normal = torch.where((shares.surface > 0.5)[:, None], surface_normal, torch.zeros_like(rgb))
    passed = torch.ones_like(depth)
    for medium in world.media:
        own = media.transmittance([medium], rays_o, rays_d, depth)
        layers[medium.mask] = 1 - own
        passed = passed * own
    for index, matter in enumerate(world.matters, start=1):
        weight = total(shares.front * (shares.kind == index), samples.offsets)
        layers[matter.mask] = weight
        mine = ((shares.kind == index) & (shares.front > MIN_WEIGHT)).nonzero()[:, 0]
        x = rays_o[ray[mine]] + samples.t[mine, None] * rays_d[ray[mine]]
        height = matter.thickness(x)[:, None]
        thickness = compositing.accumulate(shares.front[mine], height, offsets_of(ray[mine], n))
        thickness = thickness[:, 0] / weight.clamp_min(TINY) * (weight > MIN_FRACTION)
        layers[matter.thickness_layer] = thickness
        seen = ((weight > 0.5) & (shares.surface <= 0.5)).nonzero()[:, 0]
        normal[seen] = matter.normal(rays_o[seen] + depth[seen, None] * rays_d[seen])
    layers["seen"] = torch.ones_like(depth)
    if samples.ids is not None:
        # Of the dry scene, as the classes are: snow on completed ground rests on a guess.
        dry = torch.where(shares.of_field, samples.sigma * samples.dt, 0.0)
        weights, _ = compositing.render_weights(dry, samples.offsets)
        completed = weights * (samples.ids == COMPLETED)
        layers["seen"] = (1 - total(completed, samples.offsets)).clamp(0, 1)
    return RenderOutput(rgb, depth, normal, passed, layers)


def total(values: Float[Tensor, "s"], offsets: Int[Tensor, "n+1"]) -> Float[Tensor, "n"]:
    """Sum of the samples' values along each ray."""
    values = values.float()
    return compositing.accumulate(values, torch.ones_like(values)[:, None], offsets)[:, 0]
