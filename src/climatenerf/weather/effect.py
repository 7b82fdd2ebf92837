"""What a weather effect is: one package, described by one `Effect`. Does not import torch.

An effect states its parameters, the layers it writes, what it needs of a field and what its
preparation depends on. Its entity, which does the physics, is loaded when the effect is present:
`prepare` runs once for a scene, `Entity.place` once a frame. The tuple `registry.EFFECTS` lists the
built-in effects; an installed package adds its own through the entry-point group
`climatenerf.effects`. Tensors of an effect are on the device of the rays that it receives; before
there are rays, `field.protocol.device_of` has it.
"""

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Protocol

from climatenerf.core.errors import UserError, one_line
from climatenerf.core.layer_table import Layer
from climatenerf.weather.units import Parameter, parameters_of

if TYPE_CHECKING:
    from climatenerf.weather.weather import Weather
    from climatenerf.weather.world import Preparation, World


class Entity(Protocol):
    """What an effect puts into a scene, prepared for it."""

    def place(self, world: "World", weather: "Weather", time: float) -> "World":
        """The world with this effect in it, at one moment.

        Args:
            world: what earlier effects have placed; see `Effect.after`.
            weather: all parameters at this moment.
            time: seconds into the movie.
        """
        ...

    def check(self, moments: "tuple[Weather, ...]") -> None:
        """Refuse parameters that do not fit the scene, before anything is rendered.

        Raises:
            UserError: a parameter does not fit.
        """
        ...

    def facts(self) -> Mapping[str, float]:
        """Numbers about the prepared effect for the sidecar, with units in their names."""
        ...


@dataclass(frozen=True)
class Measure:
    """A number about each frame, for the sidecar: the mean of a layer.

    Attributes:
        name: Key in the sidecar, with its unit.
        layer: The layer whose mean is taken: of any effect, or one that every frame has.
        mask: Only over pixels where this layer is above 0.5; None: over the whole frame.
    """

    name: str
    layer: str
    mask: str | None = None


@dataclass(frozen=True)
class Effect:
    """Description of a weather effect.

    Attributes:
        name: Section of the weather file and prefix of the flags: letters, digits, underscores.
        parameters: Frozen dataclass with a default for each field, and a `units.Parameter` in each
            annotation. Its module does not import torch.
        enabled_by: Fields that put the effect into the scene when one of them is not None.
        prepare: "package.module:function", or the function: takes a `world.Preparation` and returns
            an `Entity`. None: the section only informs other effects.
        layers: Layers that the effect writes.
        measures: Numbers about each frame.
        alternatives: Pairs of fields for one thing. A flag for one resets the other, and where both
            default to None only one may be given.
        only_with: Fields that need another field of the effect to have one of some values.
        only_beside: Fields that need one of other fields to differ from its default.
        needs: Capabilities that the field must have; see `field.protocol`.
        after: Names of effects that are placed before this one, because it reads what they place.
        prepared_from: Parameters ("snow.fall_tilt", "seed") whose change prepares the entity again.
            A change of any other parameter only places it anew.
        version: Version of the effect's code. A new one renders finished frames again.
        always: Placed in every frame, with any parameters.
    """

    name: str
    parameters: type
    enabled_by: tuple[str, ...]
    prepare: "str | Callable[[Preparation], Entity] | None"
    layers: tuple[Layer, ...] = ()
    measures: tuple[Measure, ...] = ()
    alternatives: tuple[tuple[str, str], ...] = ()
    only_with: tuple[tuple[str, str, tuple[str | None, ...]], ...] = ()
    only_beside: tuple[tuple[str, tuple[str, ...]], ...] = ()
    needs: frozenset[str] = frozenset()
    after: tuple[str, ...] = ()
    prepared_from: tuple[str, ...] = ()
    version: str = ""
    always: bool = False

    def present(self, section: Any) -> bool:
        """Whether parameters put this effect into the scene."""
        return any(getattr(section, name) is not None for name in self.enabled_by)

    def fields(self) -> dict[str, Parameter]:
        """Unit and range of each parameter, by name."""
        return parameters_of(self.parameters)

    def defaults(self) -> dict[str, Any]:
        """Default of each parameter, by name."""
        return {item.name: item.default for item in fields(self.parameters)}

    def load(self) -> "Callable[[Preparation], Entity] | None":
        """The function that prepares the entity; its module is imported here.

        Raises:
            UserError: the module cannot be imported, or has no such function.
        """
        if not isinstance(self.prepare, str):
            return self.prepare
        module, _, function = self.prepare.partition(":")
        try:
            return getattr(importlib.import_module(module), function)
        except (ImportError, AttributeError) as error:
            raise UserError(
                f"the prepare function {self.prepare!r} of the weather effect {self.name!r} does"
                f" not load ({one_line(str(error), 200)}); correct its name, or install what it"
                " needs"
            ) from error
