"""Largest accepted values of numbers that users give."""

from climatenerf.core.errors import UserError, excerpt

MAX_FRAMES = 100_000
"""Frames of a movie: over an hour at 24 per second."""
MAX_SEED = 2**63 - 1
"""Random generators take a signed 64-bit seed."""


def check_seed(seed: int) -> int:
    """Return a random seed.

    Raises:
        UserError: it is outside 0 to `MAX_SEED`.
    """
    if not 0 <= seed <= MAX_SEED:
        raise UserError(f"--seed must lie between 0 and {MAX_SEED}; got {excerpt(seed)}")
    return seed


def check_fps(fps: float) -> float:
    """Return the frame rate, in frames per second, if a movie can have it.

    Raises:
        UserError: it is outside 0.1 to 240.
    """
    if not 0.1 <= fps <= 240:
        raise UserError(f"the frame rate must lie between 0.1 and 240 per second; got {fps:g}")
    return fps
