"""Definition of the display sRGB curve (IEC 61966-2-1), for floats and NumPy arrays. No torch.

`core/colour.py` evaluates the same curve on tensors, with gradients; the kernels of
`field/activations.py` evaluate it fused with the networks' outputs. All use these constants.
"""

import numpy as np
from jaxtyping import Float

DISPLAY_TOE = 0.04045
"""Display value up to which the curve is linear."""
LINEAR_TOE = 0.0031308
"""Linear radiance up to which the curve is linear."""
TOE_SLOPE = 12.92
"""Display value per linear radiance in the toe."""
EXPONENT, OFFSET, SCALE = 2.4, 0.055, 1.055
"""Above the toe: linear = ((display + OFFSET) / SCALE) ** EXPONENT."""


LUMA = (0.2126, 0.7152, 0.0722)
"""Weights of linear red, green and blue in luminance (Rec. 709)."""


def to_linear(display: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Return the linear radiance of display values in [0, 1]."""
    curve = ((display + OFFSET) / SCALE) ** EXPONENT
    return np.where(display <= DISPLAY_TOE, display / TOE_SLOPE, curve)


def to_display(linear: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Return the display values of linear radiance, which is clipped to [0, 1] first."""
    x = np.clip(linear, 0.0, 1.0)
    curve = SCALE * x ** (1 / EXPONENT) - OFFSET
    return np.where(x <= LINEAR_TOE, TOE_SLOPE * x, curve)


def linear_colour(display: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return the linear radiance of a display colour in [0, 1], channel by channel.

    Plain floats: NumPy's vectorised power may differ from it in the last bit.
    """
    red, green, blue = (
        c / TOE_SLOPE if c <= DISPLAY_TOE else ((c + OFFSET) / SCALE) ** EXPONENT for c in display
    )
    return red, green, blue
