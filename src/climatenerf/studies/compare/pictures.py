"""Sizes and masks: what every method does before and after it edits a picture."""

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

Picture = UInt8[np.ndarray, "h w 3"]


def working_size(size: tuple[int, int], side: int, multiple: int) -> tuple[int, int]:
    """Return the size at which a network edits a picture: about its aspect ratio.

    Args:
        size: width and height of the picture, pixels.
        side: least shorter side, pixels. Larger pictures are not reduced.
        multiple: number that divides both sides.

    Returns:
        Width and height, pixels.
    """
    scale = max(1.0, side / min(size))
    width, height = (max(multiple, multiple * round(n * scale / multiple)) for n in size)
    return width, height


def resized(picture: Picture, size: tuple[int, int]) -> Picture:
    """Return a picture in another size (width, height), by Lanczos resampling."""
    if picture.shape[1::-1] == size:
        return picture
    image = Image.fromarray(np.ascontiguousarray(picture))
    return np.asarray(image.resize(size, Image.Resampling.LANCZOS))


def grey(mask: Float[np.ndarray, "h w"], size: tuple[int, int]) -> UInt8[np.ndarray, "h2 w2"]:
    """Return a mask in [0, 1] as 8-bit grey in another size (width, height)."""
    image = Image.fromarray((255 * np.clip(mask, 0, 1) + 0.5).astype(np.uint8))
    return np.asarray(image.resize(size, Image.Resampling.BILINEAR))


def pasted(picture: Picture, painted: Picture, mask: Float[np.ndarray, "h w"]) -> Picture:
    """Return a picture with another one pasted in through a mask in [0, 1], in display values."""
    weight = np.clip(mask, 0, 1)[..., None]
    mixed = picture + weight * (painted.astype(np.float64) - picture)
    return (mixed + 0.5).astype(np.uint8)
