"""How brightly a fitted scene is lit: what a white sheet on open ground would show."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.field.colour_space import luma
from climatenerf.render.trace import trace
from climatenerf.render.world import FieldLike, World

DIRECTIONS = 256
GROUND_ALBEDO = 0.3  # of pale ground (dry soil .2, concrete .3 to .4)


@torch.no_grad()
def scene_irradiance(
    field: FieldLike, near: float, places: Float[Tensor, "m 3"]
) -> Float[Tensor, "3"]:
    """Irradiance E on open level ground, linear, from the fitted light field.

    The larger of two estimates, since photos clip the sun and bright sky: the cosine-weighted mean
    of what is seen upwards, and pale ground's radiance over its albedo. The colour is that of the
    light from above.

    Args:
        field: the fitted field.
        near: rays begin here, m.
        places: camera positions, m.
    """
    some = places[:: max(1, places.shape[0] // 8)][:8]
    up = _cosine_directions(DIRECTIONS)
    down = up * torch.tensor([1.0, 1.0, -1.0])
    above = _seen(field, near, some, up).mean((0, 1))
    ground = luma(_seen(field, near, some, down)).flatten()
    lit = torch.quantile(ground, 0.8) / GROUND_ALBEDO
    brightness = luma(above)
    return math.pi * above * torch.clamp(lit / brightness.clamp_min(1e-6), min=1.0, max=3.0)


def _seen(field: FieldLike, near: float, places: Tensor, directions: Tensor) -> Tensor:
    o = places.repeat_interleave(directions.shape[0], 0)
    d = directions.repeat(places.shape[0], 1)
    angle = torch.full((o.shape[0],), 0.05)
    return trace(World(field, near), o, d, angle).rgb.view(places.shape[0], -1, 3)


def _cosine_directions(n: int) -> Float[Tensor, "n 3"]:
    """Upward directions whose mean is the cosine-weighted mean (Malley's method, spiral)."""
    i = torch.arange(n) + 0.5
    radius, angle = (i / n).sqrt(), i * (math.pi * (3 - math.sqrt(5)))
    return torch.stack([radius * angle.cos(), radius * angle.sin(), (1 - i / n).sqrt()], dim=-1)
