"""Deposition of snow: rays along the fall direction, from the sky into the fitted field.

Snow stays where such a ray first meets a surface, so the ground under a roof or a table stays bare.
The deposit of a ray lies where its transmittance is 1/2. Thin floaters and the blurred density of a
fitted surface shift that point little or not at all.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from climatenerf.core.device import to_device, to_numpy
from climatenerf.core.srgb import LUMA
from climatenerf.field.protocol import RadianceField, device_of
from climatenerf.weather.snow.lattice import Deposits, SnowGrid
from climatenerf.weather.snow.parameters import Snow
from climatenerf.weather.snow.surface_fit import half_transmittance, smooth_ground

PASSES = 3
"""Number of fall directions; three, so that no half-sheltered point is exactly at the threshold."""
SLOPE_BASE = 0.4  # m; a fitted surface is rough, and slopes over a shorter base are noise
_FIRST_SINGLE_PASS = 2  # cascades from this one on use one fall direction
JITTER = 0.05
"""Spread of the fall direction, rad."""
_CHUNK = 1 << 14  # rays per march
_STRETCH = 100.0  # spacings; a field's steps may grow along a ray, so rays restart after this


class Light(NamedTuple):
    """Illumination of the snow."""

    irradiance_over_pi: Float[np.ndarray, "3"]
    """Linear radiance of a white, unoccluded horizontal surface."""
    sun_direction: Float[np.ndarray, "3"] | None
    """Unit vector towards the sun, world frame; None or below the horizon: diffuse light only."""


def fall_directions(snow: Snow, seed: int) -> Float[np.ndarray, "p 3"]:
    """Return the fall direction of each pass: the tilted mean direction plus a small spread.

    Args:
        snow: fall_tilt and wind_direction (where the wind comes from, clockwise from +y), rad.
        seed: random seed of the rotation of the spread.

    Returns:
        Unit vectors that point downwards, world frame.
    """
    tilt, azimuth = snow.fall_tilt, snow.wind_direction
    away = -np.array([math.sin(azimuth), math.cos(azimuth), 0.0])
    fall = math.sin(tilt) * away - math.cos(tilt) * np.array([0.0, 0.0, 1.0])
    across = np.array([away[1], -away[0], 0.0])
    along = np.cross(across, fall)
    # Evenly spaced on a circle with the same variance as a disc of radius JITTER.
    phase = np.random.default_rng(seed).uniform(0, 2 * math.pi)
    angles = phase + 2 * math.pi * np.arange(PASSES) / PASSES
    spread = JITTER / math.sqrt(2)
    directions = fall + spread * (
        np.cos(angles)[:, None] * across + np.sin(angles)[:, None] * along
    )
    # Even at the largest tilt (80 deg) every direction points downwards.
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def find_deposits(
    field: RadianceField,
    snow: Snow,
    grid: SnowGrid,
    light: Light,
    cameras: Float[np.ndarray, "m 3"],
    seed: int,
    progress: Callable[[float], None] | None = None,
    appearance: Float[Tensor, "1 e"] | None = None,
) -> Deposits:
    """Find where snow lands and how bright it is there. World frame, m.

    Args:
        field: the fitted field.
        snow: fall direction, slope and colour. Its depth only sets the height from which shadow
            rays towards the sun start.
        grid: extent and spacing of the search.
        light: illumination of the scene.
        cameras: camera positions, m. Colours of the ground are those seen from the nearest one.
        seed: random seed of the fall directions' spread and of the rays' offsets.
        progress: callback with the finished fraction, 0 to 1.
        appearance: exposure and lighting of the field's colours; None: the mean of all photos.

    Returns:
        The deposits; empty where no surface catches snow.
    """
    directions = fall_directions(snow, seed)
    passes = np.array([PASSES if k < _FIRST_SINGLE_PASS else 1 for k in range(grid.cascades)])
    done, total = 0, int(passes.sum())
    positions: list[np.ndarray] = []
    weights: list[np.ndarray] = []
    shades: list[np.ndarray] = []
    ends = [0]
    for k in range(grid.cascades):
        for p in range(passes[k]):

            def pass_progress(fraction: float, done: int = done) -> None:
                if progress is not None:
                    progress((done + fraction) / total)

            random = np.random.default_rng([seed, k, p])
            hits, weight = _run_pass(field, snow, grid, k, directions[p], random, pass_progress)
            done += 1
            shade = np.full(len(hits), np.nan, np.float32)
            if p == 0:
                shade = _shade(field, snow, hits, grid.spacing_of(k), light, cameras, appearance)
            positions.append(hits)
            weights.append(weight)
            shades.append(shade)
        ends.append(sum(map(len, positions)))
    return Deposits(
        grid,
        np.concatenate(positions),
        np.concatenate(weights),
        np.concatenate(shades),
        np.array(ends, np.int64),
        passes,
    )


def _run_pass(
    field: RadianceField,
    snow: Snow,
    grid: SnowGrid,
    cascade: int,
    direction: Float[np.ndarray, "3"],
    random: np.random.Generator,
    progress: Callable[[float], None],
) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n"]]:
    """Run one pass over one cascade: parallel rays on a square grid, one per cell.

    The tent functions of `snow.lattice` on this grid are a partition of unity, so horizontal ground
    receives exactly the same amount of snow everywhere.

    Returns:
        Deposits (m, world frame) and their weights, 0 to 1.
    """
    h = grid.spacing_of(cascade)
    half = grid.half_side(cascade) + 3 * h
    bottom, top = grid.z_range
    middle = (bottom + top) / 2
    drift = direction[:2] / -direction[2]  # metres sideways per metre of fall
    # Rays are indexed by where they cross the middle height. A ray that lands in the square may
    # cross the middle height up to `margin` outside it; the margin is at most half a side.
    margin = np.minimum(np.abs(drift) * (top - bottom) / 2, half)
    count = np.ceil((2 * (half + margin)) / h).astype(int)
    first = np.array(grid.centre) - half - margin + random.uniform(0, h, 2)
    hits = np.full((count[1], count[0], 3), np.nan, np.float32)
    opacity = np.zeros((count[1], count[0]), np.float32)
    rows, device = max(1, _CHUNK // count[0]), device_of(field)
    inner = grid.half_side(cascade - 1) - 3 * h if cascade > 0 else 0.0
    for row in range(0, count[1], rows):
        j = np.arange(row, min(row + rows, count[1]))
        x = np.broadcast_to(first[0] + np.arange(count[0]) * h, (len(j), count[0]))
        y = np.broadcast_to((first[1] + j * h)[:, None], x.shape)
        crossing = np.stack([x, y], -1)
        start = crossing - drift * (top - middle)
        selected = _leaves_square(start, crossing + drift * (middle - bottom), grid.centre, inner)
        rays_o = np.concatenate([start[selected], np.full((int(selected.sum()), 1), top)], -1)
        length = (top - bottom) / -direction[2]
        hit_t, hit_opacity = _first_hits(
            field, rays_o, direction, length, _STRETCH * h, random, device
        )
        hits[row : row + len(j)][selected] = rays_o + hit_t[:, None] * direction
        opacity[row : row + len(j)][selected] = hit_opacity
        progress(min(row + rows, count[1]) / count[1])
    # Snow lies on a smoothed ground, since a fitted surface is rough by centimetres.
    base = max(2, round(SLOPE_BASE / h))
    smooth, slope_cosine = smooth_ground(hits, direction / -direction[2], 0.03 + 0.5 * h, base)
    weight = np.clip((opacity - 0.5) / 0.3, 0, 1)
    logit = snow.slope_sharpness * (slope_cosine - math.cos(snow.slope))
    weight = weight / (1 + np.exp(-np.clip(logit, -60, 60)))
    offset = np.abs(smooth[..., :2] - np.array(grid.centre, np.float32)).max(-1)
    keep = (weight > 1e-3) & (offset < half) & (offset >= inner)  # no hit: NaN compares False
    return smooth[keep], weight[keep].astype(np.float32)


def _leaves_square(
    start: Float[np.ndarray, "*n 2"],
    end: Float[np.ndarray, "*n 2"],
    centre: tuple[float, float],
    inner: float,
) -> np.ndarray:
    """Return True for rays with an end outside the inner square.

    The finer cascade handles the other rays.
    """
    if inner <= 0:
        return np.ones(start.shape[:-1], bool)
    offset = np.maximum(np.abs(start - np.array(centre)), np.abs(end - np.array(centre)))
    return offset.max(-1) >= inner


def _first_hits(
    field: RadianceField,
    rays_o: Float[np.ndarray, "n 3"],
    direction: Float[np.ndarray, "3"],
    length: float,
    stretch: float,
    random: np.random.Generator,
    device: torch.device,
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Return the ray length of transmittance 1/2 (NaN: never reached) and the opacity.

    Rays are marched in stretches of `stretch` metres, and the first stretch has a random length.
    Otherwise the samples of neighbouring rays would lie at equal heights, and gently sloping ground
    would get steps.
    """
    hit_t = np.full(len(rays_o), np.nan)
    depth = np.zeros(len(rays_o))  # optical depth so far
    next_start = -random.uniform(0, stretch, len(rays_o))
    active = np.arange(len(rays_o))
    heading = torch.tensor(direction, dtype=torch.float32, device=device)
    while len(active):
        start = next_start[active]
        origins = (rays_o[active] + start[:, None] * direction).astype(np.float32)
        origins = to_device(origins, device)
        directions = heading.expand_as(origins).contiguous()
        t_min = to_device(np.maximum(-start, 0).astype(np.float32), device)
        t_max = to_device(np.minimum(length - start, stretch).astype(np.float32), device)
        samples = field.march(origins, directions, t_min, t_max)
        parts = (samples.offsets, samples.t, samples.dt, samples.sigma)
        found_t, found_depth = half_transmittance(
            *(to_numpy(part) for part in parts), depth[active]
        )
        hit_t[active] = np.where(np.isnan(found_t), hit_t[active], found_t + start)
        depth[active] = found_depth
        next_start[active] += stretch
        active = active[(found_depth < 7) & (next_start[active] < length)]
    # A ray that starts inside a solid (a tower higher than the region) has no deposit.
    hit_t[hit_t < 0.01] = np.nan
    return hit_t, -np.expm1(-depth)


