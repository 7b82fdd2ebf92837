"""The JSON sidecar of a movie: weather, cameras, layers and units of its frames."""

import importlib.metadata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

import climatenerf
from climatenerf.core.layer_table import Layer
from climatenerf.output.video import SIMULATED
from climatenerf.scene import Camera, Scene
from climatenerf.weather.registry import layer_table

SIDECAR_SCHEMA = 1


@dataclass(frozen=True)
class FrameRecord:
    """Entry of one frame in the sidecar.

    Attributes:
        file: Path of the picture, relative to the sidecar.
        time: Moment of the movie, s.
        camera: Intrinsics, pixels.
        c2w: Camera-to-world pose, world m, OpenCV axes.
        layers: Layer files by name, as `save_layers` returns them.
        weather: Weather parameters at this moment, with units.
        measured: Numbers measured on this frame, such as the fraction under water.
    """

    file: str
    time: float
    camera: Camera
    c2w: Float[np.ndarray, "4 4"]
    layers: Mapping[str, list[str]]
    weather: Mapping[str, Any] | None = None
    measured: Mapping[str, float] | None = None


def sidecar(
    scene: Scene,
    records: Sequence[FrameRecord],
    weather: Mapping[str, Any],
    seed: int,
    about: Mapping[str, Any] | None = None,
    table: Mapping[str, Layer] | None = None,
) -> dict[str, Any]:
    """Return the content of the JSON file beside a movie: all that is needed to use it as data.

    Args:
        scene: the capture, for the frame of reference, the scale and its error.
        records: one for each frame.
        weather: all weather parameters with their units.
        seed: random seed of the weather.
        about: further entries (camera path and its notes, frames per second).
        table: all layers that a frame can have; default: those of the built-in effects.
    """
    table = layer_table() if table is None else table
    used = {name for record in records for name in record.layers}
    return {
        "schema_version": SIDECAR_SCHEMA,
        "simulated": True,
        "note": SIMULATED,
        "weather": weather,
        "seed": seed,
        **(about or {}),
        "versions": versions(),
        "units": {
            "length": "m",
            "angle": "deg",
            "colour": "8-bit sRGB",
            "pixels": "centre of the top-left pixel at (0.5, 0.5)",
            "world": "right-handed, z up",
            "camera": "camera-to-world, +x right, +y down, +z forward",
        },
        "scale": {
            "source": scene.scale_source,
            "relative_error": scene.scale_error,
            "metres_per_input_unit": scene.scale,
            "assumed": "assumed" in scene.scale_source,
        },
        "ground_z": scene.ground_z,
        "lowest_ground_z": scene.lowest_ground_z,
        "world_from_input": scene.world_from_input,
        "layers": {
            name: {
                "unit": table[name].unit,
                "meaning": table[name].meaning,
                "png": "(n + 1) / 2 * 255"
                if table[name].png_step is None
                else {"bits": table[name].png_bits, "value_of_one": table[name].png_step},
            }
            for name in sorted(used)
        },
        "frames": [_frame_entry(record, scene) for record in records],
    }


def c2w_in_input_frame(c2w: Float[np.ndarray, "4 4"], scene: Scene) -> Float[np.ndarray, "4 4"]:
    """Return a world pose in the capture's own frame: position in its units, pure rotation."""
    back = np.linalg.inv(scene.world_from_input) @ c2w
    back[:3, :3] *= scene.scale
    return back


def versions() -> dict[str, str | None]:
    """Return the versions of the packages that compute the pictures; None for absent ones."""
    found: dict[str, str | None] = {"climatenerf": climatenerf.__version__}
    for package in ("torch", "numpy", "numba"):
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = None
    return found


def _frame_entry(record: FrameRecord, scene: Scene) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "file": record.file,
        "time": record.time,
        "camera": record.camera,
        "c2w_world": record.c2w,
        "c2w_input": c2w_in_input_frame(record.c2w, scene),
        "layers": record.layers,
    }
    if record.weather is not None:
        entry["weather"] = record.weather
    if record.measured is not None:
        entry["measured"] = record.measured
    return entry
