"""Time strips: one line of pixels over time, and moments side by side.

ClimateNeRF's paper shows the flood of each method at five moments. A line over time shows the same
for every frame: what is fixed in the scene draws a smooth curve, and what is invented anew in each
frame draws noise.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8

from climatenerf.studies.compare.pictures import Picture

MIN_LENGTH = 192  # pixels of a strip along time; few frames are repeated to fill them
MIN_WIDTH = 320  # pixels of a strip in a sheet, so that its label fits


def column_strip(pictures: Sequence[Picture], column: int) -> UInt8[np.ndarray, "h t 3"]:
    """Return one column of pixels over time, which runs to the right.

    Args:
        pictures: the frames, in order.
        column: which one, from 0.
    """
    strip = np.stack([picture[:, column] for picture in pictures], axis=1)
    return np.repeat(strip, _repeats(len(pictures)), axis=1)


def row_strip(pictures: Sequence[Picture], row: int) -> UInt8[np.ndarray, "t w 3"]:
    """Return one row of pixels over time, which runs downwards.

    Args:
        pictures: the frames, in order.
        row: which one, from 0.
    """
    strip = np.stack([picture[row] for picture in pictures])
    return np.repeat(strip, _repeats(len(pictures)), axis=0)


def widened(strip: Picture) -> Picture:
    """Return a strip with its columns repeated until its label fits into a sheet."""
    least = max(MIN_WIDTH, strip.shape[0])  # labels grow with the height
    return strip.repeat(-(-least // strip.shape[1]), axis=1)


def lines_with_most(masks: Sequence[Float[np.ndarray, "h w"]]) -> tuple[int, int]:
    """Return the row and the column that show most of an effect over all frames.

    Of equal ones the most central is taken.

    Args:
        masks: fraction of each pixel that shows the effect.
    """
    total = np.sum(masks, axis=0)
    return _most(total.sum(1)), _most(total.sum(0))


def _most(amount: Float[np.ndarray, "n"]) -> int:
    best = np.flatnonzero(amount >= amount.max() * (1 - 1e-9))  # 1e-9: sums of equal lines differ
    return int(best[np.argmin(np.abs(best - (len(amount) - 1) / 2))])


def _repeats(count: int) -> int:
    return max(1, round(MIN_LENGTH / count))
