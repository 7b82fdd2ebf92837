"""Deposition of snow: what catches it below each ray along the fall direction.

Snow stays where such a ray first meets a surface, so the ground under a roof or a table stays bare.
Crowns hold a part of the snow and let the rest through.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int
from scipy import ndimage

from climatenerf.core.classes import GROUND, SOLID_OF, VEGETATION
from climatenerf.core.device import to_device, to_numpy
from climatenerf.field.capabilities import CLASSES, NORMALS
from climatenerf.field.normals import normals_at
from climatenerf.field.protocol import RadianceField, device_of, ground_height
from climatenerf.weather.snow.cover import (
    WALL,
    Eaves,
    bridged,
    cushions,
    eaves,
    ground_share,
    lumps,
    mean_within,
    slope_share,
)
from climatenerf.weather.snow.drift import REACH, Shelter, drifted
from climatenerf.weather.snow.fall_rays import (
    PASSES,
    SINGLE_PASS,
    FallRays,
    cast,
    fall_directions,
    inner_side,
    trace_shelter,
)
from climatenerf.weather.snow.lattice import SHADE_UNIT, Catch, Deposits, SnowGrid
from climatenerf.weather.snow.openness import contact_shade
from climatenerf.weather.snow.parameters import Snow
from climatenerf.weather.snow.sliding import PACKED, slid
from climatenerf.weather.snow.surface_fit import smooth_ground

LEAF = int(SOLID_OF[VEGETATION])
GROUND_KINDS = SOLID_OF[list(GROUND)]
AROUND = 0.15  # m, standard deviation of what counts as around a node
MANY_LEAVES = 0.5  # over the solid nodes around, from which on these count as leaves
ONE_PLANT = 1.5  # m between the leaves around and what counts as one of them
UNDERGROWTH = 0.3  # m above the ground; lower leaves carry snow as grass does
STEPS = 8  # towards the ground below a slanted ray
SLANTED = np.cos(np.radians(10.0))  # downward part of a slanted fall's direction, at most
ASTRAY = 0.2  # m between field and terrain, from which the terrain carries the snow
SLOPE_BASE, SLOPE_CELLS = 0.4, 8  # m and cells; slopes over a shorter base are noise
ROOF_SMOOTHING, ROOF_PASSES = 0.3, 6  # m and passes; fitted roofs are planes with roughness
BETWEEN_LEAVES = 0.026  # m of snow that open or steep crowns take before any bridges their leaves
SHELTER_SPACING, SHELTER_CELLS = 0.15, 3  # m and cells, at least, of what stands in the wind
CASTING = 0.6  # of the time of a pass, that of its rays
_CHUNK = 1 << 14  # positions per evaluation


class Light(NamedTuple):
    """Illumination of the snow."""

    irradiance_over_pi: Float[np.ndarray, "3"]
    """Linear radiance of a white, unoccluded horizontal surface."""
    sun_direction: Float[np.ndarray, "3"] | None
    """Unit vector towards the sun, world frame; None or below the horizon: diffuse light only."""
    sunlit: Callable[[np.ndarray], np.ndarray] | None = None
    """Fraction of the sun at positions [n, 3] (world m), NaN where unknown; None: by geometry."""


def find_deposits(
    field: RadianceField,
    snow: Snow,
    grid: SnowGrid,
    light: Light,
    seed: int,
    progress: Callable[[float], None] | None = None,
) -> Deposits:
    """Find where snow lands and how it is shaded there. World frame, m.

    Args:
        field: the fitted field.
        snow: fall direction and slope. Its depth only sets the height from which the paper's
            shadow rays towards the sun start.
        grid: extent and spacing of the search.
        light: illumination of the scene.
        seed: random seed of the fall directions' spread and of the rays' offsets.
        progress: callback with the finished fraction, 0 to 1.

    Returns:
        The deposits; empty where no surface catches snow.
    """
    directions = fall_directions(snow, seed)
    passes = np.array([PASSES if k < SINGLE_PASS else 1 for k in range(grid.cascades)])
    done, total = 0, int(passes.sum())
    cascades: list[tuple[Catch, ...]] = []
    for k in range(grid.cascades):
        catches: list[Catch] = []
        shelter = None
        if snow.drift > 0:
            step = max(SHELTER_SPACING, SHELTER_CELLS * grid.spacing_of(k))
            shelter = trace_shelter(field, grid, grid.half_side(k) + REACH, step, seed)
        for p in range(passes[k]):

            def pass_progress(fraction: float, done: int = done) -> None:
                if progress is not None:
                    progress((done + CASTING * fraction) / total)

            random = np.random.default_rng([seed, k, p])
            rays = cast(field, grid, k, directions[p], random, pass_progress)
            found = _caught(field, snow, grid, k, rays, shelter)
            done += 1
            if p == 0 and snow.light == "paper":
                found = [
                    replace(each, shade=_in_sun(field, snow, each, grid.spacing_of(k), light))
                    for each in found
                ]
            elif p == 0 and k < SINGLE_PASS:
                found[0] = _in_contact_shade(field, found[0], grid.spacing_of(k))
            if progress is not None:
                progress(done / total)
            catches += found
        cascades.append(tuple(catches))
    return Deposits(grid, tuple(cascades), passes)


def _caught(
    field: RadianceField,
    snow: Snow,
    grid: SnowGrid,
    cascade: int,
    rays: FallRays,
    shelter: Shelter | None,
) -> list[Catch]:
    """What catches the snow of one pass over one cascade: surfaces, and crowns above them if any.

    The tent functions of `snow.lattice` on the rays' grid are a partition of unity, so level ground
    receives exactly the same amount of snow everywhere. Without `shelter` there are no drifts.
    """
    h = grid.spacing_of(cascade)
    normal_z, kind = _seen_from_above(field, rays)
    ground = _ground_below(field, rays)
    kind = np.where(among_leaves(rays.surface, kind, h), LEAF, kind)
    surface, leaves = surfaces_and_leaves(rays.surface, kind, ground)
    on_ground = np.isin(kind, GROUND_KINDS) | (surface == ground)
    surface = bridged(surface, on_ground, rays.reached, h)
    crown = cushions(np.where(np.isfinite(leaves), rays.leaves, np.nan), h)
    # Snow lies on a smoothed ground, since a fitted surface is rough by centimetres.
    # Far ground is rougher in the field: its slopes are measured over more metres.
    base = max(SLOPE_CELLS, round(SLOPE_BASE / h))
    fall = rays.direction / -rays.direction[2]
    tolerance = 0.03 + 0.5 * h
    smooth, cosine = smooth_ground(rays.at(surface), fall, tolerance, base)
    own = surface == rays.surface  # NaN compares False: elsewhere the terrain stands in
    # Learned normals are more accurate at edges and on curved surfaces than heights on a raster. On
    # the ground and on grass they are those of each clump.
    low = on_ground | (surface < ground + UNDERGROWTH)  # NaN compares False
    learned = own & np.isfinite(normal_z) & ~low
    cosine = np.where(learned, normal_z, cosine)
    # At the border of what is known the median is not that of nothing, which is 0.
    cosine = np.where(np.isfinite(surface), cosine, ndimage.maximum_filter(cosine, 5))
    cosine = ndimage.median_filter(cosine, 5)
    share = np.where(low, ground_share(cosine, snow), slope_share(cosine, snow))
    share = np.where(np.isfinite(surface), share, 0.0)
    wall = cosine < WALL
    # In slanted snow walls are slopes of the raster as well; none of them is a roof.
    upright = -rays.direction[2] > SLANTED
    edges = eaves(surface, own & ~on_ground & ~wall & upright, h)
    if edges.inside.any():
        share = _even_on_roofs(share, edges, h)
        roofs = edges.inside | edges.rim
        for _ in range(ROOF_PASSES):
            smooth[roofs] = smooth_ground(smooth, fall, tolerance, base)[0][roofs]
    # What hits a wall falls with the rest: slanted rays that a wall stops must not pile up there,
    # nor at its foot, which is a bend of the raster since slopes are measured over `base` nodes.
    stops = wall if upright else ndimage.binary_dilation(wall, iterations=base // 2)
    lost = np.where(stops, 0.0, 1 - share)
    arrived = PACKED * slid(lost, share, smooth[..., 2].astype(np.float64), h)
    moved = np.ones(share.shape)
    if shelter is not None:
        moved = drifted(smooth, shelter, snow.drift, snow.wind_direction, h)
    caught = crown.keeps * np.clip(rays.opacity, 0, 1)
    weight = np.where(own, np.clip((rays.opacity - 0.5) / 0.1, 0, 1), 1.0)  # the terrain is whole
    catches = [_catch(smooth, moved * share + arrived, -share * caught, 0 * share, weight)]
    over = np.isfinite(edges.overhang)
    if over.any():
        part = np.where(over, (moved * share)[edges.nearest], 0.0)
        added = _catch(rays.at(edges.overhang), part, 0 * part, 0 * part, over.astype(np.float64))
        catches.append(replace(added, overhangs=True))
    if caught.any():
        position = rays.at(crown.height)
        gaps = BETWEEN_LEAVES * (1 - crown.keeps)
        cap = _catch(position, 0 * caught, caught, gaps, (caught > 0).astype(np.float64))
        if snow.light == "scene":  # in the light of its place, as the probes see it
            cap = replace(cap, shade=np.full_like(cap.shade, SHADE_UNIT))
        catches.append(cap)
    half, inner = grid.half_side(cascade) + 3 * h, inner_side(grid, cascade)
    kept = []
    for each in catches:
        offset = np.abs(each.position[..., :2] - np.array(grid.centre, np.float32)).max(-1)
        inside = (offset < half) & (offset >= inner)  # NaN compares False
        kept.append(replace(each, weight=each.weight * inside))
    return kept


def _even_on_roofs(
    share: Float[np.ndarray, "h w"], edges: Eaves, spacing: float
) -> Float[np.ndarray, "h w"]:
    """Shares that roofs keep, without their roughness, and continued to their rims."""
    roofs = edges.inside | edges.rim
    share = np.where(edges.rim, np.maximum(share, share[edges.nearest]), share)
    return np.where(roofs, mean_within(share, roofs, ROOF_SMOOTHING / spacing), share)


def _catch(
    position: Float32[np.ndarray, "h w 3"],
    of_fall: Float[np.ndarray, "h w"],
    of_held: Float[np.ndarray, "h w"],
    hidden: Float[np.ndarray, "h w"],
    weight: Float[np.ndarray, "h w"],
) -> Catch:
    weight = np.where(np.isfinite(position[..., 2]) & (weight > 1e-3), weight, 0.0)
    shade = np.full(weight.shape, np.nan, np.float32)
    single = np.float32
    parts = of_fall.astype(single), of_held.astype(single), hidden.astype(single)
    return Catch(position, *parts, weight.astype(single), shade)


def among_leaves(
    height: Float[np.ndarray, "h w"], kind: Int[np.ndarray, "h w"], spacing: float
) -> Bool[np.ndarray, "h w"]:
    """Where ends of rays count as leaves, whatever their class, since they lie among leaves.

    The classes of fitted foliage are noisy, and each solid node would carry all the snow that falls
    on it: foliage would be full of white lumps. A node counts as a leaf if it lies about as high as
    the leaves around, and these are more than half as many as other solid nodes, or more than those
    of the ground: ground between stems is more often right.

    Args:
        height: world z at which fall rays end, m; NaN without an end.
        kind: class there, as an index in `core.classes.SOLID`; -1: unknown, which is solid.
        spacing: of the raster, m.
    """
    sigma = max(AROUND / spacing, 1.0)  # neighbours of a coarse raster count, too

    def around(values: np.ndarray) -> Float[np.ndarray, "h w"]:
        return ndimage.gaussian_filter(values.astype(np.float64), sigma)

    leaf, hit = kind == LEAF, np.isfinite(height)
    leaves = around(leaf & hit)
    # Without leaves 0/0; 1e-6 of them are none.
    middle = around(np.where(leaf & hit, height, 0.0)) / np.maximum(leaves, 1e-6)
    level = np.abs(height - middle) < ONE_PLANT  # NaN compares False
    ground = np.isin(kind, GROUND_KINDS)
    other = hit & ~leaf & ~ground
    wrong_ground = ground & (leaves > around(ground))
    return level & (wrong_ground | (other & (leaves > MANY_LEAVES * around(other))))


def surfaces_and_leaves(
    height: Float[np.ndarray, "h w"], kind: Int[np.ndarray, "h w"], ground: Float[np.ndarray, "h w"]
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Separate leaves from what lies below, and put the terrain where the field has veils or holes.

    Args:
        height: world z at which fall rays end, m; NaN without an end.
        kind: class there, as an index in `core.classes.SOLID`; -1: unknown, which is solid.
        ground: height of the terrain, m; NaN where it is unknown.

    Returns:
        Heights of solid surfaces and of leaves, m; NaN without one.
    """
    low = height < ground + UNDERGROWTH  # NaN compares False
    leaf = (kind == LEAF) & ~low
    surface = np.where(leaf, np.nan, height)
    astray = lumps(surface, np.isin(kind, GROUND_KINDS), ground, ASTRAY)
    surface = np.where((astray | leaf) & np.isfinite(ground), ground, surface)
    return surface, np.where(leaf, height, np.nan)


