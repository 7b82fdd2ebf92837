"""Light probes: the light that arrives at the nodes of a grid, gathered once for a scene.

From each probe rays run into all directions. What they meet does not change with the light: which
fraction of the sky they see, and the surface that they end on, with its position, normal and
radiance in the photos. So any new light needs no further rays: the surfaces are lit anew from the
probes around them, which adds one bounce for each repetition (radiosity on probes; compare Majercik
et al. 2019). World axes, m.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from torch import Tensor

from climatenerf.core.classes import GROUND, SOLID_OF
from climatenerf.core.device import to_numpy
from climatenerf.field.capabilities import CLASSES
from climatenerf.field.compositing import chunks, composited
from climatenerf.field.normals import normals_at
from climatenerf.field.protocol import RadianceField
from climatenerf.ops.probes import ProbeGrid
from climatenerf.weather.light.spherical import project, sphere_directions

RAYS = 64  # from each probe
SPACING = (2.0, 2.0, 2.0)  # m
AROUND = 14.0  # m around the cameras, horizontally
MAX_SIDE = 26  # nodes along x and y; a larger place gets wider spacing
HEIGHT = (-0.7, 9.8)  # m from the lowest ground
STEP = 5.0  # marching step of the rays, which blur
NEAR_MATTER = 0.25  # m; a probe with matter so near in most directions lies inside it
INSIDE = 0.5  # fraction of such directions
ABOVE = 0.3  # z of directions; a probe from which most of these meet ground lies below it


@dataclass(frozen=True)
class GatheredLight:
    """What the rays of all probes meet.

    Attributes:
        grid: where the probes are.
        directions: of the rays, the same from each probe.
        through: fraction of the sky's light that arrives.
        radiance: light that surfaces send in the photos, through all samples of a ray.
        x: middle of what a ray meets, world m.
        normal: its normal; 0 where a ray meets nothing.
        ground: whether it is of a class that lies on the ground.
        source: for each probe the one whose light it has: the nearest one above the ground and
            outside matter.
    """

    grid: ProbeGrid
    directions: Float[Tensor, "k 3"]
    through: Float[Tensor, "p k"]
    radiance: Float[Tensor, "p k 3"]
    x: Float[Tensor, "p k 3"]
    normal: Float[Tensor, "p k 3"]
    ground: Bool[Tensor, "p k"]
    source: Int[Tensor, "p"]

    def coefficients(self, arriving: Float[Tensor, "p k 3"]) -> Float[Tensor, "p 9 3"]:
        """Coefficients of the irradiance by the radiance that arrives at the probes."""
        return project(self.directions, arriving)[self.source]


@torch.no_grad()
def gather(
    field: RadianceField,
    middle: Float[Tensor, "3"],
    extent: float,
    lowest: float,
    appearance: Float[Tensor, "1 e"] | None = None,
    progress: Callable[[float], None] | None = None,
) -> GatheredLight:
    """Trace the rays of all probes.

    Args:
        field: without unobserved density.
        middle: of the cameras, world m.
        extent: of the cameras from their middle, horizontally, m.
        lowest: height of the lowest ground, world m.
        appearance: exposure and light of the field's colours.
        progress: called with the fraction that is done.
    """
    device = middle.device
    half = extent + AROUND
    wide = max(SPACING[0], 2 * half / (MAX_SIDE - 1))
    spacing = torch.tensor([wide, wide, SPACING[2]], device=device)
    low = torch.stack([middle[0] - half, middle[1] - half, middle.new_tensor(lowest + HEIGHT[0])])
    high = torch.stack([middle[0] + half, middle[1] + half, middle.new_tensor(lowest + HEIGHT[1])])
    nx, ny, nz = (int(n) + 1 for n in to_numpy(((high - low) / spacing).round()))
    nodes = _nodes(low, spacing, (nx, ny, nz))
    directions = sphere_directions(RAYS).to(device)
    count = nodes.shape[0] * RAYS
    rays_o = nodes.repeat_interleave(RAYS, 0)
    rays_d = directions.repeat(nodes.shape[0], 1)
    through = torch.empty(count, device=device)
    radiance, x, normal = (torch.zeros(count, 3, device=device) for _ in range(3))
    distance = torch.full((count,), torch.inf, device=device)
    ground = torch.zeros(count, dtype=torch.bool, device=device)
    kinds = torch.as_tensor(SOLID_OF[list(GROUND)], device=device)
    for chunk in chunks(rays_o):
        o, d = rays_o[chunk], rays_d[chunk].contiguous()
        start = torch.zeros(len(o), device=device)
        matter, passed, length = composited(
            field, o, d, start, STEP, stop=1e-2, appearance=appearance
        )
        through[chunk], radiance[chunk] = passed, matter
        hit = (passed < 0.9).nonzero()[:, 0]
        t = length[hit] / (1 - passed[hit])
        ends = o[hit] + t[:, None] * d[hit]
        x[chunk.start + hit], distance[chunk.start + hit] = ends, t
        normal[chunk.start + hit], kind = normals_at(field, ends, d[hit])
        if CLASSES in field.capabilities:
            ground[chunk.start + hit] = torch.isin(kind, kinds)
        if progress is not None:
            progress(min(chunk.stop / count, 1.0))
    shape = (nodes.shape[0], RAYS)
    inside = (distance.view(shape) < NEAR_MATTER).float().mean(1) > INSIDE
    # Below the ground a field is arbitrary, and light grows without bound between its undersides.
    above = directions[:, 2] > ABOVE
    under = (ground & (normal[:, 2] < 0)).view(shape)  # normals are turned to the probe
    buried = under[:, above].float().mean(1) > INSIDE
    grid = ProbeGrid(low, spacing, (nx, ny, nz), ~(inside | buried))
    return GatheredLight(
        grid, directions, through.view(shape), radiance.view(*shape, 3), x.view(*shape, 3),
        normal.view(*shape, 3), ground.view(shape), nearest_valid(grid),
    )  # fmt: skip


def nearest_valid(grid: ProbeGrid) -> Int[Tensor, "p"]:
    """Index of the nearest probe outside matter; a probe's own where all lie inside."""
    inside = ~grid.valid.view(grid.shape[::-1]).cpu().numpy()
    if inside.all():
        return torch.arange(inside.size, device=grid.valid.device)
    spacing = grid.spacing.cpu().numpy()[::-1]
    places = ndimage.distance_transform_edt(
        inside, spacing, return_distances=False, return_indices=True
    )
    index = np.ravel_multi_index(tuple(np.asarray(places)), inside.shape).ravel()
    return torch.as_tensor(index, device=grid.valid.device)


def _nodes(
    origin: Float[Tensor, "3"], spacing: Float[Tensor, "3"], shape: tuple[int, int, int]
) -> Float[Tensor, "p 3"]:
    """Positions of all nodes, x fastest, world m."""
    axes = [torch.arange(n, device=origin.device) for n in shape]
    z, y, x = torch.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    return origin + torch.stack([x, y, z], -1).reshape(-1, 3) * spacing
