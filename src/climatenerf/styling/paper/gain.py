"""What a field learns of a stylised picture: its colours in low frequencies, not its texture.

Texture that a network invents differs from view to view. A gain that varies slowly over the
picture keeps the detail of the field, and is nearly the same in all views.
"""

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter

from climatenerf.core.srgb import LUMA

BLURS_ACROSS = 130  # standard deviations of the blur across the picture's width
DARK = 0.01  # linear radiance added to both: the ratio of two dark pixels is noise
BRIGHTNESS = (0.2, 5.0)  # bounds of the gain of luminance
HUE = (0.125, 8.0)  # bounds of a channel's gain over that of luminance; leaves have little blue


def low_frequency_gain(
    clean: Float[np.ndarray, "h w 3"],
    taught: Float[np.ndarray, "h w 3"],
    opacity: Float[np.ndarray, "h w"],
) -> Float[np.ndarray, "h w 3"]:
    """Return G = (B y + e) / (B c + e), with a Gaussian blur B over matter alone.

    Luminance and hue have bounds of their own: with one bound on all channels, leaves under snow
    would turn yellow where blue has reached it.

    Args:
        clean: linear radiance c of the field.
        taught: linear radiance y of the stylised picture.
        opacity: fraction of each pixel that is matter, 0 to 1; the sky does not bleed into trees.
    """
    sigma = clean.shape[1] / BLURS_ACROSS

    def blurred(values: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
        return gaussian_filter(values * opacity[..., None], (sigma, sigma, 0), mode="nearest")

    # 1e-6: no matter near a pixel, 0/0.
    dark = DARK * blurred(np.ones_like(clean)) + 1e-6
    new, old = blurred(taught) + dark, blurred(clean) + dark
    brightness = (new @ np.array(LUMA))[..., None] / (old @ np.array(LUMA))[..., None]
    return brightness.clip(*BRIGHTNESS) * (new / old / brightness).clip(*HUE)
