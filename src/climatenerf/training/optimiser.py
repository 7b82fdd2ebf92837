"""Adam for hash grids: most rows have no gradient in a step, and Adam leaves those unchanged."""

from collections.abc import Iterable, Sequence

import torch
from jaxtyping import Bool
from torch import Tensor

from climatenerf.core.errors import UserError
from climatenerf.ops import optimiser

MAX_DISCARDED = 20  # steps in a row, after which a fit ends
DECAY_INTERVAL = 8  # steps; decay reads all rows, while a step reads few


class Diverged(UserError):
    """Gradients of too many steps in a row were not finite."""


def all_finite(gradients: Iterable[Tensor]) -> Bool[Tensor, ""]:
    """Return whether gradients are finite, without waiting for a GPU.

    Those of the networks suffice: every sample contributes to them, so one that is not finite shows
    there, while the tables are too large to be searched in each step.
    """
    return torch.stack([gradient.isfinite().all() for gradient in gradients]).all()


def clear_unless(finite: Bool[Tensor, ""], gradients: Iterable[Tensor]) -> None:
    """Set gradients to zero, in place, unless `finite`; without waiting for a GPU."""
    for gradient in gradients:
        gradient.copy_(torch.where(finite, gradient, 0.0))


class DiscardedSteps:
    """Counts the steps whose gradients were not finite, and ends a fit after many in a row."""

    def __init__(self):
        self.total = 0
        self.in_a_row = 0

    def record(self, finite: bool, step: int) -> None:
        """Count a step.

        Raises:
            Diverged: `MAX_DISCARDED` in a row; the parameters are those before the first.
        """
        self.total += not finite
        self.in_a_row = 0 if finite else self.in_a_row + 1
        if self.in_a_row >= MAX_DISCARDED:
            raise Diverged(
                f"{MAX_DISCARDED} steps in a row had gradients that are not finite, the last at"
                f" step {step}; the field before them is saved, so check the capture with"
                " `climatenerf check`, then fit anew or resume"
            )


class GridAdam:
    """Adam (Kingma & Ba 2015) over large tables whose gradients are mostly zero.

    Each table gets a gradient buffer, to which the encoding's backward pass adds and which `step`
    clears. All values of a table decay by a fraction of the learning rate, whether they have a
    gradient or not (decoupled, as by Loshchilov & Hutter 2019; for hash grids also Barron et al.
    2023, "Zip-NeRF"). Where few rays contribute, the coarser levels then determine the value.
    """

    def __init__(
        self,
        tables: Iterable[torch.nn.Parameter],
        decays: Sequence[float] | None = None,
        epsilon: float = 1e-15,
    ):
        """Allocate moments and gradient buffers.

        Args:
            tables: the parameters.
            decays: weight decay of each table, times its learning rate a step; None: 0.
            epsilon: avoids 0/0; it is small because the gradients of a hash row are.
        """
        self.tables = list(tables)
        self.decays = [0.0] * len(self.tables) if decays is None else decays
        self.epsilon = epsilon
        self.steps = 0
        self.first = [torch.zeros(t.numel(), device=t.device) for t in self.tables]
        self.second = [torch.zeros(t.numel(), device=t.device) for t in self.tables]
        for table in self.tables:
            table.grad_buffer = torch.zeros_like(table.data)  # type: ignore[attr-defined]

    def step(self, rate: float, beta1: float = 0.9, beta2: float = 0.99) -> None:
        """Update all tables once with learning rate `rate`."""
        self.steps += 1
        for table, decay, *moments in zip(
            self.tables, self.decays, self.first, self.second, strict=True
        ):
            optimiser.adam(
                table.data,
                table.grad_buffer,  # type: ignore[attr-defined]
                (moments[0], moments[1]),
                rate,
                (beta1, beta2),
                self.epsilon,
                self.steps,
            )
            if decay and self.steps % DECAY_INTERVAL == 0:
                table.data.mul_(1 - DECAY_INTERVAL * rate * decay)

    @property
    def gradients(self) -> list[Tensor]:
        """Gradient buffers of the tables."""
        return [table.grad_buffer for table in self.tables]  # type: ignore[attr-defined]

    def state(self) -> dict[str, torch.Tensor]:
        """Return the tensors with which `load` continues the optimisation."""
        state = {"steps": torch.tensor(self.steps, device="cpu")}
        for i, (first, second) in enumerate(zip(self.first, self.second, strict=True)):
            state |= {f"{i}.first": first, f"{i}.second": second}
        return state

    def load(self, state: dict[str, torch.Tensor]) -> None:
        """Continue from the tensors of `state`."""
        self.steps = int(state["steps"])
        for i in range(len(self.tables)):
            self.first[i].copy_(state[f"{i}.first"])
            self.second[i].copy_(state[f"{i}.second"])
