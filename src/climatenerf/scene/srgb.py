"""The sRGB curve (IEC 61966-2-1) for arrays; `core/colour.py` has it with gradients."""

import numpy as np
from jaxtyping import Float


def to_linear(display: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Linear light of display values in [0, 1]."""
    return np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)


def to_display(linear: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Display values in [0, 1] of linear light, which is cut to that range."""
    x = np.clip(linear, 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
