"""What a click measures: the ray itself is traced, not the picture read."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from climatenerf.core.device import to_device
from climatenerf.field.protocol import device_of
from climatenerf.render.integrator import trace
from climatenerf.render.session import RenderSession
from climatenerf.weather.world import World

PIXEL = 1e-3  # rad, that the ray stands for


@dataclass(frozen=True)
class Measured:
    """What a ray meets.

    Attributes:
        distance: to what is seen, m; +inf for the sky.
        height: of what the dry scene shows there, m above the ground datum; NaN for the sky.
        water_depth: m; 0 where no water is seen.
        distance_error: standard error of the distance, m.
        height_error: of the height, m.
        water_error: of the water's depth, m.
    """

    distance: float
    height: float
    water_depth: float
    distance_error: float
    height_error: float
    water_error: float

    @property
    def sentence(self) -> str:
        """The measurement in words, with standard errors."""
        if not math.isfinite(self.distance):
            return "sky"
        parts = [f"distance {_text(self.distance, self.distance_error)}"]
        if math.isfinite(self.height):
            parts.append(f"ground or wall at {_text(self.height, self.height_error)}")
        if self.water_depth > 0:
            parts.append(f"water {_text(self.water_depth, self.water_error)} deep")
        return ", ".join(parts)


def _text(value: float, error: float) -> str:
    return f"{value:.2f} m" if error < 0.005 else f"{value:.2f} ± {error:.2f} m"


def measure(
    session: RenderSession,
    origin: Float[np.ndarray, "3"],
    direction: Float[np.ndarray, "3"],
    time: float = 0.0,
    depth_error: float = 0.0,
) -> Measured:
    """Trace one ray through the weather, and through the dry scene.

    The errors are those of the scale and of the field's depth, taken as independent. An error of
    depth moves the point along its ray, and so its height by the sine of the ray's elevation. What
    is read through water crosses the same depth.

    Args:
        session: weather in a scene.
        origin: world m.
        direction: of any length.
        time: moment, s.
        depth_error: relative error of the field's depth, such as that at withheld points.
    """
    device = device_of(session.field)
    unit = np.asarray(direction, float) / np.linalg.norm(direction)
    o, d = (to_device(np.array(x, np.float32), device)[None].contiguous() for x in (origin, unit))
    angle = torch.full((1,), PIXEL, device=device)
    seen = trace(session.world(time), o, d, angle)
    dry = trace(World(session.field), o, d, angle)
    water = seen.layers.get("water_depth")
    t = float(dry.depth)
    height = origin[2] + t * unit[2] - session.scene.ground_z if math.isfinite(t) else math.nan
    scale = session.scene.scale_error
    wet = 0.0 if water is None else float(water)
    # Of the height, m; no product of 0 and the sky's infinite length.
    upward = abs(unit[2]) * depth_error * t if math.isfinite(t) else math.nan
    return Measured(
        float(seen.depth),
        float(height),
        wet,
        float(seen.depth) * math.hypot(scale, depth_error),
        math.hypot(scale * height, upward),
        math.hypot(scale * wet, upward),
    )
