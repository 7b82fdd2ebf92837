"""Picture quality against a photograph: PSNR, SSIM, and PSNR after a colour correction.

All take display-encoded (sRGB) pictures in [0, 1], or 8-bit ones, and work in float64.
"""

from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

Picture = Float[Any, "h w c"] | UInt8[Any, "h w c"]  # NumPy, or torch on the CPU

SSIM_WINDOW = 11
SSIM_SIGMA = 1.5
SSIM_K1 = 0.01
SSIM_K2 = 0.03


def psnr(rendered: Picture, photo: Picture) -> float:
    """Peak signal-to-noise ratio in dB, over all pixels and channels, peak 1.

    Args:
        rendered: display-encoded picture, [0, 1] or 8 bit; CPU torch tensors are accepted.
        photo: the picture it should be, same shape.

    Returns:
        dB; +inf where the pictures are equal.
    """
    a, b = _pair(rendered, photo)
    mse = float(np.mean((a - b) ** 2))
    return float("inf") if mse == 0.0 else -10.0 * float(np.log10(mse))


def ssim(rendered: Picture, photo: Picture) -> float:
    """Structural similarity, mean over channels and over all whole windows.

    Wang, Bovik, Sheikh and Simoncelli 2004: 11x11 Gaussian window of sigma 1.5 pixels, K1 = 0.01,
    K2 = 0.03, data range 1; population (not sample) covariances; windows that leave the picture
    are not counted.

    Args:
        rendered: display-encoded picture, [0, 1] or 8 bit, at least 11 pixels a side.
        photo: the picture it should be, same shape.

    Returns:
        A number in [-1, 1]; 1 where the pictures are equal.
    """
    a, b = _pair(rendered, photo)
    if min(a.shape[:2]) < SSIM_WINDOW:
        raise ValueError(f"SSIM needs pictures of at least {SSIM_WINDOW} pixels a side: {a.shape}")
    c1, c2 = SSIM_K1**2, SSIM_K2**2
    mean_a, mean_b = _blur(a), _blur(b)
    var_a = _blur(a * a) - mean_a**2
    var_b = _blur(b * b) - mean_b**2
    covariance = _blur(a * b) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + c1) / (mean_a**2 + mean_b**2 + c1)
    structure = (2 * covariance + c2) / (var_a + var_b + c2)
    return float(np.mean(luminance * structure))


def psnr_cc(rendered: Picture, photo: Picture) -> float:
    """PSNR in dB after the affine colour map that fits the photo best (see `colour_corrected`).

    It leaves out what a photo's own exposure and white balance do, which a held-out
    view can know from photos nearby at most. Report it beside `psnr`, never instead of it.
    """
    return psnr(colour_corrected(rendered, photo), photo)


def colour_corrected(rendered: Picture, photo: Picture) -> Float[np.ndarray, "h w 3"]:
    """The rendered picture after the 3x4 affine colour map nearest to the photo.

    Least squares over all pixels in display-encoded colours; the result is clipped to [0, 1].
    """
    a, b = _pair(rendered, photo)
    flat = a.reshape(-1, a.shape[-1])
    with_one = np.concatenate([flat, np.ones_like(flat[:, :1])], axis=1)
    # lstsq, not the normal equations: a picture of one colour leaves them singular.
    matrix, *_ = np.linalg.lstsq(with_one, b.reshape(-1, b.shape[-1]), rcond=None)
    return np.clip(with_one @ matrix, 0.0, 1.0).reshape(b.shape)


def _pair(rendered: Picture, photo: Picture) -> tuple[np.ndarray, np.ndarray]:
    a, b = _unit_range(rendered), _unit_range(photo)
    if a.shape != b.shape or a.ndim != 3:
        raise ValueError(f"pictures must both be (h, w, c) and of one shape: {a.shape}, {b.shape}")
    return a, b


def _unit_range(picture: Picture) -> np.ndarray:
    array = np.asarray(picture)
    return array / 255.0 if array.dtype == np.uint8 else array.astype(np.float64)


def _blur(picture: np.ndarray) -> np.ndarray:
    """Separable Gaussian of the SSIM window, whole windows only."""
    offsets = np.arange(SSIM_WINDOW) - SSIM_WINDOW // 2
    weights = np.exp(-(offsets**2) / (2 * SSIM_SIGMA**2))
    weights /= weights.sum()
    height, width = (n - SSIM_WINDOW + 1 for n in picture.shape[:2])
    rows = sum((w * picture[i : i + height] for i, w in enumerate(weights)), start=np.zeros(1))
    return sum((w * rows[:, i : i + width] for i, w in enumerate(weights)), start=np.zeros(1))
