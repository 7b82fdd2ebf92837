"""The list of weather effects, and what follows from it. Does not import torch.

The functions take the tuple of effects as an argument. To add an effect, write its package and add
one line to `EFFECTS`, or install a package with an entry point in the group `climatenerf.effects`
that names its `Effect`.
"""

import dataclasses
import functools
import importlib.metadata
from collections.abc import Sequence

from climatenerf.core.errors import UserError, one_line
from climatenerf.core.layer_table import FRAME_LAYERS, ON_DEMAND, RESERVED_NAMES, Layer
from climatenerf.weather.effect import Effect
from climatenerf.weather.flood.parameters import FLOOD
from climatenerf.weather.light.parameters import SKY, SUN
from climatenerf.weather.season.parameters import SEASON
from climatenerf.weather.smog.parameters import SMOG
from climatenerf.weather.snow.parameters import SNOW
from climatenerf.weather.units import Parameter

EFFECTS: tuple[Effect, ...] = (SKY, SEASON, SMOG, FLOOD, SNOW, SUN)
ENTRY_POINTS = "climatenerf.effects"
MEAN_TRANSMITTANCE, COMPLETED_GROUND = "mean_transmittance", "completed_ground_fraction"
FRAME_MEASURES = (MEAN_TRANSMITTANCE, COMPLETED_GROUND)
"""Measures of every frame."""


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
        UserError: two effects share a name, a layer or a measure; a name is reserved or is no
            identifier; `after` names an effect that is absent or makes a circle; or an effect
            refers to a parameter, layer or function that does not exist.
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
        _check_parameters(effect)
    in_order(effects)
    _check_references(effects)
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


def _check_parameters(effect: Effect) -> None:
    """Refuse a description that does not match the effect's own parameters.

    Raises:
        UserError: a field without unit or default, a name that is no field, or a `prepare` that is
            no function.
    """
    what = f"the weather effect {effect.name!r}"
    try:
        names, defaults = effect.fields(), effect.defaults()
    except (TypeError, NameError) as error:
        raise UserError(
            f"the parameters of {what} are no dataclass with a unit and range for each field"
            f" ({one_line(str(error), 200)}); correct them"
        ) from error
    for name, default in defaults.items():
        if default is dataclasses.MISSING:
            raise UserError(f"{what} gives its parameter {name!r} no default; add one")
    listed = {
        "enabled_by": effect.enabled_by,
        "alternatives": sum(effect.alternatives, ()),
        "only_with": tuple(each for name, other, _ in effect.only_with for each in (name, other)),
        "only_beside": tuple(
            each for name, others in effect.only_beside for each in (name, *others)
        ),
    }
    for attribute, given in listed.items():
        for name in given:
            if name not in names:
                raise UserError(
                    f"{what} has no parameter {name!r}, which its {attribute} names; use"
                    f" {' or '.join(names)}"
                )
    if isinstance(effect.prepare, str):
        module, _, function = effect.prepare.partition(":")
        words = [*module.split("."), function]
        valid = all(word.isidentifier() for word in words)
    else:
        valid = effect.prepare is None or callable(effect.prepare)
    if not valid:
        raise UserError(
            f"{what} has the prepare function {effect.prepare!r}; write it as"
            ' "package.module:function"'
        )


def _check_references(effects: Sequence[Effect]) -> None:
    """Refuse effects that refer to parameters or layers of no effect, or share a measure.

    Raises:
        UserError: such a reference.
    """
    values = {"seed", *(effect.name for effect in effects), *parameters(effects)}
    layers = layer_table(effects).keys() - ON_DEMAND
    measures: dict[str, str] = dict.fromkeys(FRAME_MEASURES, "every frame")
    for effect in effects:
        what = f"the weather effect {effect.name!r}"
        for name in effect.prepared_from:
            if name not in values:
                raise UserError(
                    f"{what} is prepared from {name!r}, which is no parameter of any effect; name"
                    f' it as "{effect.name}.{next(iter(effect.fields()), "parameter")}"'
                )
        for measure in effect.measures:
            for layer in filter(None, (measure.layer, measure.mask)):
                if layer not in layers:
                    raise UserError(
                        f"the measure {measure.name!r} of {what} reads the layer {layer!r}, which"
                        f" not every frame has; use one of {', '.join(sorted(layers))}"
                    )
            if measure.name in measures:
                raise UserError(
                    f"the measure {measure.name!r} is a number of {measures[measure.name]} and of"
                    f" {what}; rename one"
                )
            measures[measure.name] = what


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
