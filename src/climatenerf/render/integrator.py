"""One renderer for all weather: the radiance along a ray, by recursion.

A ray collects samples of the field and of matter on it, merged front to back. Media act between
them in closed form: since a sample absorbs at one place, its light crosses only the media in front
of it, so c_i becomes T(t_i) c_i + (1 - T(t_i)) c_medium; by Abel summation this is the paper's sum
over sigma_scene + sigma_air (ClimateNeRF, section 3.2) without samples in empty space. Where a ray
meets a surface, such as water, the surface's radiance replaces the light from behind it; the
surface traces reflected and refracted rays with this same function.
"""

from collections.abc import Callable
from functools import partial

import torch
from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.core.samples import MIN_WEIGHT, Samples, offsets_of
from climatenerf.field.compositing import (
    NEVER,
    RENDER_STEP,
    Checkpoints,
    chunks,
    composited,
)
from climatenerf.ops import compositing
from climatenerf.render.measurements import MIN_FRACTION, LightFractions, measure, total
from climatenerf.weather import media
from climatenerf.weather.world import (
    SKY_OPACITY,
    TINY,
    RaySamples,
    RenderOutput,
    SurfaceHits,
    World,
    concatenate,
)

HIDDEN = 1e-3  # transmittance below which matter is not looked for
BOUNCES = 2  # hits on surfaces; beyond, rays see the world without surfaces
SECONDARY_STEP = 5.0  # marching step of rays behind a hit, which blur; RENDER_STEP: of camera rays


