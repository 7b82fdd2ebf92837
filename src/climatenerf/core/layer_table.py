"""What a measured layer of a frame is: name, unit, meaning, storage. Does not import torch.

The layers of every frame are here; each weather effect adds its own (`weather.registry`).
"""

from dataclasses import dataclass
from typing import Literal

from climatenerf.core.classes import CLASS_NAMES


@dataclass(frozen=True)
class Layer:
    """How one layer is named, read and stored.

    Attributes:
        name: Name of its folder, its array and its entry in the sidecar: an identifier that is not
            in `RESERVED_NAMES`.
        unit: Unit of the float32 values, as the sidecar names it.
        meaning: One line for the sidecar.
        png_step: Value of one grey level of the PNG; None for unit vectors, stored as (n + 1) / 2.
        png_bits: Bits a channel of the PNG.
        no_data: Value of pixels that the layer does not apply to.
    """

    name: str
    unit: str
    meaning: str
    png_step: float | None
    png_bits: Literal[8, 16]
    no_data: float = 0.0


_CLASSES = ", ".join(f"{number} {name}" for number, name in enumerate(CLASS_NAMES))
FRAME_LAYERS = (
    Layer("depth", "m", "distance along the ray; no surface: +inf (PNG 0)", 1e-3, 16, float("inf")),
    Layer("normal", "1", "surface normal in world axes; no surface: 0 0 0 (PNG 128)", None, 8),
    Layer("label", "1", f"class of the dry scene: {_CLASSES}", 1.0, 8),
    Layer(
        "transmittance",
        "1",
        "fraction of light that the air transmits",
        1 / 65535,
        16,
        1.0,
    ),
    Layer(
        "seen",
        "1",
        "fraction of the dry pixel that photos show; the rest is completed ground",
        1 / 255,
        8,
        1.0,
    ),
)
"""Layers of every frame, whatever the weather."""
ON_DEMAND = frozenset({"normal", "label"})
"""Layers that are computed only for frames that write them."""
RESERVED_NAMES = frozenset({"frames", "movie", "preview"})
"""Names that a folder of a render uses itself, so that no layer can have them."""
