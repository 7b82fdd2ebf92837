"""One renderer for all weather: what a ray sees of the world, by recursion.

A ray collects samples of the field and of matter lying on it, merged front to back. Air acts
between them in closed form. Since a sample absorbs at one place, each sample's light crosses the
air (or water) in front of it only, so c_i becomes T(t_i) c_i + (1 - T(t_i)) c_air: by Abel
summation this is the paper's sum over sigma_scene + sigma_air, with no samples in empty space.
Where the ray meets the water, the part of its light that comes from beyond the surface is replaced
by what the surface shows: reflected rays traced by the same function, and the bed seen through
water.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from climatenerf.core.samples import MIN_TAU, MIN_WEIGHT, Samples, offsets_of
from climatenerf.ops import compositing
from climatenerf.render.volume import RENDER_STEP, composited, rays_at_once
from climatenerf.weather.flood import optics as water_physics
from climatenerf.weather.flood import waves
from climatenerf.weather.smog import medium as smog
from climatenerf.weather.world import (
    SKY_OPACITY,
    TINY,
    RenderOutput,
    Water,
    World,
    concatenate,
)

HIDDEN = 1e-3  # what this share of the light or less comes from is not looked for
MIN_SHARE = 1.0 / 2048  # of a pixel that water must have to be traced: below an 8-bit step
BOUNCES = 2  # meetings with the water, then the plain field
SECONDARY_STEP = 5.0  # marching step of what is seen by way of the water; RENDER_STEP: of the rest
SKIN = 2e-3  # secondary rays begin this far from the water, m


@torch.no_grad()
def trace(
    world: World,
    rays_o: Float[Tensor, "n 3"],
    rays_d: Float[Tensor, "n 3"],
    pixel_angle: Float[Tensor, "n"],
    roll: Float[Tensor, "n"] | None = None,
) -> RenderOutput:
    """What camera rays see. Independent of how rays are grouped.

    Args:
        world: field and weather.
        rays_o: origins, m.
        rays_d: unit directions.
        pixel_angle: angle a pixel spans, rad.
        roll: turn of each ray's glossy reflection, rad; see `flood.optics.pixel_rotation`.
    """
    parts = []
    size = rays_at_once(rays_o)
    for start in range(0, rays_o.shape[0], size):
        some = slice(start, start + size)
        parts.append(
            _trace(
                world,
                rays_o[some],
                rays_d[some],
                pixel_angle[some],
                None if roll is None else roll[some],
                torch.full_like(pixel_angle[some], world.field.near),
                bounces=BOUNCES,
            )
        )
    return concatenate(parts, slice(None))


def _trace(
    world: World,
    rays_o: Float[Tensor, "n 3"],
    rays_d: Float[Tensor, "n 3"],
    pixel_angle: Float[Tensor, "n"],
    roll: Float[Tensor, "n"] | None,
    t_min: Float[Tensor, "n"],
    bounces: int,
) -> RenderOutput:
    """See `trace`; at most `bounces` more meetings with the water, then the plain field."""
    n = rays_o.shape[0]
    water = world.water if bounces > 0 else None
    # Reflections are blurred by the waves: coarser steps do for them.
    step_scale = RENDER_STEP if bounces == BOUNCES else SECONDARY_STEP
    if world.air is None and world.matter is None:
        if water is None:
            return _see_plain(world, rays_o, rays_d, t_min, step_scale)
        # Most reflected rays rise, and see what they would without weather.
        meets = water_physics.plane_distance(rays_o, rays_d, water.level) < torch.inf
        meets = meets | (rays_o[:, 2] < water.level)
        if not bool(meets.all()):
            dry, wet = (~meets).nonzero()[:, 0], meets.nonzero()[:, 0]
            parts = [_see_plain(world, rays_o[dry], rays_d[dry], t_min[dry], step_scale)]
            if wet.numel():
                given = (rays_o[wet], rays_d[wet], pixel_angle[wet])
                turn = None if roll is None else roll[wet]
                parts.append(_trace(world, *given, turn, t_min[wet], bounces))
            return concatenate(parts, torch.cat([dry, wet]).argsort())
    samples, is_matter = _all_samples(world, rays_o, rays_d, t_min, step_scale)
    ray = samples.ray_index()
    weights, left = compositing.render_weights(samples.sigma * samples.dt, samples.offsets)

    # --- Which share of the light comes from beyond the water? -----------------------------------
    if water is None:
        t_plane = torch.full((n,), torch.inf)
        beyond = torch.zeros_like(weights)
        below = torch.zeros(n, dtype=torch.bool)
    else:
        t_plane = water_physics.plane_distance(rays_o, rays_d, water.level)
        below = rays_o[:, 2] < water.level
        beyond = _beyond(world, samples, ray, weights, rays_o, rays_d, t_plane, pixel_angle)
    front = weights * (1 - beyond)
    water_share = _sum(weights * beyond, samples.offsets) + left * (t_plane < torch.inf)
    sky_share = left * (t_plane == torch.inf)

    # --- Light of the matter this side of the water, through the air -----------------------------
    keep = (front > MIN_WEIGHT).nonzero()[:, 0]
    colour = _sample_colour(world, samples, ray, is_matter, keep, rays_o, rays_d)
    own_t = samples.t[keep]
    colour = _through(world, water, below[ray[keep]], colour, rays_o, rays_d, ray[keep], own_t)
    offsets = offsets_of(ray[keep], n)
    rgb = compositing.accumulate(front[keep], colour, offsets)

    # --- Sky ---------------------------------------------------------------------------------
    endless = torch.full((n,), torch.inf)
    skyward = (sky_share > MIN_WEIGHT).nonzero()[:, 0]
    sky = world.field.sky(rays_d[skyward], world.appearance)
    sky = _through(world, water, below[skyward], sky, rays_o, rays_d, skyward, endless[skyward])
    rgb = rgb.index_add(0, skyward, sky_share[skyward, None] * sky)

    # --- Water ---------------------------------------------------------------------------------
    water_depth = torch.zeros(n)
    wave_normal = torch.tensor([0.0, 0.0, 1.0]).expand(n, 3)
    wet = (water_share > MIN_SHARE).nonzero()[:, 0]
    if water is not None and wet.numel():
        bed_t = _sum(weights * beyond * samples.t, samples.offsets) / _sum(
            weights * beyond, samples.offsets
        ).clamp_min(1e-6)  # water without a bed: 0/0
        drop = (bed_t - t_plane).clamp_min(0) * rays_d[:, 2].abs()
        water_depth = torch.where(torch.isfinite(drop) & ~below, drop, torch.zeros(n))
        shown, wave_normal_wet = _water_light(
            world,
            water,
            rays_o[wet],
            rays_d[wet],
            t_plane[wet],
            pixel_angle[wet],
            None if roll is None else roll[wet],
            below[wet],
            water_depth[wet],
            bounces,
        )
        wave_normal = wave_normal.index_copy(0, wet, wave_normal_wet)
        shown = _through(world, water, below[wet], shown, rays_o, rays_d, wet, t_plane[wet])
        rgb = rgb.index_add(0, wet, water_share[wet, None] * shown)

    # --- Layers --------------------------------------------------------------------------------
    matter_share = _sum(front, samples.offsets)
    # Of the nearer kind alone: a trace of far water must not move the depth of what is near.
    depth = _sum(front * samples.t, samples.offsets) / matter_share.clamp_min(TINY)
    depth = torch.where(water_share > matter_share, t_plane, depth)
    depth = torch.where(sky_share < SKY_OPACITY, depth, endless)
    air = (
        torch.ones(n) if world.air is None else smog.transmittance(world.air, rays_o, rays_d, depth)
    )
    snow_share = _sum(front * is_matter, samples.offsets)
    thickness = torch.zeros(n)
    if world.matter is not None:
        mine = keep[is_matter[keep]]
        x = rays_o[ray[mine]] + samples.t[mine, None] * rays_d[ray[mine]]
        height = world.matter.thickness(x)
        thickness = compositing.accumulate(front[mine], height[:, None], offsets_of(ray[mine], n))[
            :, 0
        ]
        thickness = thickness / snow_share.clamp_min(TINY) * (snow_share > MIN_SHARE)
    normal = torch.where((water_share > 0.5)[:, None], wave_normal, torch.zeros(n, 3))
    if world.matter is not None and bounces == BOUNCES:
        mine = ((snow_share > 0.5) & (water_share <= 0.5)).nonzero()[:, 0]
        normal[mine] = world.matter.normal(rays_o[mine] + depth[mine, None] * rays_d[mine])
    return RenderOutput(
        rgb=rgb,
        depth=depth,
        normal=normal,
        transmittance=air,
        water_depth=water_depth * (water_share > MIN_SHARE),
        snow_thickness=thickness,
        mask_water=water_share.clamp_max(1.0),
        mask_snow=snow_share,
        mask_smog=1 - air,
    )


def _see_plain(
    world: World, rays_o: Tensor, rays_d: Tensor, t_min: Tensor, step_scale: float
) -> RenderOutput:
    """What rays see of the scene without weather: as `_trace`, in one go on a GPU."""
    n = t_min.shape[0]
    rgb, left, far = composited(
        world.field, rays_o, rays_d, t_min, step_scale, appearance=world.appearance
    )
    skyward = (left > MIN_WEIGHT).nonzero()[:, 0]
    rgb = rgb.index_add(
        0, skyward, left[skyward, None] * world.field.sky(rays_d[skyward], world.appearance)
    )
    depth = far / (1 - left).clamp_min(TINY)
    nothing = torch.zeros(n)
    return RenderOutput(
        rgb=rgb,
        depth=torch.where(left < SKY_OPACITY, depth, torch.full_like(depth, torch.inf)),
        normal=torch.zeros(n, 3),
        transmittance=torch.ones(n),
        water_depth=nothing,
        snow_thickness=nothing,
        mask_water=nothing,
        mask_snow=nothing,
        mask_smog=nothing,
    )


def _all_samples(
    world: World, rays_o: Tensor, rays_d: Tensor, t_min: Tensor, step_scale: float
) -> tuple[Samples, Bool[Tensor, "s"]]:
    """Samples of field and matter, merged, and which of them are matter's."""
    endless = torch.full_like(t_min, 1e9)
    field = world.field.march(rays_o, rays_d, t_min, endless, step_scale)
    if world.matter is None:
        return field, torch.zeros(field.t.shape[0], dtype=torch.bool)
    own = world.matter.march(rays_o, rays_d, t_min, _opaque_from(field))
    order, offsets = compositing.merge_order(field.t, field.offsets, own.t, own.offsets)
    both = {
        key: torch.cat([getattr(field, key), getattr(own, key)])[order]
        for key in ("t", "dt", "sigma")
    }
    ids = None
    if field.ids is not None:
        ids = torch.cat([field.ids, field.ids.new_full(own.t.shape, -1)])[order]
    return Samples(offsets, **both, ids=ids), order >= field.t.shape[0]


