"""What a package needs that adds a weather effect; see `examples/03_new_effect.py`.

    import climatenerf.extend as extend

    ASH = extend.Effect("ash", Ash, enabled_by=("depth",), prepare="my_package.entity:prepare", ...)

The package names its effect in its own pyproject.toml, and `climatenerf render` then has its flags:

    [project.entry-points."climatenerf.effects"]
    ash = "my_package:ASH"

Importing this module loads no torch; `BakedSnow`, `Samples`, `World` and the functions that need it
are imported when they are first used.
"""

import importlib

from climatenerf.core.layer_table import Layer
from climatenerf.weather.effect import Effect, Measure
from climatenerf.weather.registry import EFFECTS, check_effects
from climatenerf.weather.units import (
    ANGLE,
    DURATION,
    LENGTH,
    PER_LENGTH,
    SPEED,
    number,
    quantity,
    triple,
)

__all__ = [
    "ANGLE",
    "DURATION",
    "EFFECTS",
    "LENGTH",
    "PER_LENGTH",
    "SPEED",
    "Effect",
    "Layer",
    "Measure",
    "check_effects",
    "number",
    "quantity",
    "triple",
]

_LAZY = {
    "BakedSnow": "climatenerf.weather.snow.layer",
    "bake_snow": "climatenerf.weather.snow.layer",
    "observed": "climatenerf.field.protocol",
    "Preparation": "climatenerf.weather.world",
    "Samples": "climatenerf.core.samples",
    "World": "climatenerf.weather.world",
}


def __getattr__(name: str) -> object:
    """Import a name that needs torch when it is first used."""
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_LAZY[name]), name)


def __dir__() -> list[str]:
    """List the names for authors of effects."""
    return sorted([*__all__, *_LAZY])
