"""Weather put into a fitted scene: prepared once, then asked for the world at each moment."""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.core.device import to_numpy
from climatenerf.core.errors import UserError
from climatenerf.field.protocol import RadianceField, observed
from climatenerf.render.irradiance import scene_irradiance
from climatenerf.scene.scene import Scene
from climatenerf.weather.description import KeyframedWeather
from climatenerf.weather.flood.waves import Waves, at_time, make_waves
from climatenerf.weather.parameters import Snow, Sun, Weather, check
from climatenerf.weather.smog.medium import medium
from climatenerf.weather.snow.layer import BakedSnow, bake_snow
from climatenerf.weather.world import Water, World


@dataclass
class Stage:
    """A fitted scene under a weather that may change over time."""

    field: RadianceField
    scene: Scene
    weather: KeyframedWeather
    irradiance: Float[Tensor, "3"]
    snow: BakedSnow | None
    waves: Waves | None
    appearance: Float[Tensor, "1 e"] | None = None
    """Exposure and light of a photo; None: the mean of all photos."""
    _grown: dict[float, BakedSnow] = dataclasses.field(default_factory=dict)

    def at(self, time: float) -> World:
        """Everything there is at a time in s."""
        weather = self.weather.at(time)
        water = None
        if weather.flood.level is not None and self.waves is not None:
            water = Water(
                weather.flood,
                self.scene.ground_z + weather.flood.level,
                at_time(self.waves, time),
                self.irradiance,
                weather.sun.elevation,
            )
        matter = self._snow_of(weather.snow)
        if matter is not None:
            matter = matter.above(None if water is None else water.level)
        air = medium(weather.smog, self.scene.ground_z)
        return World(self.field, self.appearance, air, matter, water)

    def _snow_of(self, snow: Snow) -> BakedSnow | None:
        if self.snow is None or snow.depth is None or snow.depth <= 0:
            return None
        if snow.depth != self.snow.snow.depth:
            if snow.depth not in self._grown:
                self._grown = {snow.depth: self.snow.with_depth(snow.depth)}
            return self._grown[snow.depth]
        return self.snow


def sun_direction(sun: Sun) -> Float[np.ndarray, "3"] | None:
    """Unit vector towards the sun, azimuth from +y towards +x; None without an elevation."""
    if sun.elevation is None:
        return None
    azimuth = sun.azimuth or 0.0
    flat = math.cos(sun.elevation)
    return np.array([flat * math.sin(azimuth), flat * math.cos(azimuth), math.sin(sun.elevation)])


def prepare(
    field: RadianceField,
    scene: Scene,
    weather: KeyframedWeather,
    places: Float[np.ndarray, "m 3"],
    times: Float[np.ndarray, "f"],
    progress: Callable[[str, float], None],
    appearance: Float[Tensor, "1 e"] | None = None,
) -> Stage:
    """Everything that is done once: light, waves, snowfall.

    Args:
        field: the fitted field.
        scene: its capture.
        weather: what to put in.
        places: camera positions of the movie, world m; snow is finest around them.
        times: moments of the frames, s.
        progress: told what is being done and the share that is over.

    Raises:
        UserError: a level above all of the scene.
    """
    moments = [check(weather.at(float(t))) for t in times]
    _check_levels(scene, moments)
    progress("light", 0.0)
    wants = any(m.flood.level is not None or m.snow.depth is not None for m in moments)
    irradiance = scene_irradiance(field, scene, appearance) if wants else torch.ones(3)
    flooded = [m for m in moments if m.flood.level is not None]
    snowy = [m for m in moments if m.snow.depth is not None and m.snow.depth > 0]
    waves = make_waves(flooded[0].flood, flooded[0].seed) if flooded else None
    snow = None
    if snowy:
        snow = bake_snow(
            observed(field),
            snowy[-1].snow,
            places,
            to_numpy(irradiance / math.pi),
            sun_direction(snowy[-1].sun),
            snowy[-1].seed,
            progress=lambda share: progress("snowfall", share),
            appearance=appearance,
        )
    return Stage(field, scene, weather, irradiance, snow, waves, appearance)


def _check_levels(scene: Scene, moments: list[Weather]) -> None:
    """A flood above every camera and every point of the scene is a slip of the unit."""
    highest = max(scene.c2w_world(view)[2, 3] for view in scene.views)
    points = scene.points_world()
    if points is not None and points.shape[0]:
        highest = max(highest, float(np.quantile(points[:, 2], 0.99)))
    top = highest - scene.ground_z
    for moment in moments:
        level = moment.flood.level
        if level is not None and level > top:
            raise UserError(
                f"--flood.level {level:g} m is above the whole scene, whose top is {top:.1f} m"
                " over its ground; give a lower level"
            )