def _opaque_from(samples: Samples) -> Float[Tensor, "n"]:
    """Ray length behind which nothing shows any more; +inf where light is left."""
    _, left = compositing.render_weights(samples.sigma * samples.dt, samples.offsets)
    ends = torch.full_like(left, torch.inf)
    rays = (left < HIDDEN).nonzero()[:, 0]
    last = samples.offsets[rays + 1] - 1
    # Some way further, since cutting a clump of snow would move its middle.
    ends[rays] = samples.t[last] + 2 * samples.dt[last]
    return ends


def _beyond(
    world: World,
    samples: Samples,
    ray: Int[Tensor, "s"],
    weights: Float[Tensor, "s"],
    rays_o: Tensor,
    rays_d: Tensor,
    t_plane: Float[Tensor, "n"],
    pixel_angle: Float[Tensor, "n"],
) -> Float[Tensor, "s"]:
    """Share of each sample that lies beyond the water plane: 0 or 1 but for the waterline's pixel.

    The soft edge is kept to the wet side (0 at the waterline, 1 half a pixel from it), so that
    water under the ground shows nowhere; the visible edge moves by a quarter of a pixel.

    The waterline's softness depends on how the ground slopes, so the ground's normal is found for
    the rays that have matter within a pixel of the plane.
    """
    beyond = (samples.t > t_plane[ray]).float()
    some = ((weights > MIN_WEIGHT) & (t_plane[ray] < torch.inf)).nonzero()[:, 0]
    own = ray[some]
    arguments = (t_plane[own], samples.t[some], rays_d[own], pixel_angle[own])
    soft = water_physics.shore_coverage(*arguments)
    rays = torch.unique(own[(soft > 0) & (soft < 1)])
    if not rays.numel():
        return beyond
    x = rays_o[rays] + t_plane[rays, None] * rays_d[rays]
    step = (2 * pixel_angle[rays] * t_plane[rays]).clamp_min(0.02)
    normal = torch.zeros_like(rays_d)
    normal[:, 2] = 1.0
    normal[rays] = _field_normal(world, x, step, rays_d[rays])
    covered = 2 * water_physics.shore_coverage(*arguments, normal[own]) - 1
    return beyond.index_copy(0, some, covered.clamp_min(0.0))