@torch.no_grad()
def trace(
    world: World,
    rays_o: Float[Tensor, "n 3"],
    rays_d: Float[Tensor, "n 3"],
    pixel_angle: Float[Tensor, "n"],
    sample_rotation: Float[Tensor, "n"] | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> RenderOutput:
    """What camera rays see. Independent of how rays are grouped.

    Args:
        world: field and weather.
        rays_o: origins, m.
        rays_d: unit directions.
        pixel_angle: angle that a pixel spans, rad.
        sample_rotation: angle that rotates each ray's glossy sample set, rad; see
            `flood.optics.pixel_rotation`.
        cancelled: asked every 10 to 20 ms of computing; see `field.compositing.Checkpoints`.

    Raises:
        RenderCancelled: `cancelled` has answered True.
    """
    parts, checkpoint = [], Checkpoints(cancelled)
    for chunk in chunks(rays_o, checkpoint):
        rotation = None if sample_rotation is None else sample_rotation[chunk]
        start = torch.full_like(pixel_angle[chunk], world.field.near)
        rays = rays_o[chunk], rays_d[chunk], pixel_angle[chunk], rotation, start
        parts.append(_trace(world, *rays, bounces=BOUNCES, checkpoint=checkpoint))
    return concatenate(parts, slice(None))


def _trace(
    world: World,
    rays_o: Float[Tensor, "n 3"],
    rays_d: Float[Tensor, "n 3"],
    pixel_angle: Float[Tensor, "n"],
    sample_rotation: Float[Tensor, "n"] | None,
    t_min: Float[Tensor, "n"],
    bounces: int,
    checkpoint: Checkpoints = NEVER,
) -> RenderOutput:
    """See `trace`; at most `bounces` more hits on surfaces."""
    n, device = rays_o.shape[0], rays_o.device
    surfaces = world.surfaces if bounces > 0 else ()
    step_scale = RENDER_STEP if bounces == BOUNCES else SECONDARY_STEP
    if not world.media and not world.matters:
        # Most reflected rays rise, and see what they would without weather.
        meets = torch.zeros(n, dtype=torch.bool, device=device)
        for surface in surfaces:
            meets |= (surface.distance(rays_o, rays_d) < torch.inf) | surface.inside(rays_o)
        if not bool(meets.all()):
            dry, wet = (~meets).nonzero()[:, 0], meets.nonzero()[:, 0]
            parts = [_trace_field(world, rays_o[dry], rays_d[dry], t_min[dry], bounces)]
            if wet.numel():
                rotation = None if sample_rotation is None else sample_rotation[wet]
                given = rays_o[wet], rays_d[wet], pixel_angle[wet], rotation, t_min[wet]
                checkpoint()
                parts.append(_trace(world, *given, bounces, checkpoint))
            return concatenate(parts, torch.cat([dry, wet]).argsort())
    samples, kind = _all_samples(world, rays_o, rays_d, t_min, step_scale)
    ray = samples.ray_index()
    weights, transmittance = compositing.render_weights(samples.sigma * samples.dt, samples.offsets)
    along = RaySamples(samples, ray, weights)
    checkpoint()

    # --- Which fraction of the light comes from behind a surface? ---------------------------------
    t_surface = torch.full((n,), torch.inf, device=device)
    nearest = torch.full((n,), -1, device=device)
    for index, surface in enumerate(surfaces):
        t = surface.distance(rays_o, rays_d)
        nearest = torch.where(t < t_surface, index, nearest)
        t_surface = torch.minimum(t, t_surface)
    behind = torch.zeros_like(weights)
    for index, surface in enumerate(surfaces):
        t = torch.where(nearest == index, t_surface, torch.inf)
        behind += surface.fraction_behind(world, along, rays_o, rays_d, t, pixel_angle)
    front = weights * (1 - behind)
    surface_weight = total(weights * behind, samples.offsets)
    surface_weight = surface_weight + transmittance * (t_surface < torch.inf)
    sky_weight = transmittance * (t_surface == torch.inf)
    arrive = partial(_arrive, world, surfaces, rays_o, rays_d)

    checkpoint()
    # --- Light of the field and of matter in front of the surface ---------------------------------
    keep = (front > MIN_WEIGHT).nonzero()[:, 0]
    colour = _sample_colour(world, samples, ray, kind, keep, rays_o, rays_d)
    colour = arrive(colour, ray[keep], samples.t[keep])
    offsets = offsets_of(ray[keep], n)
    rgb = compositing.accumulate(front[keep], colour, offsets)

    # --- Sky ----------------------------------------------------------------------------------
    endless = torch.full((n,), torch.inf, device=device)
    skyward = (sky_weight > MIN_WEIGHT).nonzero()[:, 0]
    sky = world.field.sky(rays_d[skyward], world.appearance)
    sky = arrive(sky, skyward, endless[skyward])
    rgb = rgb.index_add(0, skyward, sky_weight[skyward, None] * sky)

    checkpoint()
    # --- Surfaces -----------------------------------------------------------------------------
    layers = {name: torch.zeros(n, device=device) for name in world.layer_names}
    normal = torch.tensor([0.0, 0.0, 1.0], device=device).expand(n, 3)
    t_bottom = None
    for index, surface in enumerate(surfaces):
        own_weight = torch.where(nearest == index, surface_weight, 0.0)
        layers[surface.mask] = own_weight.clamp_max(1.0)
        hit = (own_weight > MIN_FRACTION).nonzero()[:, 0]
        if not hit.numel():
            continue
        if t_bottom is None:
            # 1e-6: a surface with nothing behind it would give 0/0.
            weight_behind = total(weights * behind, samples.offsets).clamp_min(1e-6)
            t_bottom = total(weights * behind * samples.t, samples.offsets) / weight_behind
        rotation = None if sample_rotation is None else sample_rotation[hit]
        rays = rays_o[hit], rays_d[hit], t_surface[hit], t_bottom[hit], pixel_angle[hit], rotation
        shaded, own_normal, extra = surface.shade(
            world, SurfaceHits(*rays), partial(_radiance, world, bounces - 1, checkpoint)
        )
        normal = normal.index_copy(0, hit, own_normal)
        shaded = arrive(shaded, hit, t_surface[hit])
        rgb = rgb.index_add(0, hit, surface_weight[hit, None] * shaded)
        for name, values in extra.items():
            layers[name][hit] = values

    if bounces < BOUNCES:
        return _radiance_alone(rgb)
    shares = LightFractions(along, kind, front, surface_weight, sky_weight, t_surface)
    return measure(world, rays_o, rays_d, rgb, shares, normal, layers)


def _radiance(
    world: World,
    bounces: int,
    checkpoint: Checkpoints,
    rays_o: Float[Tensor, "n 3"],
    rays_d: Float[Tensor, "n 3"],
    pixel_angle: Float[Tensor, "n"],
) -> Float[Tensor, "n 3"]:
    """Radiance along secondary rays, for surfaces."""
    start = torch.zeros(rays_o.shape[0], device=rays_o.device)
    checkpoint()
    rgb = _trace(world, rays_o, rays_d, pixel_angle, None, start, bounces, checkpoint).rgb
    checkpoint()
    return rgb


def _radiance_alone(rgb: Float[Tensor, "n 3"]) -> RenderOutput:
    """Output of secondary rays, of which only the radiance is used."""
    nothing = torch.zeros(rgb.shape[0], device=rgb.device)
    return RenderOutput(rgb, nothing, torch.zeros_like(rgb), nothing)


def _trace_field(
    world: World, rays_o: Tensor, rays_d: Tensor, t_min: Tensor, bounces: int
) -> RenderOutput:
    """What rays see of the scene without weather: as `_trace`, in one launch on a GPU."""
    step_scale = RENDER_STEP if bounces == BOUNCES else SECONDARY_STEP
    rgb, transmittance, length = composited(
        world.field, rays_o, rays_d, t_min, step_scale, appearance=world.appearance
    )
    skyward = (transmittance > MIN_WEIGHT).nonzero()[:, 0]
    sky = world.field.sky(rays_d[skyward], world.appearance)
    rgb = rgb.index_add(0, skyward, transmittance[skyward, None] * sky)
    if bounces < BOUNCES:
        return _radiance_alone(rgb)
    depth = length / (1 - transmittance).clamp_min(TINY)
    nothing = torch.zeros_like(depth)
    return RenderOutput(
        rgb,
        torch.where(transmittance < SKY_OPACITY, depth, torch.full_like(depth, torch.inf)),
        torch.zeros_like(rgb),
        torch.ones_like(depth),
        dict.fromkeys(world.layer_names, nothing),
    )


def _all_samples(
    world: World, rays_o: Tensor, rays_d: Tensor, t_min: Tensor, step_scale: float
) -> tuple[Samples, Int[Tensor, "s"]]:
    """Samples of field and matter, merged, and the kind of each: 0 field, k the k-th matter."""
    endless = torch.full_like(t_min, 1e9)
    merged = world.field.march(rays_o, rays_d, t_min, endless, step_scale)
    kind = torch.zeros_like(merged.t, dtype=torch.long)
    for index, matter in enumerate(world.matters, start=1):
        own = matter.march(rays_o, rays_d, t_min, _opaque_from(merged))
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


def _opaque_from(samples: Samples) -> Float[Tensor, "n"]:
    """Ray length behind which nothing is visible; +inf where light is left."""
    _, transmittance = compositing.render_weights(samples.sigma * samples.dt, samples.offsets)
    ends = torch.full_like(transmittance, torch.inf)
    rays = (transmittance < HIDDEN).nonzero()[:, 0]
    last = samples.offsets[rays + 1] - 1
    # Somewhat further, since a cut through a clump of matter would move its middle.
    ends[rays] = samples.t[last] + 2 * samples.dt[last]
    return ends


def _sample_colour(
    world: World,
    samples: Samples,
    ray: Int[Tensor, "s"],
    kind: Int[Tensor, "s"],
    keep: Int[Tensor, "k"],
    rays_o: Tensor,
    rays_d: Tensor,
) -> Float[Tensor, "k 3"]:
    """Linear radiance of the samples `keep`."""
    x = rays_o[ray[keep]] + samples.t[keep, None] * rays_d[ray[keep]]
    ids = None if samples.ids is None else samples.ids[keep]
    if not world.matters:
        return world.field.colour(x, rays_d, ray[keep], ids=ids, appearance=world.appearance)
    colour = torch.empty(keep.shape[0], 3, device=x.device)
    for index, matter in enumerate(world.matters, start=1):
        mine = kind[keep] == index
        colour[mine] = matter.colour(x[mine])
    own = kind[keep] == 0
    ids = None if ids is None else ids[own]
    colour[own] = world.field.colour(
        x[own], rays_d, ray[keep][own], ids=ids, appearance=world.appearance
    )
    return colour


def _arrive(
    world: World,
    surfaces: tuple,
    rays_o: Float[Tensor, "n 3"],
    rays_d: Float[Tensor, "n 3"],
    radiance: Float[Tensor, "k 3"],
    ray: Int[Tensor, "k"],
    t: Float[Tensor, "k"],
) -> Float[Tensor, "k 3"]:
    """Radiance from ray length t as it arrives at the eye: through media, or through a body."""
    o, d = rays_o[ray], rays_d[ray]
    arriving = radiance
    if world.media:
        arriving = media.attenuate(world.media, radiance, o, d, t)
    for surface in surfaces:
        within = surface.inside(o)
        if bool(within.any()):
            through = surface.attenuate(radiance, o, d, t)
            arriving = torch.where(within[:, None], through, arriving)
    return arriving
