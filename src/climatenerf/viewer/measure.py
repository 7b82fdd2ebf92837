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
        scale_error: relative standard error of all three.
    """

    distance: float
    height: float
    water_depth: float
    scale_error: float

    @property
    def sentence(self) -> str:
        """The measurement in words, with standard errors."""
        if not math.isfinite(self.distance):
            return "sky"
        parts = [f"distance {self._with_error(self.distance)}"]
        if math.isfinite(self.height):
            parts.append(f"ground or wall at {self._with_error(self.height)}")
        if self.water_depth > 0:
            parts.append(f"water {self._with_error(self.water_depth)} deep")
        return ", ".join(parts)

    def _with_error(self, value: float) -> str:
        error = abs(value) * self.scale_error
        return f"{value:.2f} m" if error < 0.005 else f"{value:.2f} ± {error:.2f} m"


def measure(
    session: RenderSession,
    origin: Float[np.ndarray, "3"],
    direction: Float[np.ndarray, "3"],
    time: float = 0.0,
) -> Measured:
    """Trace one ray through the weather, and through the dry scene.

    Args:
        session: weather in a scene.
        origin: world m.
        direction: of any length.
        time: moment, s.
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
    return Measured(
        float(seen.depth),
        float(height),
        0.0 if water is None else float(water),
        session.scene.scale_error,
    )