def _sample_colour(
    world: World,
    samples: Samples,
    ray: Int[Tensor, "s"],
    is_matter: Bool[Tensor, "s"],
    keep: Int[Tensor, "k"],
    rays_o: Tensor,
    rays_d: Tensor,
) -> Float[Tensor, "k 3"]:
    """Linear radiance of some samples."""
    x = rays_o[ray[keep]] + samples.t[keep, None] * rays_d[ray[keep]]
    ids = None if samples.ids is None else samples.ids[keep]
    if world.matter is None:
        return world.field.colour(x, rays_d, ray[keep], ids=ids, appearance=world.appearance)
    colour = torch.empty(keep.shape[0], 3)
    mine = is_matter[keep]
    colour[mine] = world.matter.colour(x[mine])
    ids = None if ids is None else ids[~mine]
    colour[~mine] = world.field.colour(
        x[~mine], rays_d, ray[keep][~mine], ids=ids, appearance=world.appearance
    )
    return colour


def _through(
    world: World,
    water: Water | None,
    below: Bool[Tensor, "k"],
    colour: Float[Tensor, "k 3"],
    rays_o: Tensor,
    rays_d: Tensor,
    ray: Int[Tensor, "k"],
    t: Float[Tensor, "k"],
) -> Float[Tensor, "k 3"]:
    """Light from ray length t as it arrives at the eye: through air, or through water below."""
    if world.air is not None:
        passed = smog.transmittance(world.air, rays_o[ray], rays_d[ray], t)
        hazy = smog.apply(world.air, colour, passed)
        colour = torch.where(below[:, None], colour, hazy)
    if water is not None and bool(below.any()):
        beta = torch.tensor(water_physics.attenuation(water.flood))
        deep = water.level - rays_o[ray, 2] - t.clamp_max(1e6) * rays_d[ray, 2]
        passed = water_physics.water_transmittance(
            beta, t, deep, water_physics.light_cosine(water.flood, water.sun_elevation)
        )
        body = water_physics.body_colour(water.flood, water.irradiance)
        colour = torch.where(below[:, None], colour * passed + body * (1 - passed), colour)
    return colour


