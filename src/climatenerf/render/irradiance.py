"""Irradiance of a fitted scene on open level ground, from its light field."""

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.core.colour import luma
from climatenerf.core.device import to_device
from climatenerf.field.protocol import RadianceField, device_of
from climatenerf.render.integrator import trace
from climatenerf.render.volume import camera_rays
from climatenerf.scene.scene import Scene, View
from climatenerf.weather.world import World

CAMERAS = 8  # from which light is gathered
DIRECTIONS = 256  # from each
MAX_DZ = -0.2  # steeper rays show ground; others may show walls and trees
GROUND_ALBEDO = 0.12  # photopic: grass .08, soil and asphalt .1, concrete .3


@torch.no_grad()
def scene_irradiance(
    field: RadianceField, scene: Scene, appearance: Float[Tensor, "1 e"] | None = None
) -> Float[Tensor, "3"]:
    """Return the linear irradiance E on open level ground.

    Photos clip the sun and bright sky, so E is the larger of two estimates: the cosine-weighted
    mean of the radiance from above, and the ground's mean radiance over an albedo of 0.12. Its
    colour is half that of the light from above, half white. E is at most pi: a white sheet is at
    most as bright as the picture can show, as in a photo that is exposed for snow.

    Args:
        field: the fitted field.
        scene: its capture; light from above is gathered at the cameras, and ground is looked for
            only where photos show it.
        appearance: exposure and light of a photo; None: the mean of all photos.
    """
    views = scene.of_split("train")
    chosen = views[:: max(1, len(views) // CAMERAS)][:CAMERAS]
    device = device_of(field)
    up = _cosine_directions(DIRECTIONS, device)
    eyes = np.stack([scene.c2w_world(view)[:3, 3] for view in chosen])
    eyes = to_device(eyes, device).float()
    world = World(field, appearance=appearance)
    above = _radiance(world, eyes.repeat_interleave(DIRECTIONS, 0), up.repeat(len(chosen), 1))
    above = above.mean(0)
    ground_o, ground_d = _photographed_ground(scene, chosen, device)
    if not ground_d.shape[0]:
        return math.pi * above / luma(above).clamp_min(1.0)
    lit = luma(_radiance(world, ground_o, ground_d)).mean() / GROUND_ALBEDO
    brightness = luma(above)
    # White balance adapts to the scene, so only half of the tint is the light's.
    # 1e-6: a black sky would give 0/0.
    colour = 0.5 * (above + brightness)
    colour = colour * torch.clamp(lit / brightness.clamp_min(1e-6), min=1.0, max=3.0)
    return math.pi * colour / luma(colour).clamp_min(1.0)


def _radiance(world: World, o: Tensor, d: Tensor) -> Float[Tensor, "n 3"]:
    return trace(world, o, d, torch.full((o.shape[0],), 0.05, device=o.device)).rgb


def _photographed_ground(
    scene: Scene, views: tuple[View, ...], device: torch.device
) -> tuple[Tensor, Tensor]:
    """Origins (m) and unit directions of a coarse grid of the views' pixels that look down."""
    nothing = torch.empty(0, 3, device=device)
    origins, directions = [nothing], [nothing]
    for view in views:
        camera = scene.cameras[view.camera]
        small = camera.resized(16, max(1, round(16 * camera.height / camera.width)))
        o, d = camera_rays(small, scene.c2w_world(view), device)
        down = d[:, 2] < MAX_DZ
        origins.append(o[down])
        directions.append(d[down])
    return torch.cat(origins), torch.cat(directions)


def _cosine_directions(n: int, device: torch.device) -> Float[Tensor, "n 3"]:
    """Upward unit directions, cosine-distributed (Malley's method on a spiral)."""
    i = torch.arange(n, device=device) + 0.5
    radius, angle = (i / n).sqrt(), i * (math.pi * (3 - math.sqrt(5)))
    return torch.stack([radius * angle.cos(), radius * angle.sin(), (1 - i / n).sqrt()], dim=-1)