def _shade(
    field: RadianceField,
    snow: Snow,
    hits: Float32[np.ndarray, "n 3"],
    spacing: float,
    light: Light,
    cameras: Float[np.ndarray, "m 3"],
    appearance: Float[Tensor, "1 e"] | None,
) -> Float32[np.ndarray, "n"]:
    """Return the brightness (g + c0)/(1 + c0) (beta_s V_s + V_s0) of snow on the hits, 0 to 1.

    g is the ground's luminance relative to a white surface, V_s the visibility of the sun; c0,
    beta_s and V_s0 are `albedo_offset`, `sun_share` and `shade` of the parameters.
    """
    if not len(hits):
        return np.zeros(0, np.float32)
    lower, upper = field.bounds
    device = lower.device
    luma = torch.tensor(LUMA, device=device)
    white = max(float(np.dot(light.irradiance_over_pi, LUMA)), 1e-6)  # black scene: g would be 0/0
    positions = torch.tensor(cameras, dtype=torch.float32, device=device)
    sun = light.sun_direction
    lift = (snow.depth or 0.0) + max(0.05, spacing)
    diagonal = float((upper - lower).norm())
    shades = []
    for points in to_device(hits, device).split(_CHUNK):
        nearest = positions[torch.cdist(points, positions).argmin(1)]
        offset = points - nearest
        # A camera inside the blurred density of the ground would give a direction of length 0.
        d = offset / offset.norm(dim=-1, keepdim=True).clamp(min=1e-6)
        grey = (field.colour(points, d, appearance=appearance) @ luma / white).clamp(0, 1)
        shade = (grey + snow.albedo_offset) / (1 + snow.albedo_offset)
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
        shade = shade * (snow.sun_share * visible + snow.shade)
        shades.append(to_numpy(shade.clamp(0, 1).float()))
    return np.concatenate(shades)
