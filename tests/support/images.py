"""A statistical comparison of a noisy rendering with its reference, which keeps the pictures."""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image

Picture = Float[np.ndarray, "h w 3"] | UInt8[np.ndarray, "h w 3"]


def assert_images_match(
    image: Picture,
    reference: Picture,
    folder: Path,
    *,
    mask: Bool[np.ndarray, "h w"] | None = None,
    block: int = 8,
    standard_errors: float = 4.0,
    tolerance: float = 0.0,
    max_block: float = 0.1,
) -> None:
    """Assert that two pictures differ by noise alone.

    The difference is averaged over square blocks, per channel. Two conditions must hold:

    - The mean over all blocks is at most `standard_errors` standard errors, plus `tolerance`. The
      standard error is the deviation of the block means over the square root of their number, so
      it follows from the noise itself. The noise of different blocks must be independent. This
      condition detects a bias of the whole picture far below the noise of a pixel.
    - No block mean exceeds `max_block`. This condition detects a local defect, which would only
      raise the standard error.

    Args:
        image: rendered picture, values in [0, 1] or 8 bit.
        reference: expected picture, same shape.
        folder: on failure image.png, reference.png and difference.png are written here.
        mask: pixels to compare; default all.
        block: side of a block, pixels. Parts of blocks at the right and bottom edge count as
            blocks; blocks with less than half their pixels to compare do not.
        standard_errors: allowed mean difference in standard errors; by chance 4 are exceeded by
            one channel in 16 000.
        tolerance: known bias that is allowed on top, such as that of rounding.
        max_block: allowed absolute mean difference of a block.

    Raises:
        AssertionError: the pictures do not match; the message says how, and names the folder.
        ValueError: the pictures have different shapes, or fewer than 8 blocks can be compared.
    """
    a, b = _unit_range(image), _unit_range(reference)
    if a.shape != b.shape:
        raise ValueError(f"the image has shape {a.shape}, the reference {b.shape}")
    valid = np.ones(a.shape[:2], bool) if mask is None else mask
    means = _block_means(a - b, valid, block)
    if len(means) < 8:
        raise ValueError(f"only {len(means)} blocks can be compared; make `block` smaller")
    failures = []
    bias = means.mean(0)
    allowed = standard_errors * means.std(0, ddof=1) / np.sqrt(len(means)) + tolerance
    largest = np.abs(means).max()
    if not (np.abs(bias) <= allowed).all():  # NaN must fail
        failures.append(f"mean difference {_text(bias)}, allowed {_text(allowed)}")
    if not largest <= max_block:
        failures.append(f"largest mean difference of a block {largest:.2g}, allowed {max_block:g}")
    if failures:
        scale = _write(a, b, valid, folder)
        raise AssertionError(
            f"{'; '.join(failures)}; pictures are in {folder} (difference.png: grey is equal, black"
            f" and white are differences of {scale:.2g})"
        )


def _unit_range(picture: Picture) -> Float[np.ndarray, "h w 3"]:
    array = np.asarray(picture)
    return array / 255.0 if array.dtype == np.uint8 else array.astype(np.float64)


def _block_means(
    difference: Float[np.ndarray, "h w 3"], valid: Bool[np.ndarray, "h w"], block: int
) -> Float[np.ndarray, "n 3"]:
    means = []
    for row in range(0, valid.shape[0], block):
        for column in range(0, valid.shape[1], block):
            window = np.s_[row : row + block, column : column + block]
            if valid[window].mean() >= 0.5:
                means.append(difference[window][valid[window]].mean(0))
    return np.reshape(means, (-1, 3))


def _write(
    a: Float[np.ndarray, "h w 3"],
    b: Float[np.ndarray, "h w 3"],
    valid: Bool[np.ndarray, "h w"],
    folder: Path,
) -> float:
    """Write the three pictures; return the difference that black and white show."""
    difference = np.nan_to_num(np.where(valid[..., None], a - b, 0.0))
    scale = float(np.abs(difference).max()) or 1.0  # equal or NaN: 0/0
    shown = {"image": a, "reference": b, "difference": 0.5 + 0.5 * difference / scale}
    folder.mkdir(parents=True, exist_ok=True)
    for name, values in shown.items():
        rounded = np.round(255 * np.clip(np.nan_to_num(values), 0.0, 1.0)).astype(np.uint8)
        Image.fromarray(rounded).save(folder / f"{name}.png")
    return scale


def _text(values: Float[np.ndarray, "3"]) -> str:
    return " ".join(f"{value:.2g}" for value in values)
