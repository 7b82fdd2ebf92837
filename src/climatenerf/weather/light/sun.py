"""Direction of the sun from its parameters."""

import math

import numpy as np
from jaxtyping import Float

from climatenerf.weather.light.parameters import Sun


def sun_direction(sun: Sun) -> Float[np.ndarray, "3"] | None:
    """Unit vector towards the sun, azimuth from +y towards +x; None without an elevation."""
    if sun.elevation is None:
        return None
    azimuth = sun.azimuth or 0.0
    flat = math.cos(sun.elevation)
    return np.array([flat * math.sin(azimuth), flat * math.cos(azimuth), math.sin(sun.elevation)])
