"""Where snow lands: rays are shot along the fall direction, from the sky into the fitted field.

Snow stays where such a ray first meets matter, so nothing lies under a roof or a table. A ray's
deposit is the point where half of its light is gone: thin floaters and the fuzz of a fitted surface
move it by nothing or by little.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from climatenerf.core.device import to_device, to_numpy
from climatenerf.field.protocol import RadianceField
from climatenerf.weather.parameters import Snow
from climatenerf.weather.snow.lattice import Deposits, SnowGrid
from climatenerf.weather.snow.surface_fit import halfway, smooth_ground

PASSES = 3
"""Fall directions; three, so that no half-sheltered place lies exactly on the threshold."""
SLOPE_BASE = 0.4  # m; a fitted surface is rough, and over less its slopes are those of noise
_FAR = 2  # from this cascade on one direction has to do
JITTER = 0.05
"""Spread of the fall direction, rad."""
_CHUNK = 1 << 14  # rays marched at once
_STRETCH = 100.0  # spacings; a field's steps may grow along a ray, so rays start anew after this
_LUMA = (0.2126, 0.7152, 0.0722)  # Rec. 709


class Light(NamedTuple):
    """The scene's light, as snow sees it."""

    irradiance_over_pi: Float[np.ndarray, "3"]
    """Linear radiance of a white horizontal surface in the open."""
    sun_direction: Float[np.ndarray, "3"] | None
    """Unit vector towards the sun; None (or below the horizon): diffuse light only."""


def fall_directions(snow: Snow, seed: int) -> Float[np.ndarray, "p 3"]:
    """Directions that snow falls along, one for each pass: the wind's tilt, slightly spread.

    Args:
        snow: its fall_tilt and wind_direction (where the wind comes from, clockwise from +y).
        seed: turns the spread.

    Returns:
        Unit vectors pointing down.
    """
    tilt, azimuth = snow.fall_tilt, snow.wind_direction
    away = -np.array([math.sin(azimuth), math.cos(azimuth), 0.0])
    fall = math.sin(tilt) * away - math.cos(tilt) * np.array([0.0, 0.0, 1.0])
    across = np.array([away[1], -away[0], 0.0])
    along = np.cross(across, fall)
    # Evenly on a circle whose spread equals that of a disc of radius JITTER.
    turn = np.random.default_rng(seed).uniform(0, 2 * math.pi)
    angles = turn + 2 * math.pi * np.arange(PASSES) / PASSES
    spread = JITTER / math.sqrt(2)
    directions = fall + spread * (
        np.cos(angles)[:, None] * across + np.sin(angles)[:, None] * along
    )
    # At the largest tilt (80 deg) the spread still leaves every direction downwards.
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
    """Find where snow lands and how bright it is there.

    Args:
        field: the fitted field.
        snow: fall direction, slope, colour; its depth only says from where the sun is looked for.
        grid: where to look.
        light: the scene's light.
        cameras: camera positions, m: the field is asked for colours as seen from the nearest.
        seed: of the fall direction's spread and the rays' offsets.
        progress: called with the share that is done, 0 to 1.
        appearance: exposure and light of the field's colours; None: the mean of all photos.

    Returns:
        The deposits; none where nothing catches snow.
    """
    directions = fall_directions(snow, seed)
    passes = np.array([PASSES if k < _FAR else 1 for k in range(grid.cascades)])
    done, last = 0, int(passes.sum())
    positions: list[np.ndarray] = []
    weights: list[np.ndarray] = []
    shades: list[np.ndarray] = []
    ends = [0]
    for k in range(grid.cascades):
        for p in range(passes[k]):

            def tell(share: float, done: int = done) -> None:
                if progress is not None:
                    progress((done + share) / last)

            random = np.random.default_rng([seed, k, p])
            hits, weight = _land(field, snow, grid, k, directions[p], random, tell)
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


