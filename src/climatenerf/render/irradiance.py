"""How brightly a fitted scene is lit: what a white sheet on open ground would show."""

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.core.colour import luma
from climatenerf.field.protocol import RadianceField
from climatenerf.render.integrator import trace
from climatenerf.render.volume import camera_rays
from climatenerf.scene.scene import Scene, View
from climatenerf.weather.world import World

PLACES = 8
DIRECTIONS = 256
SINKS = -0.2  # rays that sink less may show walls and trees
GROUND_ALBEDO = 0.12  # to the eye: grass .08, soil and asphalt .1, concrete .3


@torch.no_grad()
def scene_irradiance(
    field: RadianceField, scene: Scene, appearance: Float[Tensor, "1 e"] | None = None
) -> Float[Tensor, "3"]:
    """Irradiance E on open level ground, linear, from the fitted light field.

    The larger of two estimates, since photos clip the sun and bright sky: the cosine-weighted mean
    of what is seen upwards, and the ground's mean radiance over an albedo of 0.12. The colour is
    half that of the light from above, half white. A white sheet is at most as bright as
    the picture can show: who photographs snow exposes for it.

    Args:
        field: the fitted field.
        scene: its capture; light from above is gathered at the cameras, and ground is looked for
            only where photos show it.
        appearance: exposure and light of a photo; None: the mean of all photos.
    """
    views = scene.of_split("train")
    some = views[:: max(1, len(views) // PLACES)][:PLACES]
    up = _cosine_directions(DIRECTIONS)
    eyes = torch.tensor(np.stack([scene.c2w_world(view)[:3, 3] for view in some])).float()
    world = World(field, appearance=appearance)
    above = _radiance(world, eyes.repeat_interleave(DIRECTIONS, 0), up.repeat(len(some), 1))
    above = above.mean(0)
    ground_o, ground_d = _photographed_ground(scene, some)
    if not ground_d.shape[0]:
        return math.pi * above / luma(above).clamp_min(1.0)
    lit = luma(_radiance(world, ground_o, ground_d)).mean() / GROUND_ALBEDO
    brightness = luma(above)
    # Photos are balanced to the light on what they show, so half of the tint is not the light's.
    colour = 0.5 * (above + brightness)
    colour = colour * torch.clamp(lit / brightness.clamp_min(1e-6), min=1.0, max=3.0)
    return math.pi * colour / luma(colour).clamp_min(1.0)


def _radiance(world: World, o: Tensor, d: Tensor) -> Float[Tensor, "n 3"]:
    return trace(world, o, d, torch.full((o.shape[0],), 0.05)).rgb


def _photographed_ground(scene: Scene, views: tuple[View, ...]) -> tuple[Tensor, Tensor]:
    """Rays of a coarse grid of the views' pixels that sink by more than `SINKS`."""
    origins, directions = [torch.empty(0, 3)], [torch.empty(0, 3)]
    for view in views:
        camera = scene.cameras[view.camera]
        small = camera.resized(16, max(1, round(16 * camera.height / camera.width)))
        o, d = camera_rays(small, scene.c2w_world(view))
        down = d[:, 2] < SINKS
        origins.append(o[down])
        directions.append(d[down])
    return torch.cat(origins), torch.cat(directions)


def _cosine_directions(n: int) -> Float[Tensor, "n 3"]:
    """Upward directions whose mean is the cosine-weighted mean (Malley's method, spiral)."""
    i = torch.arange(n) + 0.5
    radius, angle = (i / n).sqrt(), i * (math.pi * (3 - math.sqrt(5)))
    return torch.stack([radius * angle.cos(), radius * angle.sin(), (1 - i / n).sqrt()], dim=-1)
