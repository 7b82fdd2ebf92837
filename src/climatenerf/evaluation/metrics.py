"""Picture quality against a photograph: PSNR, SSIM, and PSNR after a colour correction.

Pictures are display-encoded (sRGB), in [0, 1] or 8 bit. All scores are computed in float64.
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
    """Return the peak signal-to-noise ratio over all pixels and channels, peak 1, dB.

    Args:
        rendered: display-encoded picture, [0, 1] or 8 bit; CPU torch tensors are accepted.
        photo: the expected picture, same shape.

    Returns:
        dB; +inf for equal pictures.
    """
    a, b = _pair(rendered, photo)
    mse = float(np.mean((a - b) ** 2))
    return float("inf") if mse == 0.0 else -10.0 * float(np.log10(mse))


def ssim(rendered: Picture, photo: Picture) -> float:
    """Return the structural similarity, mean over channels and all complete windows.

    Wang, Bovik, Sheikh and Simoncelli 2004: 11x11 Gaussian window of sigma 1.5 pixels, K1 = 0.01,
    K2 = 0.03, data range 1, population (not sample) covariances. Windows that extend beyond the
    picture do not count.

    Args:
        rendered: display-encoded picture, [0, 1] or 8 bit, at least 11 pixels a side.
        photo: the expected picture, same shape.

    Returns:
        A number in [-1, 1]; 1 for equal pictures.

    Raises:
        ValueError: the shapes differ, or the pictures are smaller than a window.
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
    """Return the PSNR after the best affine colour map (see `colour_corrected`), dB.

    This removes the effect of a photo's exposure and white balance, which held-out views can only
    take from nearby photos. Report it beside `psnr`, never instead of it.
    """
    return psnr(colour_corrected(rendered, photo), photo)


def colour_corrected(rendered: Picture, photo: Picture) -> Float[np.ndarray, "h w 3"]:
    """Return the rendered picture after the best 3x4 affine colour map to the photo.

    The map is the least-squares solution over all pixels in display values. The result is clipped
    to [0, 1].
    """
    a, b = _pair(rendered, photo)
    flat = a.reshape(-1, a.shape[-1])
    with_one = np.concatenate([flat, np.ones_like(flat[:, :1])], axis=1)
    # lstsq: the normal equations are singular for a picture of one colour.
    matrix, *_ = np.linalg.lstsq(with_one, b.reshape(-1, b.shape[-1]), rcond=None)
    return np.clip(with_one @ matrix, 0.0, 1.0).reshape(b.shape)


def _pair(rendered: Picture, photo: Picture) -> tuple[np.ndarray, np.ndarray]:
    a, b = _unit_range(rendered), _unit_range(photo)
    if a.shape != b.shape or a.ndim != 3:
        raise ValueError(f"pictures must have one shape (h, w, c): {a.shape}, {b.shape}")
    return a, b


def _unit_range(picture: Picture) -> np.ndarray:
    array = np.asarray(picture)
    return array / 255.0 if array.dtype == np.uint8 else array.astype(np.float64)


def _blur(picture: np.ndarray) -> np.ndarray:
    """Convolve with the separable Gaussian window of SSIM; complete windows only."""
    offsets = np.arange(SSIM_WINDOW) - SSIM_WINDOW // 2
    weights = np.exp(-(offsets**2) / (2 * SSIM_SIGMA**2))
    weights /= weights.sum()
    height, width = (n - SSIM_WINDOW + 1 for n in picture.shape[:2])
    rows = sum((w * picture[i : i + height] for i, w in enumerate(weights)), start=np.zeros(1))
    return sum((w * rows[:, i : i + width] for i, w in enumerate(weights)), start=np.zeros(1))
