"""The list of weather effects, and what follows from it. Loads no torch.

The functions take the tuple of effects as an argument. To add an effect, write its package and add
one line to `EFFECTS`, or install a package with an entry point in the group `climatenerf.effects`
that names its `Effect`.
"""

import functools
import importlib.metadata
from collections.abc import Sequence

from climatenerf.core.errors import UserError
from climatenerf.core.layer_table import FRAME_LAYERS, RESERVED_NAMES, Layer
from climatenerf.weather.effect import Effect
from climatenerf.weather.flood.parameters import FLOOD
from climatenerf.weather.light.parameters import SUN
from climatenerf.weather.smog.parameters import SMOG
from climatenerf.weather.snow.parameters import SNOW
from climatenerf.weather.units import Parameter

EFFECTS: tuple[Effect, ...] = (SMOG, FLOOD, SNOW, SUN)
ENTRY_POINTS = "climatenerf.effects"


@functools.cache
def installed_effects() -> tuple[Effect, ...]:
    """The built-in effects and those that installed packages add.

    Raises:
        UserError: a package's effect cannot be loaded, or clashes with another one.
    """
    effects = list(EFFECTS)
    for point in sorted(importlib.metadata.entry_points(group=ENTRY_POINTS), key=lambda p: p.name):
        try:
            effect = point.load()
        except Exception as error:  # whatever a foreign package raises
            raise UserError(
                f"the weather effect {point.value} does not load ({type(error).__name__}: {error});"
                " fix or uninstall its package"
            ) from error
        if not isinstance(effect, Effect):
            raise UserError(f"{point.value} is no climatenerf Effect; fix or uninstall its package")
        effects.append(effect)
    return check_effects(tuple(effects))


def check_effects(effects: Sequence[Effect], reserved: Sequence[str] = ()) -> tuple[Effect, ...]:
    """The effects themselves, if they can be used together.

    Args:
        effects: built-in and added ones.
        reserved: names of flags that no effect may take.

    Raises:
        UserError: two effects share a name or a layer, a name is reserved or is no identifier, or
            `after` names an effect that is absent or makes a circle.
    """
    names: set[str] = set()
    layers = {layer.name: "every frame" for layer in FRAME_LAYERS}
    for effect in effects:
        if not effect.name.isidentifier() or effect.name in {"seed", *reserved}:
            raise UserError(
                f"a weather effect cannot be named {effect.name!r}: --{effect.name} is another flag"
                " or no valid name; rename the effect"
            )
        if effect.name in names:
            raise UserError(
                f"two weather effects are named {effect.name!r}, so --{effect.name}.* is ambiguous;"
                " rename one, or uninstall its package"
            )
        names.add(effect.name)
        for layer in effect.layers:
            _check_layer_name(effect, layer)
            key = layer.name.lower()  # of a folder; some file systems ignore case
            if key in layers:
                raise UserError(
                    f"the layer {layer.name!r} is written by {layers[key]} and by the effect"
                    f" {effect.name!r}; rename one"
                )
            layers[key] = f"the effect {effect.name!r}"
    in_order(effects)
    return tuple(effects)


def _check_layer_name(effect: Effect, layer: Layer) -> None:
    """Refuse a layer whose folder would lie elsewhere or hold other files of a render.

    Raises:
        UserError: the name is reserved or is no identifier.
    """
    if not layer.name.isidentifier() or layer.name.lower() in RESERVED_NAMES:
        raise UserError(
            f"a layer of the weather effect {effect.name!r} cannot be named {layer.name!r}, because"
            " its files go into a folder of that name; give it another name of letters, digits and"
            " underscores"
        )


def in_order(effects: Sequence[Effect]) -> tuple[Effect, ...]:
    """The effects in the order in which they are placed, each behind those in its `after`.

    Raises:
        UserError: `after` names an effect that is absent, or makes a circle.
    """
    waiting, placed = list(effects), []
    while waiting:
        done = {effect.name for effect in placed}
        free = next((effect for effect in waiting if done.issuperset(effect.after)), None)
        if free is None:
            raise UserError(
                f"the weather effect {waiting[0].name!r} is placed after"
                f" {', '.join(waiting[0].after)}, which is absent or waits for it; change its after"
            )
        waiting.remove(free)
        placed.append(free)
    return tuple(placed)


def parameters(effects: Sequence[Effect]) -> dict[str, Parameter]:
    """Unit and range of every parameter, by names such as "flood.wind_speed"."""
    return {
        f"{effect.name}.{name}": parameter
        for effect in effects
        for name, parameter in effect.fields().items()
    }


def layer_table(effects: Sequence[Effect] = EFFECTS) -> dict[str, Layer]:
    """All layers that frames can have, by name."""
    own = (layer for effect in effects for layer in effect.layers)
    return {layer.name: layer for layer in (*FRAME_LAYERS, *own)}
