"""Files of measured layers (depth, normals, water depth, ...).

Layers are float32 arrays of the frame's size. NPZ and EXR store them exactly; PNG stores them
rounded to the step in `LAYERS`. Depth without a surface is +inf in NPZ and EXR, and 0 in PNG.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from climatenerf.core.classes import CLASS_NAMES
from climatenerf.core.errors import UserError
from climatenerf.core.storage import atomic_path
from climatenerf.output.video import SIMULATED, write_png

LayerFormat = Literal["npz", "png", "exr"]


@dataclass(frozen=True)
class Layer:
    """How a layer is stored.

    Attributes:
        unit: Unit of the float values, as the sidecar names it.
        meaning: One line for the sidecar.
        png_step: Value of one grey level of the PNG; None for normals, which are (n + 1) / 2.
        png_bits: 8 or 16.
    """

    unit: str
    meaning: str
    png_step: float | None
    png_bits: Literal[8, 16]


CLASSES = ", ".join(f"{number} {name}" for number, name in enumerate(CLASS_NAMES))
LAYERS: dict[str, Layer] = {
    "depth": Layer("m", "distance along the ray; no surface: +inf (PNG 0)", 1e-3, 16),
    "normal": Layer("1", "surface normal in world axes; no surface: 0 0 0 (PNG 128)", None, 8),
    "label": Layer("1", f"class of the dry scene: {CLASSES}", 1.0, 8),
    "water_depth": Layer("m", "water above the ground where water is seen, else 0", 1e-3, 16),
    "transmittance": Layer("1", "share of the surface's light that passes the air", 1 / 65535, 16),
    "snow_thickness": Layer("m", "snow upon the surface that is seen, else 0", 1e-4, 16),
    "mask_water": Layer("1", "share of the pixel that shows water", 1 / 255, 8),
    "mask_snow": Layer("1", "share of the pixel that shows snow", 1 / 255, 8),
    "mask_smog": Layer("1", "share of the pixel's light that smog added", 1 / 255, 8),
}


def save_layers(
    folder: Path | str,
    stem: str,
    layers: Mapping[str, Float[np.ndarray, "h w *c"]],
    formats: Sequence[LayerFormat] = ("npz",),
) -> dict[str, list[str]]:
    """Write the layers of a frame as ``folder/NAME/STEM.FORMAT``.

    Args:
        folder: folder of the movie.
        stem: the frame's file name without suffix, e.g. ``0007``.
        layers: names of `LAYERS` with (h, w) values, (h, w, 3) for ``normal``.
        formats: any of npz (one array with the layer's name), png (rounded, see `LAYERS`), exr.

    Returns:
        The paths written for each layer, relative to ``folder``.

    Raises:
        UserError: a file cannot be written, or EXR is requested without the OpenEXR package.
        ValueError: a layer has an unknown name or a wrong shape.
    """
    written: dict[str, list[str]] = {}
    for name, values in layers.items():
        array = np.asarray(values, dtype=np.float32)
        if name not in LAYERS or array.shape[2:] != ((3,) if name == "normal" else ()):
            raise ValueError(f"no layer {name!r} of shape {array.shape}; see LAYERS")
        for kind in formats:
            path = Path(folder) / name / f"{stem}.{kind}"
            if kind == "npz":
                arrays: dict[str, Any] = {name: array}
                with atomic_path(path) as temporary:
                    np.savez_compressed(temporary, **arrays)
            elif kind == "png":
                write_png(path, png_values(name, array), f"{name}; {SIMULATED}")
            else:
                _write_exr(path, name, array)
            written.setdefault(name, []).append(f"{name}/{path.name}")
    return written


def png_values(name: str, array: Float[np.ndarray, "h w *c"]) -> np.ndarray:
    """Return a layer as PNG grey levels, 8 or 16 bits.

    Values out of range saturate (65.535 m for depth in 16-bit millimetres); values that are not
    finite become 0. A positive depth below one grey level becomes 1, as 0 means no surface.
    """
    layer = LAYERS[name]
    top = 2**layer.png_bits - 1
    finite = np.where(np.isfinite(array), array, 0.0).astype(np.float64)
    levels = (finite + 1) / 2 * top if layer.png_step is None else finite / layer.png_step
    if name == "depth":
        levels = np.where(finite > 0, np.maximum(levels, 1.0), 0.0)
    return np.clip(np.rint(levels), 0, top).astype(np.uint8 if layer.png_bits == 8 else np.uint16)


def require_exr() -> None:
    """Raise UserError if EXR cannot be written; call this before hours of rendering."""
    try:
        import OpenEXR  # noqa: F401  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise UserError(
            "EXR layers need the OpenEXR package; run `pip install climatenerf[exr]`, or choose npz"
        ) from error


def _write_exr(path: Path, name: str, array: np.ndarray) -> None:
    require_exr()
    import OpenEXR  # pyright: ignore[reportMissingImports]

    # By convention a single channel is Z for depth and Y (luminance) otherwise; viewers show both.
    single = "Z" if name == "depth" else "Y"
    channels = {single: array} if array.ndim == 2 else dict(zip("XYZ", _planes(array), strict=True))
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "comments": f"{name} [{LAYERS[name].unit}]: {LAYERS[name].meaning}; {SIMULATED}",
    }
    with atomic_path(path) as temporary:
        try:
            OpenEXR.File(header, channels).write(str(temporary))
        except RuntimeError as error:
            raise UserError(f"could not write {path}: {error}; check the disk") from error


def _planes(array: np.ndarray) -> list[np.ndarray]:
    return [np.ascontiguousarray(array[..., i]) for i in range(array.shape[-1])]