def _water_light(
    world: World,
    water: Water,
    rays_o: Float[Tensor, "n 3"],
    rays_d: Float[Tensor, "n 3"],
    t: Float[Tensor, "n"],
    pixel_angle: Float[Tensor, "n"],
    roll: Float[Tensor, "n"] | None,
    below: Bool[Tensor, "n"],
    depth: Float[Tensor, "n"],
    bounces: int,
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Radiance that the surface sends towards the eye at ray length t, and its normal there."""
    n = rays_o.shape[0]
    x = rays_o + t[:, None] * rays_d
    x[:, 2] = water.level
    footprint = water_physics.footprint(t, rays_d, pixel_angle)
    slope, variance = waves.slopes(water.waves, x[:, :2], footprint)
    normal = water_physics.normal_of(slope)
    directions, parts, share = water_physics.reflection(
        rays_d, slope, variance, water.flood, below, roll
    )
    if water.mirror_only:
        directions, parts = directions[:, :1], torch.ones(1)
        share = torch.ones_like(share)

    # --- Reflected rays, traced like any other ----------------------------------------------------
    count = directions.shape[1]
    side = torch.where(below, -SKIN, SKIN)
    start = x + torch.stack([torch.zeros(n), torch.zeros(n), side], dim=-1)
    seen = _trace(
        world,
        start.repeat_interleave(count, 0),
        directions.reshape(-1, 3),
        pixel_angle.repeat_interleave(count, 0) * 2,
        None,
        torch.zeros(n * count),
        bounces - 1,
    )
    reflected = (seen.rgb.view(n, count, 3) * parts[:, None]).sum(1)

    # --- What is on the other side ------------------------------------------------------------
    direction, total = water_physics.refract(rays_d, normal, water.flood.ior, below)
    direction = direction * ~total[:, None]  # nothing goes on
    behind, through = _other_side(
        world,
        water,
        start - 2 * side[:, None] * torch.tensor([0.0, 0.0, 1.0]),
        direction,
        below,
        pixel_angle,
        depth,
        bounces,
    )
    # From below the mean over slopes lets a little through even where the facet seen reflects all.
    share = torch.where(total, torch.ones_like(share), share)
    body = water_physics.body_colour(water.flood, water.irradiance)
    return water_physics.shade(reflected, share, behind, through, body), normal


def _other_side(
    world: World,
    water: Water,
    start: Float[Tensor, "n 3"],
    direction: Float[Tensor, "n 3"],
    below: Bool[Tensor, "n"],
    pixel_angle: Float[Tensor, "n"],
    depth: Float[Tensor, "n"],
    bounces: int,
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Radiance beyond the surface along the refracted ray, and how much the water lets through.

    From above: the bed, converted to a wet bed, and the water's transmittance. From below: the
    air's light, and 1.
    """
    n = start.shape[0]
    behind, through = torch.zeros(n, 3), torch.zeros(n, 3)
    beta = torch.tensor(water_physics.attenuation(water.flood))
    # Under the straight ray's depth of opaque water no bed shows: no ray is spent on it. Light
    # comes down through the depth and goes up through at least as much.
    shows = torch.exp(-2 * beta.min() * depth) > MIN_SHARE
    down = (~below & shows & (direction[:, 2] < 0)).nonzero()[:, 0]
    if down.numel():
        o, d = start[down], direction[down]
        zero = torch.zeros(down.shape[0])
        # A bed is seen as it is; its steps are fine.
        matter, left, length = composited(
            world.field,
            o,
            d,
            zero,
            RENDER_STEP,
            pruning_threshold=MIN_TAU,
            appearance=world.appearance,
        )
        opacity = (1 - left).clamp_min(TINY)
        dry, path = matter / opacity[:, None], length / opacity
        light = water_physics.light_cosine(water.flood, water.sun_elevation)
        passed = water_physics.water_transmittance(beta, path, path * d[:, 2].abs(), light)
        behind[down] = water_physics.bottom_radiance(dry, water.irradiance, water.flood.ior)
        through[down] = passed * (1 - left)[:, None]
    through[below] = 1.0
    up = (below & (direction[:, 2] > 0)).nonzero()[:, 0]
    if up.numel():
        zero = torch.zeros(up.shape[0])
        seen = _trace(world, start[up], direction[up], pixel_angle[up], None, zero, bounces - 1)
        behind[up] = seen.rgb
    return behind, through


def _field_normal(
    world: World, x: Float[Tensor, "n 3"], step: Float[Tensor, "n"], rays_d: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 3"]:
    """Unit normal of the field near x, by central differences, turned towards the eye."""
    gradient = torch.zeros_like(x)
    for axis in range(3):
        offset = torch.zeros_like(x)
        offset[:, axis] = step
        gradient[:, axis] = _squashed(world, x + offset, step) - _squashed(world, x - offset, step)
    length = gradient.norm(dim=-1, keepdim=True)
    # Where density is flat the surface is taken to face the eye.
    normal = torch.where(length > 1e-9, -gradient / length.clamp_min(1e-9), -rays_d)
    return torch.where((normal * rays_d).sum(-1, keepdim=True) > 0, -rays_d, normal)


def _squashed(world: World, x: Tensor, step: Tensor) -> Float[Tensor, "n"]:
    """Opacity of a step's length: unlike density it does not jump by orders of magnitude."""
    return 1 - torch.exp(-world.field.density(x) * step)


def _sum(values: Float[Tensor, "s"], offsets: Int[Tensor, "n+1"]) -> Float[Tensor, "n"]:
    return compositing.accumulate(values.float(), torch.ones(values.shape[0], 1), offsets)[:, 0]
