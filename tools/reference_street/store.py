"""Store of linear mean pictures, one file each, that grow by passes."""

import os
from pathlib import Path

import numpy as np
from jaxtyping import Float


def add(path: Path, fresh: Float[np.ndarray, "h w c"]) -> None:
    """Average a new pass into a picture's mean; the file is replaced atomically.

    The sum of squared deviations of the passes is kept too (Welford's algorithm), for `noise_db`.
    """
    passes, mean, squares = _read(path)
    step = fresh - mean
    mean = mean + step / (passes + 1)
    squares = squares + step * (fresh - mean)
    temporary = path.with_name(path.stem + ".tmp.npz")
    arrays = {"mean": mean, "squares": squares}
    np.savez(temporary, passes=passes + 1, **{k: v.astype(np.float32) for k, v in arrays.items()})
    os.replace(temporary, path)


def stored(path: Path) -> tuple[int, Float[np.ndarray, "h w c"] | None]:
    """Return the number of passes and their mean; (0, None) without a file."""
    passes, mean, _ = _read(path)
    return passes, mean if passes else None


def noise_db(path: Path, exposure: float) -> float:
    """Return the PSNR of a picture's noise in display sRGB, dB; -inf before the second pass.

    The variance of the mean follows from the deviations of the passes. The slope of the sRGB curve
    carries it to display values; what is exposed beyond white has no noise there.
    """
    passes, mean, squares = _read(path)
    if passes < 2:
        return -np.inf
    variance = squares[..., :3] / (passes * (passes - 1))
    linear = exposure * mean[..., :3]
    # 1e-4: the power's slope at black is unbounded; there the curve is linear anyway.
    slope = np.where(linear <= 0.0031308, 12.92, 0.4396 * np.maximum(linear, 1e-4) ** (-7 / 12))
    slope = np.where(linear >= 1.0, 0.0, slope)
    return float(-10 * np.log10(max((exposure**2 * slope**2 * variance).mean(), 1e-12)))


def _read(path: Path) -> tuple[int, np.ndarray, np.ndarray]:
    if not path.exists():
        return 0, np.zeros(1), np.zeros(1)
    with np.load(path) as data:
        return int(data["passes"]), data["mean"].astype(float), data["squares"].astype(float)
