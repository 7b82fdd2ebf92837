"""A season in a scene: its colours, and how they depend on what the photos show."""

import functools
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.core.classes import SOLID_OF, TERRAIN, VEGETATION
from climatenerf.core.colour import luma
from climatenerf.core.device import to_device
from climatenerf.core.errors import UserError
from climatenerf.field.capabilities import CLASSES
from climatenerf.field.protocol import device_of
from climatenerf.weather.light.relit_field import RelitField
from climatenerf.weather.season.palettes import ClassPalette, palettes_of
from climatenerf.weather.season.recolouring import mottle
from climatenerf.weather.season.styled_field import ClassColours, StyledField
from climatenerf.weather.weather import Weather
from climatenerf.weather.world import Preparation, World

EVERY = 7  # ends of photo rays from one whose colour is looked up to the next
GREEN_LAWN = (0.75, 1.1, 0.45)  # mean colour of a class that no photo shows


class SeasonEntity:
    """Finds the mean colours of classes when a frame first needs them."""

    def __init__(self, preparation: Preparation):
        """Take the preparation; nothing is computed yet."""
        self._given = preparation
        self._noise: tuple[int, Float[Tensor, "z y x"]] | None = None

    @functools.cached_property
    def _means(self) -> dict[int, Float[Tensor, "3"]]:
        """Mean colours of classes over all photos, luminance 1."""
        field, photo_rays = self._given.field, self._given.photo_rays
        assert photo_rays is not None, "`check` refuses fields without classes"
        total = {kind: torch.zeros(3, device=device_of(field)) for kind in (VEGETATION, TERRAIN)}
        for photo in photo_rays():
            for kind, sums in total.items():
                shown = (photo.label == kind) & (photo.t < float("inf"))
                x, d = (
                    to_device(each[shown][::EVERY].astype("float32"), device_of(field))
                    for each in (photo.x, photo.d)
                )
                if x.shape[0]:
                    sums += field.colour(x, d, appearance=self._given.appearance).sum(0)
        white = torch.tensor(GREEN_LAWN, device=device_of(field))
        means = {kind: sums if float(luma(sums)) > 0 else white for kind, sums in total.items()}
        return {kind: mean / luma(mean) for kind, mean in means.items()}

    def _mottle(self, seed: int) -> Float[Tensor, "z y x"]:
        """The noise of a seed; the last one is kept."""
        if self._noise is None or self._noise[0] != seed:
            self._noise = seed, mottle(seed).to(device_of(self._given.field))
        return self._noise[1]

    def place(self, world: World, weather: Weather, time: float) -> World:
        """The world with the field in the season's colours."""
        season = weather.season
        if season.kind == "captured" or season.strength == 0:
            return world
        palettes = palettes_of(season.kind)
        classes = [
            self._colours(kind, palette, season.strength)
            for kind, palette in ((VEGETATION, palettes.vegetation), (TERRAIN, palettes.terrain))
            if palette is not None
        ]
        white = torch.ones(3, device=device_of(world.field))
        if isinstance(world.field, RelitField):
            old, new = world.field.old.open_irradiance(), world.field.new.open_irradiance()
            white = new / old.clamp_min(1e-6)  # a black scene: 0/0
        field = StyledField(
            world.field, tuple(classes), season.patch, self._mottle(weather.seed), white
        )
        return replace(world, field=field)

    def _colours(self, kind: int, palette: ClassPalette, strength: float) -> ClassColours:
        mean = self._means[kind]
        return ClassColours(
            int(SOLID_OF[kind]),
            mean.new_tensor(palette.palette),
            mean,
            palette.strength * strength,
            palette.brightness,
            palette.gate,
        )

    def check(self, moments: tuple[Weather, ...]) -> None:
        """Refuse a season where the field does not know plants from walls.

        Raises:
            UserError: the field has no classes.
        """
        asked = {moment.season.kind for moment in moments} - {"captured"}
        if asked and CLASSES not in self._given.field.capabilities:
            raise UserError(
                f"--season.kind {min(asked)} needs a field that knows plants from walls; fit it"
                " without --loss classes=0, to a capture with labels"
            )

    def facts(self) -> dict[str, float]:
        """Nothing is measured."""
        return {}


def prepare(preparation: Preparation) -> SeasonEntity:
    """Colours are found when a frame first needs them."""
    return SeasonEntity(preparation)
