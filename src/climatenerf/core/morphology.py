"""Binary morphology on masks [h, w]. Pixels beyond the border count as outside the mask.

scipy is imported on first use, so that a command that needs none of this starts quickly.
"""

import numpy as np
from jaxtyping import Bool, Int


def dilated(mask: Bool[np.ndarray, "h w"], pixels: int) -> Bool[np.ndarray, "h w"]:
    """Return the mask grown by a square: all within `pixels` rows and columns of it."""
    from scipy import ndimage

    if pixels < 1:
        return mask
    grown = ndimage.maximum_filter(mask.astype(np.uint8), 2 * pixels + 1, mode="constant")
    return grown.astype(bool)


def eroded(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the pixels of the mask whose eight neighbours are all in it.

    Slices of the padded mask take 0.4 ms for two megapixels, `ndimage.minimum_filter` 15 ms.
    """
    padded = np.pad(mask, 1)
    rows = padded[:-2] & padded[1:-1] & padded[2:]
    return rows[:, :-2] & rows[:, 1:-1] & rows[:, 2:]


def depth_inside(mask: Bool[np.ndarray, "h w"]) -> Int[np.ndarray, "h w"]:
    """Return the chessboard distance (px) to the nearest pixel outside the mask; 0 outside it."""
    from scipy import ndimage

    return np.asarray(ndimage.distance_transform_cdt(np.pad(mask, 1), "chessboard"))[1:-1, 1:-1]


def connected_to(
    seeds: Bool[np.ndarray, "h w"], allowed: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Return the allowed pixels that are joined to an allowed seed along rows and columns."""
    from scipy import ndimage

    components = np.zeros(allowed.shape, np.int32)
    ndimage.label(allowed, output=components)
    reached = np.zeros(int(components.max(initial=0)) + 1, bool)
    reached[components[seeds & allowed]] = True
    return reached[components]
