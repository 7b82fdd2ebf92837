"""Smog in a scene: the medium of `medium`, above the scene's ground datum, in the place's light."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from torch import Tensor

from climatenerf.core.device import to_device
from climatenerf.field.protocol import device_of
from climatenerf.weather.smog.medium import medium
from climatenerf.weather.smog.scattering import scattering_medium
from climatenerf.weather.weather import Weather
from climatenerf.weather.world import Preparation, World


@dataclass(frozen=True)
class SmogEntity:
    """Smog in a scene.

    Attributes:
        ground_z: world height of the ground datum, m.
        eye: middle of the cameras, where light is measured, world m.
    """

    ground_z: float
    eye: Float[Tensor, "1 3"]

    def place(self, world: World, weather: Weather, time: float) -> World:
        """The world with smog in its air."""
        smog = weather.smog
        air = medium(smog, self.ground_z)
        if air is None:
            return world
        if smog.light == "scene" and world.light is not None:
            top_z = self.ground_z + smog.top
            lit = scattering_medium(smog, air, top_z, world.light, self.eye)
            return replace(world, media=(*world.media, lit))
        return replace(world, media=(*world.media, air))

    def check(self, moments: tuple[Weather, ...]) -> None:
        """Any parameters fit any scene."""

    def facts(self) -> dict[str, float]:
        """Nothing is prepared."""
        return {}


def prepare(preparation: Preparation) -> SmogEntity:
    """Smog needs nothing of the field but its light."""
    eye = np.median(preparation.camera_positions, axis=0)[None].astype(np.float32)
    eye = to_device(eye, device_of(preparation.field))
    return SmogEntity(preparation.scene.ground_z, eye)
