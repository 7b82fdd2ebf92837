"""What a fit reports after each step."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Report:
    """State of a fit after a step."""

    step: int
    seconds: float
    progress: float
    """Fraction of the time or steps that has passed, [0,1]."""
    psnr: float
    """Of the training pixels, running mean, dB."""
    rays_per_second: float
    samples_per_ray: float
    samples: int
    """Samples evaluated so far."""