def _land(
    field: RadianceField,
    snow: Snow,
    grid: SnowGrid,
    cascade: int,
    direction: Float[np.ndarray, "3"],
    random: np.random.Generator,
    tell: Callable[[float], None],
) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n"]]:
    """One pass over one cascade: parallel rays on a square grid, one in each cell.

    The grid and the tent of `snow_lattice` make a partition of unity, so level ground receives
    exactly the same everywhere.
    """
    h = grid.spacing_of(cascade)
    half = grid.half_side(cascade) + 3 * h
    bottom, top = grid.z_range
    middle = (bottom + top) / 2
    drift = direction[:2] / -direction[2]  # metres sideways per metre of fall
    # Rays are numbered by where they cross the middle height; those that land in the square at
    # any height cross up to `reach` beside it. The sideways way is cut at the square's side.
    reach = np.minimum(np.abs(drift) * (top - bottom) / 2, half)
    count = np.ceil((2 * (half + reach)) / h).astype(int)
    first = np.array(grid.centre) - half - reach + random.uniform(0, h, 2)
    hits = np.full((count[1], count[0], 3), np.nan, np.float32)
    opacity = np.zeros((count[1], count[0]), np.float32)
    rows = max(1, _CHUNK // count[0])
    inner = grid.half_side(cascade - 1) - 3 * h if cascade > 0 else 0.0
    for row in range(0, count[1], rows):
        j = np.arange(row, min(row + rows, count[1]))
        x = np.broadcast_to(first[0] + np.arange(count[0]) * h, (len(j), count[0]))
        y = np.broadcast_to((first[1] + j * h)[:, None], x.shape)
        crossing = np.stack([x, y], -1)
        begin = crossing - drift * (top - middle)
        wanted = _outside(begin, crossing + drift * (middle - bottom), grid.centre, inner)
        rays_o = np.concatenate([begin[wanted], np.full((int(wanted.sum()), 1), top)], -1)
        length, dark = _first_hits(
            field, rays_o, direction, (top - bottom) / -direction[2], _STRETCH * h, random
        )
        hits[row : row + len(j)][wanted] = rays_o + length[:, None] * direction
        opacity[row : row + len(j)][wanted] = dark
        tell(min(row + rows, count[1]) / count[1])
    # A smoother ground is what the snow lies on: a fitted surface is rough by centimetres.
    base = max(2, round(SLOPE_BASE / h))
    smooth, up = smooth_ground(hits, direction / -direction[2], 0.03 + 0.5 * h, base)
    weight = np.clip((opacity - 0.5) / 0.3, 0, 1)
    steep = snow.slope_sharpness * (up - math.cos(snow.slope))
    weight = weight / (1 + np.exp(-np.clip(steep, -60, 60)))
    away = np.abs(smooth[..., :2] - np.array(grid.centre, np.float32)).max(-1)
    keep = (weight > 1e-3) & (away < half) & (away >= inner)  # NaN: no hit, compares False
    return smooth[keep], weight[keep].astype(np.float32)


def _outside(
    start: Float[np.ndarray, "*n 2"],
    end: Float[np.ndarray, "*n 2"],
    centre: tuple[float, float],
    inner: float,
) -> np.ndarray:
    """Rays with an end outside the inner square (the finer cascade has the others)."""
    if inner <= 0:
        return np.ones(start.shape[:-1], bool)
    away = np.maximum(np.abs(start - np.array(centre)), np.abs(end - np.array(centre)))
    return away.max(-1) >= inner


def _first_hits(
    field: RadianceField,
    rays_o: Float[np.ndarray, "n 3"],
    direction: Float[np.ndarray, "3"],
    length: float,
    stretch: float,
    random: np.random.Generator,
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Ray length at which half of the light is gone (NaN: nowhere), and the opacity.

    A ray is followed in stretches, the first of random length: else the samples of neighbours would
    lie at the same heights, and a gently sloping ground would get steps.
    """
    where = np.full(len(rays_o), np.nan)
    depth = np.zeros(len(rays_o))
    begin = -random.uniform(0, stretch, len(rays_o))
    alive = np.arange(len(rays_o))
    while len(alive):
        start = begin[alive]
        origins = to_device((rays_o[alive] + start[:, None] * direction).astype(np.float32))
        directions = torch.tensor(direction, dtype=torch.float32).expand_as(origins).contiguous()
        t_min = to_device(np.maximum(-start, 0).astype(np.float32))
        t_max = to_device(np.minimum(length - start, stretch).astype(np.float32))
        samples = field.march(origins, directions, t_min, t_max)
        parts = (samples.offsets, samples.t, samples.dt, samples.sigma)
        found = halfway(*(to_numpy(part) for part in parts), depth[alive])
        where[alive] = np.where(np.isnan(found[0]), where[alive], found[0] + start)
        depth[alive] = found[1]
        begin[alive] += stretch
        alive = alive[(found[1] < 7) & (begin[alive] < length)]
    # Rays that begin inside of something (a tower higher than the region) land nowhere.
    where[where < 0.01] = np.nan
    return where, -np.expm1(-depth)


def _shade(
    field: RadianceField,
    snow: Snow,
    hits: Float32[np.ndarray, "n 3"],
    spacing: float,
    light: Light,
    cameras: Float[np.ndarray, "m 3"],
    appearance: Float[Tensor, "1 e"] | None,
) -> Float32[np.ndarray, "n"]:
    """Brightness (g + c0)/(1 + c0) (beta_s V_s + V_s0) of snow on the hits, 0 to 1."""
    if not len(hits):
        return np.zeros(0, np.float32)
    luma = torch.tensor(_LUMA)
    white = max(float(np.dot(light.irradiance_over_pi, _LUMA)), 1e-6)  # 0: g would be 0 / 0
    viewers = torch.tensor(cameras, dtype=torch.float32)
    sun = light.sun_direction
    lift = (snow.depth or 0.0) + max(0.05, spacing)
    lower, upper = field.bounds
    across = float((upper - lower).norm())
    shades = []
    for points in to_device(hits).split(_CHUNK):
        nearest = viewers[torch.cdist(points, viewers).argmin(1)]
        away = points - nearest
        # A camera inside the ground's fuzz would give a direction of length 0.
        d = away / away.norm(dim=-1, keepdim=True).clamp(min=1e-6)
        grey = (field.colour(points, d, appearance=appearance) @ luma / white).clamp(0, 1)
        shade = (grey + snow.albedo_offset) / (1 + snow.albedo_offset)
        visible = torch.ones(len(points))
        if sun is not None and sun[2] > 0:
            above = points + torch.tensor([0.0, 0.0, lift])
            towards = torch.tensor(sun, dtype=torch.float32).expand_as(above).contiguous()
            zero = torch.zeros(len(points))
            samples = field.march(above, towards, zero, zero + across)
            thick = torch.zeros(len(points), dtype=samples.sigma.dtype)
            thick.index_add_(0, samples.ray_index(), (samples.sigma * samples.dt).detach())
            visible = torch.exp(-thick).float()
        shade = shade * (snow.sun_share * visible + snow.shade)
        shades.append(to_numpy(shade.clamp(0, 1).float()))
    return np.concatenate(shades)
