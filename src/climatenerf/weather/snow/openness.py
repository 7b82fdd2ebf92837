"""Contact shade: how much less light reaches snow close to walls and hedges than around there.

Light probes stand metres apart. What they miss is found by short rays from the snow itself, and
kept as a factor on the probes' irradiance, so that nothing is counted twice.
"""

import math

import numpy as np
import torch
from jaxtyping import Float, Float32
from scipy import ndimage
from torch import Tensor

from climatenerf.core.classes import SOLID_OF, VEGETATION
from climatenerf.core.device import to_device, to_numpy
from climatenerf.field.capabilities import CLASSES
from climatenerf.field.normals import normals_at
from climatenerf.field.protocol import RadianceField, device_of, ground_height
from climatenerf.weather.snow.surface_fit import depth_crossings

LEAF = int(SOLID_OF[VEGETATION])
RAYS = 12  # from each node
ENDS = 0.3  # optical depth at which what hides the sky is looked at; thin foliage counts
REACH = 3.0  # m
NODE = 0.18  # m between nodes
PROBES = 0.8  # m, standard deviation of how probes 2 m apart blur the light
PROBE_HEIGHT = 1.0  # m above the ground, at which they find it on average
COARSER = 2  # nodes from one place to the next, at which light is looked for up there
REFLECTED = 0.35  # reflectance of what stands around
LEAFY = 0.08  # that of leaves, which shade each other
SNOWY = 0.9  # that of ground, which carries the same snow
ON_GROUND = 0.12  # m above the terrain, up to which a ray ends on the ground
DARKEST = 0.05  # openness; less is inside of matter
INSIDE = 0.15  # light; less is found inside of matter alone
MIN_RATIO = 0.2  # of that ratio; less comes from rays that start inside of matter
CHUNK = 1 << 16


def contact_shade(
    field: RadianceField,
    position: Float32[np.ndarray, "h w 3"],
    used: np.ndarray,
    spacing: float,
    lift: float,
) -> Float32[np.ndarray, "h w"]:
    """Irradiance of level snow over that around it, at most 1; NaN where nothing is known.

    With an openness A (the fraction of diffuse light from above that arrives) and surroundings of
    reflectance r the light is A/(1 - r (1 - A)), which is exact in a round hollow. What ground
    hides is snow: hollows of the ground stay nearly as bright as the open.

    Args:
        field: the fitted field.
        position: what the snow lies on, world m.
        used: [h w] bool, where snow lies.
        spacing: of the raster, m.
        lift: height over `position` at which rays start, m.
    """
    step = max(1, round(NODE / spacing))
    rows, columns = used.shape
    coarse = used[::step, ::step]
    points = position[::step, ::step][coarse]
    found = np.full(used.shape, np.nan, np.float32)
    if not len(points):
        return found
    light = _light(field, points + np.array([0, 0, lift], np.float32))
    # As the probes have it, which stand higher and in the open.
    above = np.zeros(coarse.shape, bool)
    above[::COARSER, ::COARSER] = coarse[::COARSER, ::COARSER]
    higher = position[::step, ::step][above] + np.array([0, 0, PROBE_HEIGHT], np.float32)
    raster, weight = np.zeros(coarse.shape), np.zeros(coarse.shape)
    raster[above] = _light(field, higher)
    weight[above] = raster[above] > INSIDE
    sigma = PROBES / (spacing * step)
    weight_near = ndimage.gaussian_filter(weight, sigma)
    around = ndimage.gaussian_filter(raster * weight, sigma) / np.maximum(weight_near, 1e-9)
    own = np.zeros(coarse.shape)
    own[coarse] = light
    # Where no node is near nothing is used.
    ratio = np.where(coarse, np.clip(own / np.maximum(around, INSIDE), MIN_RATIO, 1), 1.0)
    # Between nodes: linear, over nodes with snow alone.
    at = np.mgrid[:rows, :columns] / step
    held = coarse.astype(np.float64)
    kernel: np.ndarray = ndimage.map_coordinates(held, at, order=1, mode="nearest")
    full: np.ndarray = ndimage.map_coordinates(ratio * coarse, at, order=1, mode="nearest")
    known = used & (kernel > 1e-3)
    found[known] = full[known] / kernel[known]
    return found


def _light(field: RadianceField, x: Float32[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Light that reaches level surfaces of snow among matter, over that in the open."""
    openness, returned = openness_of(field, x)
    return openness / (1 - returned)


@torch.no_grad()
def openness_of(
    field: RadianceField, x: Float32[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Openness of level surfaces to even light from above, and what the rest returns.

    Args:
        field: the fitted field.
        x: positions, world m. What is further away than `REACH` does not count.

    Returns:
        The fraction that arrives, `DARKEST` at least, and the hidden fraction times the
        reflectance of the matter there.
    """
    device = device_of(field)
    directions = to_device(cosine_directions(RAYS), device)
    total, returned = np.zeros(len(x)), np.zeros(len(x))
    places = to_device(np.ascontiguousarray(x, np.float32), device)
    for first in range(0, len(x), CHUNK // RAYS):
        part = places[first : first + CHUNK // RAYS]
        rays_o = part.repeat_interleave(RAYS, 0)
        rays_d = directions.repeat(len(part), 1)
        zero = torch.zeros(len(rays_o), device=device)
        samples = field.march(rays_o, rays_d, zero, zero + REACH, 2.0, stop=1e-2)
        ends, depth = depth_crossings(
            to_numpy(samples.offsets),
            to_numpy(samples.t),
            to_numpy(samples.dt),
            to_numpy(samples.sigma),
            np.zeros(len(rays_o)),
            np.array([ENDS]),
        )
        # NaN where a ray goes on.
        end = rays_o + to_device(ends.astype(np.float32), device) * rays_d
        stopped = -np.expm1(-depth)
        back = stopped * to_numpy(_reflectance(field, end, rays_d))
        total[first : first + len(part)] = 1 - stopped.reshape(-1, RAYS).mean(1)
        returned[first : first + len(part)] = back.reshape(-1, RAYS).mean(1)
    return np.maximum(total, DARKEST), returned


def _reflectance(
    field: RadianceField, end: Float[Tensor, "n 3"], d: Float[Tensor, "n 3"]
) -> Float[Tensor, "n"]:
    """Reflectance of what rays of directions d end on; `REFLECTED` where they do not (NaN)."""
    found = torch.full_like(end[:, 2], REFLECTED)
    ends = (~end[:, 2].isnan()).nonzero()[:, 0]
    if CLASSES in field.capabilities:
        _, kind = normals_at(field, end[ends], d[ends])
        found[ends[kind == LEAF]] = LEAFY
    low = end[ends, 2] < ground_height(field, end[ends, :2]) + ON_GROUND  # NaN compares False
    found[ends[low]] = SNOWY
    return found


def cosine_directions(count: int) -> Float32[np.ndarray, "n 3"]:
    """Directions above the horizon, as dense as the cosine to the vertical (a golden spiral)."""
    k = np.arange(count) + 0.5
    radius, turn = np.sqrt(k / count), k * math.pi * (3 - math.sqrt(5))
    up = np.sqrt(1 - radius * radius)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), up], -1).astype(np.float32)
