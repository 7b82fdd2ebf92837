"""A new weather effect, volcanic ash, as one file of its own.

    python examples/03_new_effect.py [RUN]

Ash lies on the same surfaces as snow and has its own colour. `ASH` describes it: parameters with
unit and range, two layers, one number for the sidecar. No other file refers to it. In an installed
package the entry point `ash = "my_package:ASH"` of the group `climatenerf.effects` adds the flags
--ash.depth and --ash.albedo. Needs the run of 01_fit_and_flood.py. Writes RUN/ash.
"""

import dataclasses
import json
import math
import sys
from pathlib import Path
from typing import Annotated

import climatenerf
from climatenerf import extend


@dataclasses.dataclass(frozen=True)
class Ash:
    """Volcanic ash on upward-facing surfaces."""

    depth: Annotated[float | None, extend.quantity(extend.LENGTH, 0.0, 1.0, optional=True)] = None
    """Thickness on open level ground. none: no ash."""
    albedo: Annotated[float, extend.number(0.0, 1.0)] = 0.12
    """Fraction of the light that ash reflects."""


@dataclasses.dataclass(frozen=True)
class AshLayer:
    """Ash on a scene, with the shape of snow and its own colour: matter of the renderer."""

    shape: "extend.BakedSnow"
    white: object  # radiance of a white sheet in the open: a tensor of 3
    albedo: float
    mask = "mask_ash"
    thickness_layer = "ash_thickness"

    def march(self, rays_o, rays_d, t_min, t_max):
        """Samples along rays where there is ash."""
        return self.shape.march(rays_o, rays_d, t_min, t_max)

    def colour(self, x):
        """Linear radiance under a uniform sky, of which a slope receives a fraction."""
        return self.albedo * (0.5 + 0.5 * self.normal(x)[:, 2:]) * self.white

    def normal(self, x):
        """Outward unit normals."""
        return self.shape.normal(x)

    def thickness(self, x):
        """Height above the ground, m."""
        return self.shape.thickness(x)


@dataclasses.dataclass(frozen=True)
class AshEntity:
    """Ash that has fallen on a scene."""

    shape: "extend.BakedSnow"
    white: object

    def place(self, world, weather, time):
        """The world with ash on it."""
        depth = weather.ash.depth
        if not depth:
            return world
        shape = self.shape if depth == self.shape.snow.depth else self.shape.with_depth(depth)
        ash = AshLayer(shape, self.white, weather.ash.albedo)
        return dataclasses.replace(world, matters=(*world.matters, ash))

    def check(self, moments):
        """All parameters are valid in any scene."""

    def facts(self):
        """Nothing to report."""
        return {}


def prepare(preparation):
    """Simulate the fall of ash, once for the scene."""
    white = preparation.irradiance() / math.pi
    max_slope = math.radians(33)  # less than that of snow
    depth = max(moment.ash.depth for moment in preparation.moments) or 0.01
    fall = climatenerf.Snow(depth=depth, slope=max_slope)
    cameras = preparation.camera_positions
    field = extend.observed(preparation.field)
    return AshEntity(extend.bake_snow(field, fall, cameras, white.numpy()), white)


ASH = extend.Effect(
    name="ash",
    parameters=Ash,
    enabled_by=("depth",),
    prepare=prepare,
    layers=(
        extend.Layer("ash_thickness", "m", "thickness of visible ash, else 0", 1e-4, 16),
        extend.Layer("mask_ash", "1", "fraction of the pixel that shows ash", 1 / 255, 8),
    ),
    measures=(extend.Measure("ash_share", "mask_ash"),),
)


def main() -> None:
    """Render one frame of the example run under 4 cm of ash."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "runs/example")
    effects = (*extend.EFFECTS, ASH)
    weather = climatenerf.Weather(ash=Ash(depth=0.04), effects=effects)
    out = folder / "ash"
    view = {"path": "still:0020", "frames": 1, "size": (192, 108)}
    climatenerf.render_movie(folder, out, weather, effects=effects, layers=["mask_ash"], **view)
    frame = json.loads((out / "movie.json").read_text())["frames"][0]
    print(f"ash on {frame['measured']['ash_share']:.0%} of {out / frame['file']}")


if __name__ == "__main__":
    main()
