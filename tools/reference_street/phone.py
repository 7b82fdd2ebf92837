"""Turn a linear picture into the photo of a phone at dusk: noise, denoising, underexposure."""

import numpy as np
from jaxtyping import Float, UInt8
from scipy import ndimage

from tools.reference_street.render import encode

WHITE = 400.0  # photoelectrons at white, in the green channel
READ_NOISE = 3.0  # photoelectrons
BALANCE = np.array([1.9, 1.0, 1.6])  # gains of the channels; the raw signal is smaller by them
LUMA_BLUR, CHROMA_BLUR = 0.55, 1.6  # pixels, standard deviations of the denoising filter
_YCBCR = np.array([[0.299, 0.587, 0.114], [-0.168736, -0.331264, 0.5], [0.5, -0.418688, -0.081312]])


def photo(
    linear: Float[np.ndarray, "h w 3"], rng: np.random.Generator
) -> UInt8[np.ndarray, "h w 3"]:
    """Return an exposed linear picture as a phone shows it, sRGB.

    Shot and read noise of the raw signal, then a blur of brightness and a wider one of colour.
    """
    electrons = np.clip(linear, 0, 1) * WHITE / BALANCE
    raw = rng.poisson(electrons) + READ_NOISE * rng.standard_normal(electrons.shape)
    ycbcr = encode(raw / WHITE * BALANCE) / 255.0 @ _YCBCR.T
    blurs = (LUMA_BLUR, CHROMA_BLUR, CHROMA_BLUR)
    smooth = [ndimage.gaussian_filter(ycbcr[..., k], blur) for k, blur in enumerate(blurs)]
    rgb = np.stack(smooth, -1) @ np.linalg.inv(_YCBCR).T
    return np.round(255 * np.clip(rgb, 0, 1)).astype(np.uint8)
