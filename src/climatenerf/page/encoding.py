"""Pictures and height maps as text that a page holds."""

import base64
import io

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

STEP = 0.001
"""Height of one count, m."""
DIFFERENCE_STEP = 0.002
"""Difference of one count between flooding level and height, m."""
MIDDLE = 128
"""Count of no difference."""
SKY = 65535
"""Count of pixels that show the sky."""
OPEN = 65534
"""Count of pixels below the horizon that show no ground; any water covers them."""
QUALITY = 82


def picture_text(picture: UInt8[np.ndarray, "h w 3"], quality: int = QUALITY) -> str:
    """Return a picture as lossy WebP in base64."""
    return _text(picture, quality=quality, method=6)


def height_text(
    heights: Float[np.ndarray, "h w"], flooding: Float[np.ndarray, "h w"]
) -> tuple[float, str]:
    """Return two height maps as lossless WebP in base64.

    Red times 256 plus green counts the flooding level; blue is its difference from the height. A
    canvas in a browser has 8 bits a channel, and returns them exactly if the picture is opaque.

    Args:
        heights: m; +inf for the sky, -inf where no ground is seen below the horizon.
        flooding: water level from which each pixel is under water, likewise. What is more than 65 m
            above the lowest is cut off there.

    Returns:
        Level of count 0 (m), and the text.
    """
    shown = np.isfinite(flooding)
    low = float(np.floor(flooding[shown].min() / STEP) * STEP) if shown.any() else 0.0
    above = np.where(shown, flooding, low) - low
    counts = np.clip(np.rint(above / STEP), 0, OPEN - 1).astype(np.uint32)
    counts = np.where(shown, counts, np.where(flooding > 0, SKY, OPEN))
    over = np.where(shown, flooding, 0.0) - np.where(shown, heights, 0.0)
    difference = np.clip(np.rint(over / DIFFERENCE_STEP) + MIDDLE, 0, 255).astype(np.uint32)
    channels = np.stack([counts >> 8, counts & 255, difference], axis=-1)
    return low, _text(channels.astype(np.uint8), lossless=True, quality=60, method=4)


def _text(pixels: UInt8[np.ndarray, "h w 3"], **options: int | bool) -> str:
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(buffer, "WEBP", **options)
    return base64.b64encode(buffer.getvalue()).decode()
