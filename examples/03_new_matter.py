"""A new kind of matter, volcanic ash, without a change to the renderer.

    python examples/03_new_matter.py [RUN]

The renderer knows matter by four functions (`weather.world.Matter`): march, colour, normal and
thickness. `Ash` lies where snow would and brings its own colour; matter of another shape brings its
own `march`. Needs the run of 01_fit_and_flood.py. Writes RUN/ash.png.
"""

import math
import sys
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from climatenerf.core.samples import Samples
from climatenerf.field.checkpoint import load_field
from climatenerf.output.layers import SIMULATED
from climatenerf.output.video import write_png
from climatenerf.paths.camera_path import camera_path
from climatenerf.render.frame import render_frame
from climatenerf.render.irradiance import scene_irradiance
from climatenerf.scene import load_scene
from climatenerf.weather.snow.layer import BakedSnow, bake_snow
from climatenerf.weather.snow.parameters import Snow
from climatenerf.weather.world import World


@dataclass(frozen=True)
class Ash:
    mask, thickness_layer = "mask_ash", "ash_thickness"
    layer: BakedSnow  # where it lies
    light: Tensor  # radiance of a white sheet in the open, [3]
    albedo: float = 0.12

    def march(self, rays_o: Tensor, rays_d: Tensor, t_min: Tensor, t_max: Tensor) -> Samples:
        return self.layer.march(rays_o, rays_d, t_min, t_max)

    def colour(self, x: Tensor) -> Tensor:
        up = 0.5 + 0.5 * self.normal(x)[:, 2:]  # share of the sky that a slope sees
        return self.albedo * up * self.light

    def normal(self, x: Tensor) -> Tensor:
        return self.layer.normal(x)

    def thickness(self, x: Tensor) -> Tensor:
        return self.layer.thickness(x)


run = Path(sys.argv[1] if len(sys.argv) > 1 else "runs/example")
field, scene = load_field(run), load_scene(run)
path = camera_path("still:0020", scene, frames=1, size=(192, 108))
light = scene_irradiance(field, scene) / math.pi
fall = Snow(depth=0.04, slope=math.radians(33))  # ash slides off earlier than snow
layer = bake_snow(field.observed_only(), fall, path.c2w[:, :3, 3], light.numpy())
world = World(field, matters=() if layer is None else (Ash(layer, light),))
picture, layers = render_frame(world, path.cameras[0], path.c2w[0])
write_png(run / "ash.png", picture, SIMULATED)
print(f"ash on {layers['mask_ash'].mean():.0%} of {run / 'ash.png'}")
