"""The result of one check. Does not import torch."""

import math
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Check:
    """A measured error beside the largest one that is allowed.

    Attributes:
        name: topic and quantity, such as "smog transmittance".
        compares: what is compared with what.
        figure: the measured error, in `unit`; NaN if there was nothing to measure.
        threshold: largest figure that passes; None: the figure is information alone.
        unit: unit of both; "1" for none.
        source: where the expected value comes from.
    """

    name: str
    compares: str
    figure: float
    threshold: float | None
    unit: str
    source: str

    @property
    def passed(self) -> bool:
        """Whether the figure is within the threshold; NaN never is."""
        return self.threshold is None or self.figure <= self.threshold

    @property
    def verdict(self) -> str:
        """The result in a word: pass, FAIL, or info for a figure without a threshold."""
        if self.threshold is None:
            return "info"
        return "pass" if self.passed else "FAIL"

    def entry(self) -> dict[str, Any]:
        """The check as JSON values; a figure that is not finite becomes null."""
        figure = float(self.figure) if math.isfinite(self.figure) else None
        return {
            "name": self.name,
            "compares": self.compares,
            "figure": figure,
            "threshold": self.threshold,
            "unit": self.unit,
            "verdict": self.verdict,
            "source": self.source,
        }