def _ground_below(field: RadianceField, rays: FallRays) -> Float[np.ndarray, "h w"]:
    """Height of the terrain below the ends of fall rays, m; NaN where it is unknown."""
    hit = np.isfinite(rays.surface)
    usual = np.median(rays.surface[hit]) if hit.any() else 0.0
    start = np.where(hit, rays.surface, usual)
    ground, before = np.full(start.shape, np.nan), start
    for _ in range(STEPS):  # a slanted ray shifts between its end and the ground below
        before = start
        xy = to_device(rays.at(start)[..., :2].reshape(-1, 2), device_of(field))
        ground = to_numpy(ground_height(field, xy)).reshape(start.shape).astype(np.float64)
        start = np.where(np.isfinite(ground), ground, start)
    # On ground as steep as the rays the steps do not converge.
    ground[~rays.reached | (np.abs(start - before) > 0.05)] = np.nan
    return ground


def _seen_from_above(
    field: RadianceField, rays: FallRays
) -> tuple[Float[np.ndarray, "h w"], Int[np.ndarray, "h w"]]:
    """The normals' z and the classes (indices in `core.classes.SOLID`) where fall rays end.

    NaN and -1 where they do not, and where the field has learned none.
    """
    hit = np.isfinite(rays.surface)
    normal_z, kind = np.full(hit.shape, np.nan), np.full(hit.shape, -1)
    if not field.capabilities & {NORMALS, CLASSES} or not hit.any():
        return normal_z, kind
    device = device_of(field)
    d = to_device(rays.direction.astype(np.float32), device)
    parts = []
    for points in to_device(rays.at(rays.surface)[hit], device).split(_CHUNK):
        parts.append(normals_at(field, points, d.expand_as(points).contiguous()))
    if NORMALS in field.capabilities:
        normal_z[hit] = np.concatenate([to_numpy(normal[:, 2]) for normal, _ in parts])
    if CLASSES in field.capabilities:
        kind[hit] = np.concatenate([to_numpy(each) for _, each in parts])
    return normal_z, kind


