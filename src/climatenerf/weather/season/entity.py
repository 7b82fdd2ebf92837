"""A season in a scene: its colours, and how they depend on what the photos show."""

import functools
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.core.classes import SOLID, SOLID_OF
from climatenerf.core.device import to_device, to_numpy
from climatenerf.core.errors import UserError
from climatenerf.field.capabilities import CLASSES
from climatenerf.field.protocol import RadianceField, device_of
from climatenerf.ops.recolouring import ClassColours, mottle
from climatenerf.scene.photo_rays import PhotoRays
from climatenerf.weather.light.relit_field import RelitField
from climatenerf.weather.season.palettes import palettes_of, seasonal_style
from climatenerf.weather.season.styled_field import StyledField
from climatenerf.weather.style import Style, weakened
from climatenerf.weather.weather import Weather
from climatenerf.weather.world import Preparation, World

EVERY = 7  # ends of photo rays from one whose colour is looked up to the next


class SeasonEntity:
    """Finds the mean colours of classes when a frame first needs them."""

    def __init__(self, preparation: Preparation):
        """Take the preparation; nothing is computed yet."""
        self._given = preparation
        self._noise: tuple[int, Float[Tensor, "z y x"]] | None = None

    @functools.cached_property
    def _means(self) -> dict[int, Float[np.ndarray, "3"]]:
        """Mean linear colours of the classes that a season changes, over all photos."""
        given = self._given
        assert given.photo_rays is not None, "`check` refuses fields without classes"
        colours = photographed_colours(given.field, given.photo_rays(), given.appearance)
        return {kind: shown.mean(0) for kind, shown in colours.items() if len(shown)}

    def _mottle(self, seed: int) -> Float[Tensor, "z y x"]:
        """The noise of a seed; the last one is kept."""
        if self._noise is None or self._noise[0] != seed:
            self._noise = seed, mottle(seed).to(device_of(self._given.field))
        return self._noise[1]

    def _style(self, weather: Weather) -> Style | None:
        """The new colours: of the season, or of the run."""
        season = weather.season
        if season.strength == 0:
            return None
        if season.kind == "captured":
            style = self._given.style
            return style if style is not None and style.classes else None
        palettes = palettes_of(season.kind)
        return seasonal_style(season.kind, palettes, self._means, season.patch, weather.seed)

    def place(self, world: World, weather: Weather, time: float) -> World:
        """The world with the field in the season's colours."""
        style = self._style(weather)
        if style is None:
            return world
        white = torch.ones(3, device=device_of(world.field))
        if isinstance(world.field, RelitField):
            old, new = world.field.old.open_irradiance(), world.field.new.open_irradiance()
            white = new / old.clamp_min(1e-6)  # a black scene: 0/0
        shown = weakened(style, weather.season.strength)
        field = styled_field(world.field, shown, self._mottle(style.seed), white)
        return replace(world, field=field)

    def check(self, moments: tuple[Weather, ...]) -> None:
        """Refuse a season where the field does not know plants from walls.

        Raises:
            UserError: the field has no classes.
        """
        asked = {moment.season.kind for moment in moments} - {"captured"}
        if asked and CLASSES not in self._given.field.capabilities:
            raise no_classes(f"--season.kind {min(asked)}")

    def facts(self) -> dict[str, float]:
        """Nothing is measured."""
        return {}


def styled_field(
    field: RadianceField,
    style: Style,
    noise: Float[Tensor, "z y x"],
    white: Float[Tensor, "3"],
) -> StyledField:
    """Return a field in the colours of a style.

    Args:
        field: a field with classes.
        style: the new colours.
        noise: `mottle` of the style's seed.
        white: light that the field is shown in over that of its photos.
    """
    classes = class_colours(style, device_of(field))
    return StyledField(field, classes, style.patch, noise, white)


def prepare(preparation: Preparation) -> SeasonEntity:
    """Colours are found when a frame first needs them."""
    return SeasonEntity(preparation)


def class_colours(style: Style, device: torch.device) -> ClassColours:
    """Return the classes of a style as tensors; shorter palettes repeat their last colour."""
    longest = max((len(each.palette) for each in style.classes), default=1)
    parts = style.classes

    def tensor(values: list[Any], *shape: int) -> Tensor:
        return to_device(np.array(values, np.float32).reshape(len(parts), *shape), device)

    def whole(values: list[int]) -> Tensor:
        return to_device(np.array(values, np.int64), device)

    padded = [
        [*each.palette, *[each.palette[-1]] * (longest - len(each.palette))] for each in parts
    ]
    return ClassColours(
        whole([int(SOLID_OF[each.kind]) for each in parts]),
        tensor([each.strength for each in parts]),
        tensor([each.gate for each in parts]),
        tensor(padded, longest, 3),
        whole([len(each.palette) for each in parts]),
        tensor([each.matrix for each in parts], 3, 3),
    )


def no_classes(what: str) -> UserError:
    """Return the error of a season or style on a field that has no classes."""
    return UserError(
        f"{what} needs a field that knows plants from walls; fit it without --loss classes=0, to a"
        " capture with labels"
    )


@torch.no_grad()
def photographed_colours(
    field: RadianceField, photos: list[PhotoRays], appearance: Float[Tensor, "1 e"] | None
) -> dict[int, Float[np.ndarray, "n 3"]]:
    """Return linear colours of each class where photo rays end on a field, some of them.

    Args:
        field: the fitted field.
        photos: where its photo rays end.
        appearance: exposure and light of the colours; None: the mean of all photos.
    """
    device = device_of(field)
    found: dict[int, list[Float[np.ndarray, "n 3"]]] = {int(kind): [] for kind in SOLID}
    for photo in photos:
        for kind, parts in found.items():
            shown = (photo.label == kind) & (photo.t < float("inf"))
            x, d = (
                to_device(each[shown][::EVERY].astype(np.float32), device)
                for each in (photo.x, photo.d)
            )
            if x.shape[0]:
                parts.append(to_numpy(field.colour(x, d, appearance=appearance)))
    return {
        kind: np.concatenate(parts) if parts else np.zeros((0, 3)) for kind, parts in found.items()
    }
