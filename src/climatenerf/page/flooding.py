"""From which water level on a pixel is under water, as the renderer has it.

The height of what a pixel shows tells it to a few millimetres. On a flat road these are many
pixels: the renderer softens the waterline, and takes it from the terrain where ground is rough. So
the fraction of each pixel that lies behind the water is found at levels around that height.
"""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.core.device import to_device, to_numpy
from climatenerf.field.compositing import RENDER_STEP
from climatenerf.field.protocol import device_of
from climatenerf.ops import compositing
from climatenerf.page.views import PageView
from climatenerf.render.frame import traced_rays
from climatenerf.render.measurements import total
from climatenerf.render.merging import merged_samples
from climatenerf.render.session import RenderSession
from climatenerf.weather.weather import Weather
from climatenerf.weather.world import RaySamples, World

CHUNK = 8192  # rays of nearly equal height
SPACING = 0.005  # m, of levels within the heights of a chunk
BETWEEN = 5, 24  # least and greatest number of them
AROUND = np.array([0.002, 0.005, 0.01, 0.02, 0.05, 0.2])  # m, of levels beyond them
PARTIAL = 0.02  # fraction of a pixel from which the waterline passes through it
WET = 0.5  # fraction of a pixel from which it counts as water

WaterAt = Callable[[float], Weather]
"""Gives the weather with water at a level, m above the ground datum."""


def flooding_levels(
    session: RenderSession,
    view: PageView,
    heights: Float[np.ndarray, "h w"],
    water_at: WaterAt,
    highest: float,
) -> Float[np.ndarray, "h w"]:
    """Return the water level from which each pixel is under water, m above the ground datum.

    Args:
        session: of the place.
        view: camera and pose.
        heights: of what the pixels show, m above the datum; infinite ones stay.
        water_at: gives the weather at a level.
        highest: level up to which it matters, m.
    """
    device = device_of(session.field)
    rays_o, rays_d, angle = traced_rays(view.camera, view.c2w, device)
    flat = heights.reshape(-1)
    down = to_numpy(rays_d[:, 2]) < 0
    asked = np.flatnonzero(np.isfinite(flat) & down & (flat < highest + AROUND[-1]))
    asked = asked[np.argsort(flat[asked], kind="stable")]
    found = flat.copy()
    for begin in range(0, len(asked), CHUNK):
        rays = asked[begin : begin + CHUNK]
        z = flat[rays]
        levels = _levels(z, highest)
        index = to_device(rays, device)
        given = rays_o[index], rays_d[index], angle[index]
        fractions = _fractions(session, water_at, levels, given)
        found[rays] = _crossing(levels, fractions, z)
    return found.reshape(heights.shape)


def _levels(z: Float[np.ndarray, "n"], highest: float) -> Float[np.ndarray, "k"]:
    """Levels at which fractions are computed, for rays that end at these heights (m, ascending).

    None lies above the highest level of the page, beyond which water may drown a camera.
    """
    count = int(np.clip((z[-1] - z[0]) / SPACING, *BETWEEN))
    inner = np.linspace(z[0], z[-1], count)
    around = np.concatenate([z[0] - AROUND, inner, z[-1] + AROUND, [highest - AROUND[0]]])
    return np.unique(np.minimum(around, highest))


@torch.no_grad()
def _fractions(
    session: RenderSession,
    water_at: WaterAt,
    levels: Float[np.ndarray, "k"],
    rays: tuple[Tensor, Tensor, Tensor],
) -> Float[np.ndarray, "k n"]:
    """Fraction of each ray's light that comes from behind the water, at each level."""
    rays_o, rays_d, angle = rays
    dry = World(session.field)
    start = torch.full_like(angle, session.field.near)
    samples, _ = merged_samples(dry, rays_o, rays_d, start, RENDER_STEP)
    weights, left = compositing.render_weights(samples.sigma * samples.dt, samples.offsets)
    along = RaySamples(samples, samples.ray_index(), weights)
    found = []
    for level in levels:
        session.change(water_at(float(level)))
        world = session.world(0.0)
        (water,) = world.surfaces
        t = water.distance(rays_o, rays_d, angle)
        behind = water.fraction_behind(world, along, rays_o, rays_d, t, angle)
        found.append(to_numpy(total(weights * behind, samples.offsets) + left * t.isfinite()))
    return np.stack(found)


def _crossing(
    levels: Float[np.ndarray, "k"], fractions: Float[np.ndarray, "k n"], z: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n"]:
    """Level at which the fraction of a pixel passes one half, near the height z of what it shows.

    Between two levels it is interpolated if the waterline passes through the pixel at one of them;
    else it is the level nearest to z.
    """
    wet = fractions > WET
    first = np.where(wet.any(0), wet.argmax(0), len(levels))
    ray = np.arange(fractions.shape[1])
    upper = np.clip(first, 1, len(levels) - 1)
    low, high = levels[upper - 1], levels[upper]
    below, above = fractions[upper - 1, ray], fractions[upper, ray]
    share = np.clip((WET - below) / np.maximum(above - below, 1e-6), 0.0, 1.0)  # 1e-6: 0/0
    partial = (below > PARTIAL) | (above < 1 - PARTIAL)
    level = np.where(partial, low + share * (high - low), np.clip(z, low, high))
    level = np.where(
        first == 0, z - AROUND[-1], np.where(first == len(levels), z + AROUND[-1], level)
    )
    level = np.clip(level, z - AROUND[-1], z + AROUND[-1])
    return np.where(first == len(levels), np.maximum(z, levels[-1] + AROUND[0]), level)
