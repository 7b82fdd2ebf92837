"""The views that teach a field, and the samples on their rays: marched once, as shapes stay."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.core.cameras import Camera
from climatenerf.core.device import to_device
from climatenerf.core.samples import MIN_WEIGHT, offsets_of
from climatenerf.field.compositing import RENDER_STEP, chunks
from climatenerf.field.hash_field import Field
from climatenerf.ops import compositing, reference
from climatenerf.render.volume import camera_rays
from climatenerf.scene.scene import Scene

MAX_RAYS = 2**20  # of all views together; their samples take about 300 bytes a ray
MIN_OPACITY = 0.5  # of rays that teach; the rest are sky


@dataclass(frozen=True)
class Shot:
    """A view at the size at which it teaches.

    Attributes:
        name: of its photo.
        camera: at that size.
        c2w: pose, world m.
        pixels: indices of the pixels that teach, row by row, ascending.
    """

    name: str
    camera: Camera
    c2w: Float[np.ndarray, "4 4"]
    pixels: Int[np.ndarray, "n"]

    def rays(self, device: torch.device) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
        """Return origins (world m) and unit directions of the pixels that teach."""
        rays_o, rays_d = camera_rays(self.camera, self.c2w, device)
        rows = to_device(self.pixels, device)
        return rays_o[rows].contiguous(), rays_d[rows].contiguous()


def choose_shots(scene: Scene, count: int, width: int, seed: int) -> tuple[Shot, ...]:
    """Return training views evenly spread over the capture, with random pixels of each.

    Args:
        scene: the capture.
        count: the most views, at least 1.
        width: the most pixels across.
        seed: of the pixels.
    """
    views = scene.of_split("train")
    picks = np.unique(np.linspace(0, len(views) - 1, min(count, len(views))).round().astype(int))
    shots = []
    for index in picks.tolist():
        view = views[index]
        camera = scene.cameras[view.camera]
        if camera.width > width:
            camera = camera.resized(width, max(1, round(width * camera.height / camera.width)))
        size = camera.width * camera.height
        random = np.random.default_rng([seed % 2**63, index])
        chosen = random.choice(size, min(size, MAX_RAYS // len(picks)), replace=False)
        shots.append(Shot(view.name, camera, scene.c2w_world(view), np.sort(chosen)))
    return tuple(shots)


@dataclass(frozen=True)
class Rays:
    """Rays with the samples that give them colour.

    Attributes:
        u: unit-cube positions of the samples, packed by ray.
        weights: their rendering weights.
        offsets: the samples of ray r are offsets[r]:offsets[r + 1].
        directions: unit vectors.
        behind: linear radiance of the sky that passes the matter.
        transmittance: fraction of the sky that does.
    """

    u: Float[Tensor, "s 3"]
    weights: Float[Tensor, "s"]
    offsets: Int[Tensor, "n+1"]
    directions: Float[Tensor, "n 3"]
    behind: Float[Tensor, "n 3"]
    transmittance: Float[Tensor, "n"]

    def __len__(self) -> int:
        """Number of rays."""
        return self.directions.shape[0]

    def rows(self, index: Int[Tensor, "m"]) -> "Rays":
        """Return some of the rays, in the order of the indices."""
        start, count = self.offsets[index], self.offsets.diff()[index]
        offsets = torch.cat([count.new_zeros(1), count.cumsum(0)])
        shift = torch.repeat_interleave(start - offsets[:-1], count)
        sample = shift + torch.arange(len(shift), device=shift.device)
        return Rays(
            self.u[sample],
            self.weights[sample],
            offsets,
            self.directions[index],
            self.behind[index],
            self.transmittance[index],
        )

    def opaque(self) -> Int[Tensor, "m"]:
        """Return indices of the rays that mostly show matter."""
        return (self.transmittance < 1 - MIN_OPACITY).nonzero()[:, 0]


def joined(parts: list[Rays]) -> Rays:
    """Return all rays of several lists."""
    ends = np.cumsum([0, *(int(part.offsets[-1]) for part in parts)]).tolist()
    begins = [part.offsets[:-1] + end for part, end in zip(parts, ends, strict=False)]
    return Rays(
        torch.cat([part.u for part in parts]),
        torch.cat([part.weights for part in parts]),
        torch.cat([*begins, parts[0].offsets.new_tensor(ends[-1:])]),
        torch.cat([part.directions for part in parts]),
        torch.cat([part.behind for part in parts]),
        torch.cat([part.transmittance for part in parts]),
    )


@torch.no_grad()
def march(field: Field, rays_o: Float[Tensor, "n 3"], rays_d: Float[Tensor, "n 3"]) -> Rays:
    """March rays (world m) as a render does, and keep the samples of some weight."""
    parts = []
    for chunk in chunks(rays_o):
        o, d = rays_o[chunk], rays_d[chunk]
        near = torch.full_like(o[:, 0], field.near)
        samples = field.march(o, d, near, torch.full_like(near, 1e9), RENDER_STEP, stop=1e-3)
        depths = samples.sigma * samples.dt
        weights, transmittance = compositing.render_weights(depths, samples.offsets)
        keep = (weights > MIN_WEIGHT).nonzero()[:, 0]
        ray = samples.ray_index()[keep]
        u = reference.contract(field.to_grid(o[ray] + samples.t[keep, None] * d[ray]))
        behind = transmittance[:, None] * field.sky(d)
        offsets = offsets_of(ray, len(o))
        parts.append(Rays(u, weights[keep], offsets, d, behind, transmittance))
    return joined(parts)


def matter(field: Field, rays: Rays) -> Float[Tensor, "n 3"]:
    """Return the linear radiance of the matter on rays, with gradients; at the mean appearance."""
    counts = rays.offsets.diff()
    ray = torch.repeat_interleave(torch.arange(len(rays), device=counts.device), counts)
    embedding = field.mean_embedding.expand(len(rays), -1)
    colour = field.colour_at(rays.u, ray, rays.directions, embedding)
    return compositing.accumulate(rays.weights, colour, rays.offsets)
