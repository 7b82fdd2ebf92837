"""Smog in a scene: the medium of `medium`, above the scene's ground datum."""

from dataclasses import dataclass, replace

from climatenerf.weather.smog.medium import medium
from climatenerf.weather.weather import Weather
from climatenerf.weather.world import Preparation, World


@dataclass(frozen=True)
class SmogEntity:
    """Smog in a scene whose ground datum lies at world height `ground_z` (m)."""

    ground_z: float

    def place(self, world: World, weather: Weather, time: float) -> World:
        """The world with smog in its air."""
        air = medium(weather.smog, self.ground_z)
        return world if air is None else replace(world, media=(*world.media, air))

    def check(self, moments: tuple[Weather, ...]) -> None:
        """Any parameters fit any scene."""

    def facts(self) -> dict[str, float]:
        """Nothing is prepared."""
        return {}


def prepare(preparation: Preparation) -> SmogEntity:
    """Smog needs nothing of the field."""
    return SmogEntity(preparation.scene.ground_z)
