"""Samples of the field and of matter on the same rays, merged front to back."""

from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.core.classes import GROUND, SOLID_OF
from climatenerf.core.samples import MIN_WEIGHT, Samples
from climatenerf.field.capabilities import CLASSES, DENSITY, NORMALS
from climatenerf.field.normals import normals_at
from climatenerf.ops import compositing
from climatenerf.weather.world import World

FACES_UP = 0.5  # z of normals of what matter can lie on
HIDDEN = 1e-3  # transmittance below which matter is not looked for


def merged_samples(
    world: World, rays_o: Tensor, rays_d: Tensor, t_min: Tensor, step_scale: float
) -> tuple[Samples, Int[Tensor, "s"]]:
    """Samples of field and matter, merged, and the kind of each: 0 field, k the k-th matter."""
    endless = torch.full_like(t_min, 1e9)
    merged = world.field.march(rays_o, rays_d, t_min, endless, step_scale)
    kind = torch.zeros_like(merged.t, dtype=torch.long)
    for index, matter in enumerate(world.matters, start=1):
        own = matter.march(rays_o, rays_d, t_min, opaque_from(merged))
        order, offsets = compositing.merge_order(merged.t, merged.offsets, own.t, own.offsets)
        both = {
            key: torch.cat([getattr(merged, key), getattr(own, key)])[order]
            for key in ("t", "dt", "sigma")
        }
        ids = merged.ids
        if ids is not None:
            ids = torch.cat([ids, ids.new_full(own.t.shape, -1)])[order]
        kind = torch.cat([kind, torch.full_like(own.t, index, dtype=torch.long)])[order]
        merged = Samples(offsets, **both, ids=ids)
    return merged, kind


def with_covered(
    world: World,
    samples: Samples,
    ray: Int[Tensor, "s"],
    kind: Int[Tensor, "s"],
    weights: Float[Tensor, "s"],
    rays_o: Tensor,
    rays_d: Tensor,
) -> Int[Tensor, "s"]:
    """The kinds of samples, with those of the field that matter covers counted to that matter."""
    if not world.field.capabilities & {NORMALS, DENSITY}:
        return kind  # what faces up is unknown
    classes = CLASSES in world.field.capabilities
    ground = torch.as_tensor(SOLID_OF[list(GROUND)], device=weights.device)
    for index, matter in enumerate(world.matters, start=1):
        covers: Callable[[Tensor], Tensor] | None = getattr(matter, "covers", None)
        veiled: Callable[[Tensor], Tensor] | None = getattr(matter, "veiled", None)
        if covers is None:
            continue
        own = ((kind == 0) & (weights > MIN_WEIGHT)).nonzero()[:, 0]
        x = rays_o[ray[own]] + samples.t[own, None] * rays_d[ray[own]]
        rough = covers(x)
        near = rough | veiled(x) if classes and veiled is not None else rough
        own, x, rough = own[near], x[near], rough[near]
        normal, solid = normals_at(world.field, x, rays_d[ray[own]])
        # What is near and not rough lies in a veil.
        covered = rough | torch.isin(solid, ground)
        kind = kind.index_fill(0, own[covered & (normal[:, 2] > FACES_UP)], index)
    return kind


def opaque_from(samples: Samples) -> Float[Tensor, "n"]:
    """Ray length behind which nothing is visible; +inf where light is left."""
    _, transmittance = compositing.render_weights(samples.sigma * samples.dt, samples.offsets)
    ends = torch.full_like(transmittance, torch.inf)
    rays = (transmittance < HIDDEN).nonzero()[:, 0]
    last = samples.offsets[rays + 1] - 1
    # Somewhat further, since a cut through a clump of matter would move its middle.
    ends[rays] = samples.t[last] + 2 * samples.dt[last]
    return ends


def sample_colour(
    world: World,
    samples: Samples,
    ray: Int[Tensor, "s"],
    kind: Int[Tensor, "s"],
    keep: Int[Tensor, "k"],
    weights: Float[Tensor, "k"],
    rays_o: Tensor,
    rays_d: Tensor,
    pixel_angle: Float[Tensor, "n"],
) -> Float[Tensor, "k 3"]:
    """Linear radiance of the samples `keep`, whose weights are given.

    A layer of matter is a handful of samples on a ray: it has the colour of their mean position.
    """
    x = rays_o[ray[keep]] + samples.t[keep, None] * rays_d[ray[keep]]
    ids = None if samples.ids is None else samples.ids[keep]
    if not world.matters:
        return world.field.colour(x, rays_d, ray[keep], ids=ids, appearance=world.appearance)
    colour = torch.empty(keep.shape[0], 3, device=x.device)
    for index, matter in enumerate(world.matters, start=1):
        mine = (kind[keep] == index).nonzero()[:, 0]
        layer, first, t = _layers(samples, ray, keep, mine, weights[mine])
        own = ray[keep[first]]
        points = rays_o[own] + t[:, None] * rays_d[own]
        towards: Callable[[Tensor, Tensor, Tensor], Tensor] | None
        towards = getattr(matter, "colour_towards", None)
        if towards is None:
            colour[mine] = matter.colour(points)[layer]
        else:
            colour[mine] = towards(points, rays_d[own], pixel_angle[own] * t)[layer]
    own = kind[keep] == 0
    ids = None if ids is None else ids[own]
    colour[own] = world.field.colour(
        x[own], rays_d, ray[keep][own], ids=ids, appearance=world.appearance
    )
    return colour


def _layers(
    samples: Samples,
    ray: Int[Tensor, "s"],
    keep: Int[Tensor, "k"],
    mine: Int[Tensor, "m"],
    weights: Float[Tensor, "m"],
) -> tuple[Int[Tensor, "m"], Int[Tensor, "l"], Float[Tensor, "l"]]:
    """Group the samples `keep[mine]` that follow each other on a ray without a gap.

    Returns:
        The layer of each sample; the first sample of each layer, as an index of `keep`; and the
        mean ray length of each layer, m.
    """
    own = keep[mine]
    t, dt = samples.t[own], samples.dt[own]
    begins = torch.ones_like(own, dtype=torch.bool)
    adjacent = (mine[1:] == mine[:-1] + 1) & (ray[own[1:]] == ray[own[:-1]])
    begins[1:] = ~adjacent | (t[1:] - t[:-1] > dt[1:] + dt[:-1])
    layer = begins.cumsum(0) - 1
    count = int(begins.sum())
    total = weights.new_zeros(count).index_add_(0, layer, weights)
    mean = weights.new_zeros(count).index_add_(0, layer, weights * t)
    return layer, mine[begins], mean / total