def _in_contact_shade(field: RadianceField, catch: Catch, spacing: float) -> Catch:
    """The same with the share of light that what stands close by leaves, in `SHADE_UNIT`."""
    lift = max(0.1, 2 * spacing)  # for any depth, since deposits serve all depths
    shade = contact_shade(field, catch.position, catch.weight > 0, spacing, lift)
    return replace(catch, shade=np.clip(shade * SHADE_UNIT, 0, 1))


def _in_sun(
    field: RadianceField, snow: Snow, catch: Catch, spacing: float, light: Light
) -> Float32[np.ndarray, "h w"]:
    """Return the light beta_s V_s + V_s0 of the paper's snow, 0 to 1.

    V_s is the visibility of the sun; beta_s and V_s0 are `sun_share` and `shade` of the parameters.
    """
    used = catch.weight > 0
    hits = catch.position[used]
    if not len(hits):
        return catch.shade
    lower, upper = field.bounds
    device = lower.device
    sun = light.sun_direction
    lift = (snow.depth or 0.0) + max(0.05, spacing)
    diagonal = float((upper - lower).norm())
    parts = []
    for points in to_device(hits, device).split(_CHUNK):
        visible = torch.ones(len(points), device=device)
        if sun is not None and sun[2] > 0:
            above = points + torch.tensor([0.0, 0.0, lift], device=device)
            towards = torch.tensor(sun, dtype=torch.float32, device=device)
            towards = towards.expand_as(above).contiguous()
            zero = torch.zeros(len(points), device=device)
            samples = field.march(above, towards, zero, zero + diagonal)
            sun_depth = samples.sigma.new_zeros(len(points))
            sun_depth.index_add_(0, samples.ray_index(), (samples.sigma * samples.dt).detach())
            visible = torch.exp(-sun_depth).float()
        if light.sunlit is not None:
            photographed = light.sunlit(to_numpy(points).astype(np.float64)).astype(np.float32)
            found = to_device(photographed, device)
            visible = torch.where(found.isnan(), visible, found)
        parts.append(to_numpy((snow.sun_share * visible + snow.shade).clamp(0, 1).float()))
    shade = catch.shade.copy()
    shade[used] = np.concatenate(parts)
    return shade
