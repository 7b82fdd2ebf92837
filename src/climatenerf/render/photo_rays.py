"""Where the rays of the photos end on the fitted field; terrain and scores start from this."""

from collections.abc import Callable

import numpy as np
import torch

from climatenerf.core.device import to_numpy
from climatenerf.field.compositing import chunks
from climatenerf.field.protocol import RadianceField, device_of
from climatenerf.render.heads import ray_ends
from climatenerf.render.volume import camera_rays
from climatenerf.scene.photo_rays import PhotoRays
from climatenerf.scene.scene import Scene

MAX_RAYS = 150_000  # of all photos together
END_STEP = 2.0  # marching step of those rays; see `RENDER_STEP`
END_WEIGHT = 0.01  # of samples whose normal and class are evaluated


@torch.no_grad()
def trace_photos(
    field: RadianceField, scene: Scene, progress: Callable[[float], None] | None = None
) -> list[PhotoRays]:
    """Return the rays of all training photos, about `MAX_RAYS` in all.

    Args:
        field: fitted to the scene, with normals or classes among its capabilities.
        scene: the capture.
        progress: called with the fraction that is done.
    """
    views, device = scene.of_split("train"), device_of(field)
    photos = []
    for index, view in enumerate(views):
        if progress is not None:
            progress(index / len(views))
        camera, c2w = scene.cameras[view.camera], scene.c2w_world(view)
        factor = np.sqrt(camera.width * camera.height * len(views) / MAX_RAYS)
        width = max(round(camera.width / max(factor, 1)), 8)
        small = camera.resized(width, max(round(width * camera.height / camera.width), 8))
        rays_o, rays_d = camera_rays(small, c2w, device)
        size = (small.height, small.width)
        parts = [
            ray_ends(field, rays_o[chunk], rays_d[chunk], END_STEP, END_WEIGHT)
            for chunk in chunks(rays_o)
        ]
        t, normal, label, through = (
            to_numpy(torch.cat([getattr(part, name) for part in parts])).reshape(*size, *shape)
            for name, shape in (("t", ()), ("normal", (3,)), ("label", ()), ("transmittance", ()))
        )
        t, d = t.astype(np.float64), to_numpy(rays_d).astype(np.float64).reshape(*size, 3)
        ends = np.isfinite(t)[..., None]
        x = np.where(ends, c2w[:3, 3] + np.where(ends, t[..., None], 0.0) * d, np.inf)
        photos.append(PhotoRays(view, small, c2w, x, t, d, normal, label, through))
    return photos
