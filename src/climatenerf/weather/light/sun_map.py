"""Where the sun shines: the transmittance of the field along rays from the sun, as maps.

A map is an orthographic picture from the sun (Williams 1978), two of them nested: one fine around
the cameras, one four times as wide. Each texel has the depths at which the field lets three
quarters and one quarter of the light pass: half of it is left behind the first, so leaves give
partial shade. Between texels visibility is bilinear.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.core.device import to_device
from climatenerf.field.compositing import chunks
from climatenerf.field.protocol import RadianceField, device_of
from climatenerf.ops import relighting

TEXELS = 768  # along a side of a map
FINE, COARSE = 20.0, 80.0  # m, half sides of the maps across the sun's rays
ABOVE = 25.0  # m above the middle of the scene; higher matter casts no shadow
BIAS = 0.12  # m by which a surface lies behind the light's last shelter: its density is blurred
PIECE = 20.0  # m; the steps of a field may grow along a ray, so rays restart after this
OPAQUE = 3.0  # optical depth at which a ray from the sun ends
PARTS = (0.28768207, 1.38629436)  # optical depths of transmittance 3/4 and 1/4


@dataclass(frozen=True)
class SunMap:
    """Visibility of the sun in a field.

    Attributes:
        direction: unit vector towards the sun.
        axes: unit vectors across the sun's rays, and the direction the light travels.
        centre: middle of the maps, world m.
        half: half sides of the maps, m, the finest first.
        depths: for each map and texel, where 3/4 and 1/4 of the light pass, m along the light from
            the plane through the centre; +inf where the light is not stopped.
    """

    direction: Float[np.ndarray, "3"]
    axes: Float[Tensor, "3 3"]
    centre: Float[Tensor, "3"]
    half: tuple[float, ...]
    depths: Float[Tensor, "maps rows columns 2"]

    def visibility(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Fraction of the sun's light that reaches positions (world m); 1 beyond the maps."""
        texels = self.depths.shape[1] - 1
        bias = tuple(BIAS + 2 * half / texels for half in self.half)
        at = (x - self.centre) @ self.axes.T
        return relighting.visibility(self.depths, self.half, bias, at)


@torch.no_grad()
def sun_map(
    field: RadianceField,
    direction: Float[np.ndarray, "3"],
    centre: Float[np.ndarray, "3"],
    progress: Callable[[float], None] | None = None,
) -> SunMap:
    """Trace the maps of a field without unobserved density.

    Args:
        field: without unobserved density.
        direction: unit vector towards the sun.
        centre: middle of the maps, world m.
        progress: called with the fraction that is done.
    """
    device = device_of(field)
    light = -np.asarray(direction, np.float64)
    side = np.cross([0.0, 0.0, 1.0], light)
    # A sun in the zenith has no azimuth: any axis will do.
    side = side / np.linalg.norm(side) if np.linalg.norm(side) > 1e-6 else np.array([1.0, 0, 0])
    axes = np.stack([side, np.cross(light, side), light])
    maps = []
    for half in (FINE, COARSE):
        # High enough that all matter below `ABOVE` over the map lies behind the start.
        climb = max(float(direction[2]), 0.05)
        start = min((ABOVE + half * np.sqrt(1 - climb**2)) / climb, 400.0)
        grid = (np.arange(TEXELS) / (TEXELS - 1) * 2 - 1) * half
        u, v = np.meshgrid(grid, grid)
        o = centre + u[..., None] * axes[0] + v[..., None] * axes[1] - start * light
        rays_o = to_device(o.reshape(-1, 3).astype(np.float32), device)
        done = len(maps) / 2
        report = None if progress is None else lambda part, done=done: progress(done + part / 2)
        towards = to_device(light.astype(np.float32), device)
        found = _depths(field, rays_o, towards, start + half, report)
        maps.append((found - start).reshape(TEXELS, TEXELS, 2))
    return SunMap(
        np.asarray(direction, np.float64),
        to_device(axes.astype(np.float32), device),
        to_device(np.asarray(centre, np.float32), device),
        (FINE, COARSE),
        torch.stack(maps),
    )


def _depths(
    field: RadianceField,
    rays_o: Float[Tensor, "n 3"],
    light: Float[Tensor, "3"],
    length: float,
    progress: Callable[[float], None] | None = None,
) -> Float[Tensor, "n 2"]:
    """Ray lengths at which 3/4 and 1/4 of the light pass; +inf where more passes."""
    found = torch.full((rays_o.shape[0], 2), torch.inf, device=rays_o.device)
    for chunk in chunks(rays_o):
        o = rays_o[chunk]
        rows = chunk.start + torch.arange(len(o), device=o.device)
        tau, begin = torch.zeros(len(o), dtype=torch.float64, device=o.device), 0.0
        while begin < length and len(o):
            here = o + begin * light
            d = light.expand_as(here).contiguous()
            zero = torch.zeros_like(o[:, 0])
            samples = field.march(here, d, zero, zero + PIECE, stop=1e-2)
            own = (samples.sigma * samples.dt).double()  # sums over all rays of a chunk
            ray = samples.ray_index()
            upto = own.cumsum(0)
            before = torch.cat([upto.new_zeros(1), upto])[samples.offsets[:-1]]
            upto = upto - before[ray] + tau[ray]
            for k, part in enumerate(PARTS):
                crosses = ((upto >= part) & (upto - own < part)).nonzero()[:, 0]
                fraction = (part - upto[crosses] + own[crosses]) / own[crosses]
                t = samples.t[crosses] + (fraction - 0.5) * samples.dt[crosses]
                found[rows[ray[crosses]], k] = begin + t.float()
            tau = tau.index_add(0, ray, own)
            alive = (tau < OPAQUE).nonzero()[:, 0]
            o, rows, tau = o[alive], rows[alive], tau[alive]
            begin += PIECE
        if progress is not None:
            progress(min(chunk.stop / len(rays_o), 1.0))
    return found
