"""All training pixels as one long list of rays with their colours."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from climatenerf.scene.cameras import Camera

SKY = 10  # Cityscapes train id


@dataclass
class Batch:
    """n rays drawn from the training images."""

    rays_o: Float[Tensor, "n 3"]
    """Origins, world m."""
    rays_d: Float[Tensor, "n 3"]
    """Unit directions."""
    image: Int[Tensor, "n"]
    """Index of the training image."""
    rgb: Float[Tensor, "n 3"]
    """Display sRGB in [0,1]."""
    is_sky: Float[Tensor, "n"]
    """1 where the image's label says sky, else 0."""


class TrainingPixels:
    """Draws random pixels from a list of images; keeps 8-bit pixels only."""

    def __init__(
        self,
        cameras: Sequence[Camera],
        camera_of: Sequence[int],
        c2w: Float[np.ndarray, "v 4 4"],
        images: Sequence[UInt8[np.ndarray, "h w 3"]],
        labels: Sequence[UInt8[np.ndarray, "h w"] | None] | None = None,
        masks: Sequence[np.ndarray | None] | None = None,
    ):
        """Takes images in the size of their (already downscaled) cameras; c2w in world metres.

        Masks: pixels where a mask is 0 are never drawn.
        """
        self.c2w = torch.from_numpy(np.asarray(c2w, np.float32))
        directions = [torch.from_numpy(camera.directions().reshape(-1, 3)) for camera in cameras]
        sizes = torch.tensor([d.shape[0] for d in directions])
        self.directions = torch.cat(directions)
        start_of_camera = torch.cat([torch.zeros(1, dtype=torch.long), sizes.cumsum(0)[:-1]])
        camera_index = torch.as_tensor(list(camera_of))
        self.direction_start = start_of_camera[camera_index]
        counts = torch.tensor([image.shape[0] * image.shape[1] for image in images])
        if not torch.equal(counts, sizes[camera_index]):
            raise ValueError("an image's size differs from its camera's")
        self.pixel_start = torch.cat([torch.zeros(1, dtype=torch.long), counts.cumsum(0)])
        self.rgb = torch.from_numpy(np.concatenate([i.reshape(-1, 3) for i in images]))
        self.sky = None
        if labels is not None and any(label is not None for label in labels):
            self.sky = torch.cat(
                [
                    torch.zeros(int(n), dtype=torch.bool)
                    if label is None
                    else torch.from_numpy(label.reshape(-1) == SKY)
                    for label, n in zip(labels, counts, strict=True)
                ]
            )
        self.allowed = None
        if masks is not None and any(mask is not None for mask in masks):
            keep = [
                np.ones(int(n), bool) if mask is None else mask.reshape(-1) > 0
                for mask, n in zip(masks, counts, strict=True)
            ]
            self.allowed = torch.from_numpy(np.flatnonzero(np.concatenate(keep)))

    def draw(self, n: int, generator: torch.Generator) -> Batch:
        """n random pixels."""
        if self.allowed is None:
            pixel = torch.randint(self.rgb.shape[0], (n,), generator=generator)
        else:
            pixel = self.allowed[torch.randint(self.allowed.shape[0], (n,), generator=generator)]
        image = torch.searchsorted(self.pixel_start, pixel, right=True) - 1
        within = pixel - self.pixel_start[image]
        c2w = self.c2w[image]
        d = self.directions[self.direction_start[image] + within]
        return Batch(
            rays_o=c2w[:, :3, 3].contiguous(),
            rays_d=(c2w[:, :3, :3] @ d[:, :, None])[:, :, 0].contiguous(),
            image=image,
            rgb=self.rgb[pixel].float() / 255.0,
            is_sky=torch.zeros(n) if self.sky is None else self.sky[pixel].float(),
        )
