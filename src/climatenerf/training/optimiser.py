"""Adam for hash grids: most rows get no gradient in a step, and Adam leaves those alone."""

from collections.abc import Iterable, Sequence

import torch

from climatenerf.ops import optimiser

DECAY_EVERY = 8  # steps: all rows are read for it, while a step reads few


class GridAdam:
    """Adam (Kingma & Ba 2015) over large tables whose gradients are mostly zero.

    Each table gets a gradient buffer that the encoding's backward pass adds to and `step` clears.
    All values of a table fall by its share `decays` of the learning rate a step, whether they have
    a gradient or not (decoupled as by Loshchilov & Hutter 2019; of hash grids also Barron et al.
    2023, "Zip-NeRF"): so what few rays tell of stays what coarser levels say.
    """

    def __init__(
        self,
        tables: Iterable[torch.nn.Parameter],
        decays: Sequence[float] | None = None,
        epsilon: float = 1e-15,
    ):
        """Epsilon only avoids 0/0; it is small because a hash row's gradients are."""
        self.tables = list(tables)
        self.decays = [0.0] * len(self.tables) if decays is None else decays
        self.epsilon = epsilon
        self.steps = 0
        self.first = [torch.zeros(t.numel(), device=t.device) for t in self.tables]
        self.second = [torch.zeros(t.numel(), device=t.device) for t in self.tables]
        for table in self.tables:
            table.grad_buffer = torch.zeros_like(table.data)  # type: ignore[attr-defined]

    def step(self, rate: float, beta1: float = 0.9, beta2: float = 0.99) -> None:
        """One update with learning rate `rate`."""
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
            if decay and self.steps % DECAY_EVERY == 0:
                table.data.mul_(1 - DECAY_EVERY * rate * decay)

    def state(self) -> dict[str, torch.Tensor]:
        """Tensors that continue the optimisation elsewhere."""
        state = {"steps": torch.tensor(self.steps)}
        for i, (first, second) in enumerate(zip(self.first, self.second, strict=True)):
            state |= {f"{i}.first": first, f"{i}.second": second}
        return state

    def load(self, state: dict[str, torch.Tensor]) -> None:
        """Continues from `state()`."""
        self.steps = int(state["steps"])
        for i in range(len(self.tables)):
            self.first[i].copy_(state[f"{i}.first"])
            self.second[i].copy_(state[f"{i}.second"])
