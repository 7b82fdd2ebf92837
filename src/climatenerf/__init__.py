"""climatenerf: render a real place from photos in physically based smog, flood and snow.

The public names are listed by `dir(climatenerf)` and described in `climatenerf.api`. Importing this
package does not import torch or numba; each name is imported when it is first used.
"""

import importlib

__version__ = "0.1.0"

_PUBLIC = {
    "extend": "climatenerf.extend",
    "open_scene": "climatenerf.api",
    "fit": "climatenerf.api",
    "load_run": "climatenerf.api",
    "render_movie": "climatenerf.api",
    "evaluate": "climatenerf.api",
    "RenderSession": "climatenerf.render.session",
    "Weather": "climatenerf.weather.weather",
    "Smog": "climatenerf.weather.smog.parameters",
    "Flood": "climatenerf.weather.flood.parameters",
    "Snow": "climatenerf.weather.snow.parameters",
    "Sun": "climatenerf.weather.light.parameters",
}


def __getattr__(name: str) -> object:
    """Import a public name when it is first used."""
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = importlib.import_module(_PUBLIC[name])
    value = module if name == "extend" else getattr(module, name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """List the public names, and no submodule that happens to be loaded."""
    return sorted([*_PUBLIC, *(name for name in globals() if name.startswith("__"))])
