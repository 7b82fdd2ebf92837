"""Sparse depth: rays from photos to the triangulated points that they observe."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from climatenerf.core.device import CPU, integers, to_device
from climatenerf.scene.scene import Scene
from climatenerf.scene.withheld import is_withheld
from climatenerf.training.dataset import TrainingPixels


@dataclass(frozen=True)
class SparseDepth:
    """Rays with a measured depth."""

    rays_o: Float[Tensor, "m 3"]
    """Camera centres, world m."""
    rays_d: Float[Tensor, "m 3"]
    """Unit directions, world axes."""
    depth: Float[Tensor, "m"]
    """Length of the ray up to the measured point, m."""
    image: Int[Tensor, "m"]
    """Index of the training image."""

    @property
    def points(self) -> Float[Tensor, "m 3"]:
        """The measured points, world m."""
        return self.rays_o + self.depth[:, None] * self.rays_d

    def select(self, rows: Int[Tensor, "k"] | Bool[Tensor, "m"]) -> "SparseDepth":
        """Return the rays of the given indices, or of a mask."""
        return SparseDepth(self.rays_o[rows], self.rays_d[rows], self.depth[rows], self.image[rows])

    def draw(self, n: int, generator: torch.Generator) -> "SparseDepth":
        """Return n random rays, drawn with replacement."""
        return self.select(integers(generator, 0, len(self.depth), n, device=self.depth.device))


def read_sparse_depth(scene: Scene, device: torch.device = CPU) -> SparseDepth | None:
    """Return one ray, on `device`, for each sparse point that each training view observes.

    Points that are withheld for scores are left out; see `scene.withheld`.

    Returns:
        None if the scene has no points, or no view's observations are known.
    """
    points = scene.points_world()
    origins, ends, images = [np.empty((0, 3))], [np.empty((0, 3))], [np.empty(0, int)]
    for index, view in enumerate(scene.of_split("train")):
        if points is not None and view.seen is not None:
            ends.append(points[view.seen[~is_withheld(view.seen)]])
            images.append(np.full(len(ends[-1]), index))
            origins.append(np.broadcast_to(scene.c2w_world(view)[:3, 3], ends[-1].shape))
    origin, end = np.concatenate(origins), np.concatenate(ends)
    depth = np.linalg.norm(end - origin, axis=-1)
    # A point at the camera centre has no direction. Relative to the median depth, since outliers
    # can be very far away.
    valid = depth > 1e-6 * np.median(depth) if depth.size else depth > 0
    if not valid.any():
        return None
    rays_d = (end - origin)[valid] / depth[valid, None]
    return SparseDepth(
        rays_o=to_device(origin[valid].astype(np.float32), device),
        rays_d=to_device(rays_d.astype(np.float32), device),
        depth=to_device(depth[valid].astype(np.float32), device),
        image=to_device(np.concatenate(images)[valid].astype(np.int64), device),
    )


def unmasked_sparse_depth(scene: Scene, pixels: TrainingPixels) -> SparseDepth | None:
    """Return `read_sparse_depth` without the rays through masked pixels.

    A masked mirror, for example, has points behind it where the wall is not.

    Args:
        scene: The capture.
        pixels: Of its training views, with their masks.

    Returns:
        None if no ray is left.
    """
    sparse = read_sparse_depth(scene, pixels.device)
    if sparse is None:
        return None
    visible = pixels.usable_towards(sparse.image, sparse.rays_d)
    return sparse.select(visible) if bool(visible.any()) else None


def concatenate(parts: Sequence[SparseDepth]) -> SparseDepth:
    """Return the rays of all parts, in order; at least one part is needed."""
    columns = zip(*(vars(part).values() for part in parts), strict=True)
    return SparseDepth(*(torch.cat(column) for column in columns))
