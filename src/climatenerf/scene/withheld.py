"""Sparse points that no fit uses, so that its depth can be scored by them."""

import numpy as np
from jaxtyping import Bool, Int

EVERY = 10  # one point in so many is withheld


def is_withheld(points: Int[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
    """Return which points, by their index in the capture, are withheld from fits."""
    return points % EVERY == EVERY - 1
