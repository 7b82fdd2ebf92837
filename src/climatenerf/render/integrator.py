"""One renderer for all weather: the radiance along a ray, by recursion.

A ray collects samples of the field and of matter on it, merged front to back. Media act between
them in closed form: since a sample absorbs at one place, its light crosses only the media in front
of it, so c_i becomes T(t_i) c_i + (1 - T(t_i)) c_medium; by Abel summation this is the paper's sum
over sigma_scene + sigma_air (ClimateNeRF, section 3.2) without samples in empty space. Where a ray
meets a surface, such as water, the surface's radiance replaces the light from behind it; the
surface traces reflected and refracted rays with this same function.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch
from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.core.samples import MIN_WEIGHT, offsets_of
from climatenerf.field.capabilities import COMPLETES
from climatenerf.field.compositing import (
    NEVER,
    RENDER_STEP,
    Checkpoints,
    chunks,
)
from climatenerf.ops import compositing
from climatenerf.render.dry_rays import radiance_alone, trace_field
from climatenerf.render.measurements import MIN_FRACTION, LightFractions, measure, total
from climatenerf.render.merging import merged_samples, sample_colour, with_covered
from climatenerf.weather import media
from climatenerf.weather.world import (
    RaySamples,
    RenderOutput,
    SurfaceHits,
    World,
    concatenate,
)

BOUNCES = 2  # hits on surfaces; beyond, rays see the world without surfaces
SECONDARY_STEP = 5.0  # marching step of rays behind a hit, which blur; RENDER_STEP: of camera rays


@torch.no_grad()
def trace(
    world: World,
    rays_o: Float[Tensor, "n 3"],
    rays_d: Float[Tensor, "n 3"],
    pixel_angle: Float[Tensor, "n"],
    cancelled: Callable[[], bool] | None = None,
) -> RenderOutput:
    """What camera rays see. Independent of how rays are grouped.

    Args:
        world: field and weather.
        rays_o: origins, m.
        rays_d: unit directions.
        pixel_angle: angle that a pixel spans, rad.
        cancelled: asked every 10 to 20 ms of computing; see `field.compositing.Checkpoints`.

    Raises:
        RenderCancelled: `cancelled` has answered True.
    """
    parts, checkpoint = [], Checkpoints(cancelled)
    for chunk in chunks(rays_o, checkpoint):
        start = torch.full_like(pixel_angle[chunk], world.field.near)
        rays = rays_o[chunk], rays_d[chunk], pixel_angle[chunk], start
        parts.append(_trace(world, *rays, bounces=BOUNCES, checkpoint=checkpoint))
    return concatenate(parts, slice(None))


def _trace(
    world: World,
    rays_o: Float[Tensor, "n 3"],
    rays_d: Float[Tensor, "n 3"],
    pixel_angle: Float[Tensor, "n"],
    t_min: Float[Tensor, "n"],
    bounces: int,
    checkpoint: Checkpoints = NEVER,
) -> RenderOutput:
    """See `trace`; at most `bounces` more hits on surfaces."""
    n, device = rays_o.shape[0], rays_o.device
    surfaces = world.surfaces if bounces > 0 else ()
    step_scale = RENDER_STEP if bounces == BOUNCES else SECONDARY_STEP
    measured = bounces == BOUNCES
    completes = measured and COMPLETES in world.field.capabilities  # its layer needs all samples
    if not (completes or world.media or world.matters):
        # Most reflected rays rise, and see what they would without weather.
        meets = torch.zeros(n, dtype=torch.bool, device=device)
        for surface in surfaces:
            meets |= surface.distance(rays_o, rays_d, pixel_angle) < torch.inf
            meets |= surface.inside(rays_o)
        if not bool(meets.all()):
            dry, wet = (~meets).nonzero()[:, 0], meets.nonzero()[:, 0]
            given = rays_o[dry], rays_d[dry], t_min[dry], step_scale
            parts = [trace_field(world, *given, measured)]
            if wet.numel():
                given = rays_o[wet], rays_d[wet], pixel_angle[wet], t_min[wet]
                checkpoint()
                parts.append(_trace(world, *given, bounces, checkpoint))
            return concatenate(parts, torch.cat([dry, wet]).argsort())
    samples, kind = merged_samples(world, rays_o, rays_d, t_min, step_scale)
    ray = samples.ray_index()
    weights, transmittance = compositing.render_weights(samples.sigma * samples.dt, samples.offsets)
    of_field = kind == 0
    kind = with_covered(world, samples, ray, kind, weights, rays_o, rays_d)
    along = RaySamples(samples, ray, weights)
    checkpoint()

    # --- Which fraction of the light comes from behind a surface? ---------------------------------
    t_surface = torch.full((n,), torch.inf, device=device)
    nearest = torch.full((n,), -1, device=device)
    for index, surface in enumerate(surfaces):
        t = surface.distance(rays_o, rays_d, pixel_angle)
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
    given = samples, ray, kind, keep, front[keep]
    colour = sample_colour(world, *given, rays_o, rays_d, pixel_angle)
    colour = arrive(colour, ray[keep], samples.t[keep])
    offsets = offsets_of(ray[keep], n)
    rgb = compositing.accumulate(front[keep], colour, offsets)

    # --- Sky ----------------------------------------------------------------------------------
    endless = torch.full((n,), torch.inf, device=device)
    skyward = (sky_weight > MIN_WEIGHT).nonzero()[:, 0]
    sky = world.field.sky(rays_d[skyward], world.appearance)
    if not measured and world.light is not None:
        sky = world.light.reflected_sky(rays_d[skyward], sky)
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
        rays = rays_o[hit], rays_d[hit], t_surface[hit], t_bottom[hit], pixel_angle[hit]
        shaded, own_normal, extra = surface.shade(
            world, SurfaceHits(*rays), partial(_radiance, world, bounces - 1, checkpoint)
        )
        normal = normal.index_copy(0, hit, own_normal)
        shaded = arrive(shaded, hit, t_surface[hit])
        rgb = rgb.index_add(0, hit, surface_weight[hit, None] * shaded)
        for name, values in extra.items():
            layers[name][hit] = values

    if not measured:
        return radiance_alone(rgb)
    shares = LightFractions(along, kind, of_field, front, surface_weight, sky_weight, t_surface)
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
    world = replace(world, surfaces=tuple(surface.calm for surface in world.surfaces))
    checkpoint()
    rgb = _trace(world, rays_o, rays_d, pixel_angle, start, bounces, checkpoint).rgb
    checkpoint()
    return rgb


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
            through = surface.attenuate(world, radiance, o, d, t)
            arriving = torch.where(within[:, None], through, arriving)
    return arriving
