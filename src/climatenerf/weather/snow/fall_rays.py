"""Rays along the fall direction, from the sky into the fitted field: where each of them ends.

A ray ends where its transmittance is 1/2: thin floaters and the blurred density of a fitted surface
shift that point little or not at all. World frame, m.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32

from climatenerf.core.device import to_device, to_numpy
from climatenerf.field.protocol import RadianceField, device_of
from climatenerf.weather.snow.drift import Shelter
from climatenerf.weather.snow.lattice import SnowGrid
from climatenerf.weather.snow.parameters import Snow
from climatenerf.weather.snow.surface_fit import depth_crossings

PASSES = 3
"""Number of fall directions; three, so that no half-sheltered point is exactly at the threshold."""
SINGLE_PASS = 2
"""Cascades from this one on use one fall direction."""
JITTER = 0.05
"""Spread of the fall direction, rad."""
DEPTHS = (0.3, math.log(2))
"""Optical depths at which fall rays meet leaves and surfaces."""
_CHUNK = 1 << 14  # rays per march
_STRETCH = 100.0  # spacings; a field's steps may grow along a ray, so rays restart after this


@dataclass(frozen=True)
class FallRays:
    """Parallel rays on a square grid, one per cell, over one cascade.

    Attributes:
        direction: in which snow falls, unit vector.
        crossing: where the rays cross the height `middle`, m.
        middle: world z, m.
        leaves: height at which rays meet leaves, if they meet any, m; NaN: they meet nothing.
        surface: height at which they end, m; NaN: nowhere.
        opacity: fraction of light that is lost along each whole ray.
        reached: rays that were traced; the finer cascade handles the others.
    """

    direction: Float[np.ndarray, "3"]
    crossing: Float[np.ndarray, "h w 2"]
    middle: float
    leaves: Float[np.ndarray, "h w"]
    surface: Float[np.ndarray, "h w"]
    opacity: Float32[np.ndarray, "h w"]
    reached: Bool[np.ndarray, "h w"]

    def at(self, z: Float[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w 3"]:
        """Positions of the rays at heights z, m."""
        drift = self.direction[:2] / -self.direction[2]
        xy = self.crossing + drift * (self.middle - z)[..., None]
        return np.concatenate([xy, z[..., None]], -1).astype(np.float32)


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


def cast(
    field: RadianceField,
    grid: SnowGrid,
    cascade: int,
    direction: Float[np.ndarray, "3"],
    random: np.random.Generator,
    progress: Callable[[float], None],
) -> FallRays:
    """Cast the rays of one pass over one cascade."""
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
    crossing = np.stack(
        np.meshgrid(first[0] + np.arange(count[0]) * h, first[1] + np.arange(count[1]) * h), -1
    )
    heights = np.full((count[1], count[0], len(DEPTHS)), np.nan)
    opacity = np.zeros((count[1], count[0]), np.float32)
    reached = np.zeros(opacity.shape, bool)
    rows, device = max(1, _CHUNK // count[0]), device_of(field)
    inner = inner_side(grid, cascade)
    for row in range(0, count[1], rows):
        part = slice(row, row + rows)
        start = crossing[part] - drift * (top - middle)
        end = crossing[part] + drift * (middle - bottom)
        selected = _leaves_square(start, end, grid.centre, inner)
        rays_o = np.concatenate([start[selected], np.full((int(selected.sum()), 1), top)], -1)
        length = (top - bottom) / -direction[2]
        hit_t, hit_opacity = _first_hits(
            field, rays_o, direction, length, _STRETCH * h, random, device
        )
        heights[part][selected] = top + hit_t * direction[2]
        opacity[part][selected] = hit_opacity
        reached[part] = selected
        progress(min(row + rows, count[1]) / count[1])
    leaves, surface = heights[..., 0], heights[..., 1]
    return FallRays(direction, crossing, middle, leaves, surface, opacity, reached)


def trace_shelter(
    field: RadianceField, grid: SnowGrid, half_side: float, spacing: float, seed: int
) -> Shelter:
    """Trace the height map of a square around the grid's centre by vertical rays.

    Args:
        field: the fitted field.
        grid: where snow is simulated.
        half_side: of the square, m.
        spacing: of the rays, m.
        seed: of the first samples' offset.
    """
    random = np.random.default_rng(seed)
    bottom, top = grid.z_range
    nodes = np.arange(-half_side, half_side, spacing)
    x, y = np.meshgrid(grid.centre[0] + nodes, grid.centre[1] + nodes)
    rays_o = np.stack([x, y, np.full_like(x, top)], -1)
    down = np.array([0.0, 0.0, -1.0])
    height = np.full(x.shape, np.nan)
    rows = max(1, _CHUNK // len(nodes))
    for row in range(0, len(nodes), rows):
        part = rays_o[row : row + rows].reshape(-1, 3)
        t, _ = _first_hits(
            field, part, down, top - bottom, _STRETCH * spacing, random, device_of(field)
        )
        height[row : row + rows] = (top - t[:, 1]).reshape(-1, len(nodes))
    return Shelter(height, (float(x[0, 0]), float(y[0, 0])), spacing)


def inner_side(grid: SnowGrid, cascade: int) -> float:
    """Half the side of the square that the next finer cascade covers, with some overlap, m."""
    return grid.half_side(cascade - 1) - 3 * grid.spacing_of(cascade) if cascade > 0 else 0.0


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
) -> tuple[Float[np.ndarray, "n k"], Float[np.ndarray, "n"]]:
    """Return the ray lengths at which optical depth reaches `DEPTHS` (NaN: never), and opacity.

    Rays are marched in stretches of `stretch` metres, and the first stretch has a random length.
    Otherwise the samples of neighbouring rays would lie at equal heights, and gently sloping ground
    would get steps.
    """
    hit_t = np.full((len(rays_o), len(DEPTHS)), np.nan)
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
        found_t, found_depth = depth_crossings(
            *(to_numpy(part) for part in parts), depth[active], np.array(DEPTHS)
        )
        missing = np.isnan(found_t)
        hit_t[active] = np.where(missing, hit_t[active], found_t + start[:, None])
        depth[active] = found_depth
        next_start[active] += stretch
        active = active[(found_depth < 7) & (next_start[active] < length)]
    # A ray that starts inside a solid (a tower higher than the region) has no deposit.
    hit_t[hit_t < 0.01] = np.nan
    return hit_t, -np.expm1(-depth)
