"""Files of measured layers (depth, normals, water depth, ...).

Layers are float32 arrays of the frame's size. NPZ and EXR store them exactly; PNG stores them
rounded to the layer's `png_step`. Depth without a surface is +inf in NPZ and EXR, and 0 in PNG.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from climatenerf.core.errors import UserError
from climatenerf.core.layer_table import Layer
from climatenerf.core.storage import atomic_path
from climatenerf.output.video import SIMULATED, write_png
from climatenerf.weather.registry import layer_table

LayerFormat = Literal["npz", "png", "exr"]


def save_layers(
    folder: Path | str,
    stem: str,
    layers: Mapping[str, Float[np.ndarray, "h w *c"]],
    formats: Sequence[LayerFormat] = ("npz",),
    table: Mapping[str, Layer] | None = None,
) -> dict[str, list[str]]:
    """Write the layers of a frame as ``folder/NAME/STEM.FORMAT``.

    Args:
        folder: folder of the movie.
        stem: the frame's file name without suffix, e.g. ``0007``.
        layers: names of the table with (h, w) values, (h, w, 3) for ``normal``.
        formats: any of npz (one array with the layer's name), png (see `png_values`), exr.
        table: all layers that a frame can have; None takes those of the built-in effects.

    Returns:
        The paths written for each layer, relative to ``folder``.

    Raises:
        UserError: a file cannot be written, or EXR is requested without the OpenEXR package.
        ValueError: a layer has an unknown name or a wrong shape.
    """
    table = layer_table() if table is None else table
    written: dict[str, list[str]] = {}
    for name, values in layers.items():
        # Supersampled layers are views with strides, which OpenEXR ignores.
        array = np.ascontiguousarray(values, dtype=np.float32)
        if name not in table or array.shape[2:] != ((3,) if name == "normal" else ()):
            raise ValueError(f"no layer {name!r} of shape {array.shape}; see layer_table")
        for kind in formats:
            path = Path(folder) / name / f"{stem}.{kind}"
            if kind == "npz":
                arrays: dict[str, Any] = {name: array}
                with atomic_path(path) as temporary:
                    np.savez_compressed(temporary, **arrays)
            elif kind == "png":
                write_png(path, png_values(table[name], array), f"{name}; {SIMULATED}")
            else:
                _write_exr(path, table[name], array)
            written.setdefault(name, []).append(f"{name}/{path.name}")
    return written


def png_values(layer: Layer, array: Float[np.ndarray, "h w *c"]) -> np.ndarray:
    """Return a layer as PNG grey levels, 8 or 16 bits.

    Values out of range saturate (65.535 m for depth in 16-bit millimetres); values that are not
    finite become 0. A positive depth below one grey level becomes 1, as 0 means no surface.
    """
    top = 2**layer.png_bits - 1
    finite = np.where(np.isfinite(array), array, 0.0).astype(np.float64)
    levels = (finite + 1) / 2 * top if layer.png_step is None else finite / layer.png_step
    if layer.name == "depth":
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


def _write_exr(path: Path, layer: Layer, array: np.ndarray) -> None:
    require_exr()
    import OpenEXR  # pyright: ignore[reportMissingImports]

    # By convention a single channel is Z for depth and Y (luminance) otherwise; viewers show both.
    single = "Z" if layer.name == "depth" else "Y"
    channels = {single: array} if array.ndim == 2 else dict(zip("XYZ", _planes(array), strict=True))
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "comments": f"{layer.name} [{layer.unit}]: {layer.meaning}; {SIMULATED}",
    }
    with atomic_path(path) as temporary:
        try:
            OpenEXR.File(header, channels).write(str(temporary))
        except RuntimeError as error:
            raise UserError(f"could not write {path}: {error}; check the disk") from error


def _planes(array: np.ndarray) -> list[np.ndarray]:
    return [np.ascontiguousarray(array[..., i]) for i in range(array.shape[-1])]
