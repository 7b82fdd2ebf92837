"""A second kind of field: a few dozen anisotropic Gaussians, each with its own colour.

Density is a sum of Gaussians, sigma_i exp(-(x - mu_i)^T A_i (x - mu_i) / 2). Along a ray each one
is a one-dimensional Gaussian, so its optical depth is known in closed form; `march` gives one
sample for each, at its peak, whose `ids` name it. Colours are spherical harmonics of degree 1 per
Gaussian, looked up by id; without an id a position has the density-weighted mean colour.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from climatenerf.core.samples import Samples
from climatenerf.field.capabilities import DENSITY

REACH = 3.0  # standard deviations within which a Gaussian counts as present


@dataclass(frozen=True)
class GaussianField:
    mean: Tensor  # [g, 3], m
    precision: Tensor  # [g, 3, 3], 1/m^2
    peak: Tensor  # [g], 1/m
    colour_mean: Tensor  # [g, 3]
    colour_slope: Tensor  # [g, 3 (rgb), 3 (xyz)], the harmonics of degree 1
    near: float = 0.0
    capabilities: frozenset[str] = frozenset({DENSITY})

    @property
    def bounds(self) -> tuple[Tensor, Tensor]:
        wide = REACH * torch.linalg.inv(self.precision).diagonal(dim1=-2, dim2=-1).sqrt()
        return (self.mean - wide).amin(0), (self.mean + wide).amax(0)

    def march(
        self, rays_o, rays_d, t_min, t_max, step_scale=1.0, *, stop=1e-3, pruning_threshold=None
    ):
        t, width, tau = self.along(rays_o, rays_d)
        order = t.argsort(-1)
        t, width, tau = (each.gather(-1, order) for each in (t, width, tau))
        least = 1e-4 if pruning_threshold is None else pruning_threshold
        keep = (tau > least) & (t >= t_min[:, None]) & (t < t_max[:, None])
        before = (tau * keep).cumsum(-1) - tau * keep
        keep &= torch.exp(-before) > stop
        offsets = torch.cat([torch.zeros(1, dtype=torch.long), keep.sum(-1).cumsum(0)])
        dt = width[keep] * math.sqrt(2 * math.pi)
        return Samples(offsets, t[keep], dt, tau[keep] / dt, order[keep])

    def along(self, rays_o: Tensor, rays_d: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Ray length of each Gaussian's peak, its width (m) and its optical depth; [n, g]."""
        offset = self.mean - rays_o[:, None]
        leaning = torch.einsum("gij,nj->ngi", self.precision, rays_d)
        curvature = (leaning * rays_d[:, None]).sum(-1)
        t = (leaning * offset).sum(-1) / curvature
        rest = offset - t[..., None] * rays_d[:, None]
        height = torch.exp(-0.5 * torch.einsum("ngi,gij,ngj->ng", rest, self.precision, rest))
        width = curvature.rsqrt()
        return t, width, self.peak * height * width * math.sqrt(2 * math.pi)

    def parts(self, x: Tensor) -> Tensor:
        """Density of each Gaussian at positions, [n, g]."""
        offset = x[:, None] - self.mean
        inner = torch.einsum("ngi,gij,ngj->ng", offset, self.precision, offset)
        return self.peak * torch.exp(-0.5 * inner)

    def density(self, x):
        return self.parts(x).sum(-1)

    def colour(self, x, d, ray=None, *, ids=None, appearance=None):
        d = d if ray is None else d[ray]
        if ids is not None:
            slope = torch.einsum("sci,si->sc", self.colour_slope[ids], d)
            return (self.colour_mean[ids] + slope).clamp_min(0)
        weights = self.parts(x) + 1e-12  # far from all Gaussians: their plain mean instead of 0/0
        weights = weights / weights.sum(-1, keepdim=True)
        slope = torch.einsum("ng,gci,ni->nc", weights, self.colour_slope, d)
        return (weights @ self.colour_mean + slope).clamp_min(0)

    def sky(self, d, appearance=None):
        up = d[:, 2:].clamp(0, 1)
        return torch.tensor([0.8, 0.8, 0.8]) * (1 - up) + torch.tensor([0.4, 0.6, 0.9]) * up


def plain_with_stones(seed: int = 0) -> GaussianField:
    """Ground of 36 flat Gaussians, 12 m wide at z = 0, and six tilted stones upon it."""
    generator = torch.Generator().manual_seed(seed)
    x, y = torch.meshgrid(torch.linspace(-5, 5, 6), torch.linspace(-5, 5, 6), indexing="ij")
    ground = torch.stack([x.flatten(), y.flatten(), torch.zeros(36)], -1)
    stones = torch.rand(6, 3, generator=generator) * torch.tensor([6.0, 4.0, 0.4])
    stones = stones + torch.tensor([-3.0, -1.0, 0.3])
    flat = torch.diag(torch.tensor([1.6, 1.6, 0.03]) ** -2).expand(36, 3, 3)
    turn, _ = torch.linalg.qr(torch.randn(6, 3, 3, generator=generator))
    sizes = torch.diag(torch.tensor([0.5, 0.3, 0.2]) ** -2)
    mean_colour = torch.cat(
        [
            torch.tensor([[0.30, 0.33, 0.2]]).expand(36, 3),
            0.5 * torch.rand(6, 3, generator=generator),
        ]
    )
    return GaussianField(
        torch.cat([ground, stones]),
        torch.cat([flat, turn @ sizes @ turn.mT]),
        torch.cat([torch.full((36,), 60.0), torch.full((6,), 20.0)]),
        mean_colour,
        0.05 * torch.randn(42, 3, 3, generator=generator),
    )
