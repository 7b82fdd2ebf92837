"""What a package needs that adds a weather effect; see `examples/03_new_effect.py`.

    import climatenerf.extend as extend

    ASH = extend.Effect("ash", Ash, enabled_by=("depth",), prepare="my_package.entity:prepare", ...)

The package names its effect in its own pyproject.toml, and `climatenerf render` then has its flags:

    [project.entry-points."climatenerf.effects"]
    ash = "my_package:ASH"

Importing this module does not import torch; the types of the renderer, such as `World` and
`Samples`, and the functions that need torch are imported when they are first used.
"""

import importlib

from climatenerf.core.errors import UserError
from climatenerf.core.layer_table import Layer
from climatenerf.field.capabilities import (
    APPEARANCE,
    CLASSES,
    DENSITY,
    FUSED,
    NORMALS,
    OBSERVED,
)
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
    "APPEARANCE",
    "CLASSES",
    "DENSITY",
    "DURATION",
    "EFFECTS",
    "FUSED",
    "LENGTH",
    "NORMALS",
    "OBSERVED",
    "PER_LENGTH",
    "SPEED",
    "Effect",
    "Layer",
    "Measure",
    "UserError",
    "check_effects",
    "number",
    "quantity",
    "triple",
]

_LAZY = {
    "BakedSnow": "climatenerf.weather.snow.layer",
    "bake_snow": "climatenerf.weather.snow.layer",
    "device_of": "climatenerf.field.protocol",
    "observed": "climatenerf.field.protocol",
    "Matter": "climatenerf.weather.world",
    "Medium": "climatenerf.weather.world",
    "Preparation": "climatenerf.weather.world",
    "RaySamples": "climatenerf.weather.world",
    "Samples": "climatenerf.core.samples",
    "Surface": "climatenerf.weather.world",
    "SurfaceHits": "climatenerf.weather.world",
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
