"""Sparse points as measured depth: rays from photos to the points that they are known to show."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from climatenerf.core.device import integers, to_device
from climatenerf.scene.scene import Scene
from climatenerf.training.dataset import TrainingPixels


@dataclass(frozen=True)
class SparseDepth:
    """Rays that end on a sparse point."""

    rays_o: Float[Tensor, "m 3"]
    """Camera centres, world m."""
    rays_d: Float[Tensor, "m 3"]
    """Unit directions."""
    depth: Float[Tensor, "m"]
    """Ray length of the point, m."""
    image: Int[Tensor, "m"]
    """Index of the training image."""

    @property
    def ends(self) -> Float[Tensor, "m 3"]:
        """The points, world m."""
        return self.rays_o + self.depth[:, None] * self.rays_d

    def select(self, which: Int[Tensor, "k"] | Bool[Tensor, "m"]) -> "SparseDepth":
        """Those of the given rows, or of a mask."""
        return SparseDepth(
            self.rays_o[which], self.rays_d[which], self.depth[which], self.image[which]
        )

    def draw(self, n: int, generator: torch.Generator) -> "SparseDepth":
        """n random ones of them."""
        return self.select(integers(generator, 0, self.depth.shape[0], n))


def read_sparse_depth(scene: Scene) -> SparseDepth | None:
    """One ray for each point that each training view shows, or None if that is not known."""
    points = scene.points_world()
    eyes, ends, of = [np.empty((0, 3))], [np.empty((0, 3))], [np.empty(0, int)]
    for index, view in enumerate(scene.of_split("train")):
        if points is not None and view.seen is not None:
            ends.append(points[view.seen])
            of.append(np.full(len(ends[-1]), index))
            eyes.append(np.broadcast_to(scene.c2w_world(view)[:3, 3], ends[-1].shape))
    eye, end = np.concatenate(eyes), np.concatenate(ends)
    depth = np.linalg.norm(end - eye, axis=-1)
    # A point in the camera has no direction. The median, since stray points can be very far.
    kept = depth > 1e-6 * np.median(depth) if depth.size else depth > 0
    if not kept.any():
        return None
    rays_d = (end - eye)[kept] / depth[kept, None]
    return SparseDepth(
        rays_o=to_device(eye[kept].astype(np.float32)),
        rays_d=to_device(rays_d.astype(np.float32)),
        depth=to_device(depth[kept].astype(np.float32)),
        image=to_device(np.concatenate(of)[kept].astype(np.int64)),
    )


def unmasked_sparse_depth(scene: Scene, pixels: TrainingPixels) -> SparseDepth | None:
    """`read_sparse_depth` of what no mask hides: behind a mirror there is no wall at that depth."""
    points = read_sparse_depth(scene)
    if points is None:
        return None
    kept = pixels.usable_towards(points.image, points.rays_d)
    return points.select(kept) if bool(kept.any()) else None


def concatenate(some: Sequence[SparseDepth]) -> SparseDepth:
    """The rays of all of them; at least one."""
    every = zip(*(vars(each).values() for each in some), strict=True)
    return SparseDepth(*(torch.cat(same) for same in every))
