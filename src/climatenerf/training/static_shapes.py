"""Index lists and read-backs of a training step, without waiting for a GPU.

`nonzero()` synchronises with the GPU because its output size depends on the data, and so does
reading a number on the CPU. A step would synchronise forty times. `FixedBuffers` avoids this: an
index list has a fixed capacity, half as many entries again as the last steps needed, and a number
is read two steps after it was computed. `ExactBuffers` is the plain version for the CPU.
"""

from collections import deque
from typing import Protocol

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from climatenerf.core.device import to_numpy

READ_BACK_DELAY = 2  # steps until a number is read: by then the GPU has finished that step
HEADROOM = 1.5  # capacity over the entries that the last steps needed
MIN_CAPACITY = 1024  # entries, unless the mask has fewer
DECAY = 0.9  # a step, of the largest number of entries needed


class Buffers(Protocol):
    """Index lists and read-backs of the steps of a fit, by name."""

    deferred: bool
    """Whether numbers that are read are those of an earlier step."""

    def begin_step(self, rays: int) -> None:
        """Begin a step of `rays` rays; capacities are proportional to it."""
        ...

    def capacity(self, name: str, limit: int) -> int | None:
        """Return the entries to allocate, at most `limit`; None: exactly as many as needed."""
        ...

    def record(self, name: str, count: Int[Tensor, ""]) -> None:
        """Record how many entries a list needed, for its later capacities."""
        ...

    def indices(self, name: str, mask: Bool[Tensor, "n"]) -> Int[Tensor, "k"]:
        """Return the indices where a mask is set, ascending.

        With a fixed capacity, unused entries hold n - 1 (at least one of them), whether the mask is
        set there or not, and indices beyond the capacity are left out.
        """
        ...

    def rows(self, mask: Bool[Tensor, "n"]) -> Int[Tensor, "k"]:
        """Return the indices where a mask is set or, with fixed capacities, all indices.

        The caller multiplies the results by the mask.
        """
        ...

    def prefix(self, name: str, ascending: Int[Tensor, "n"], limit: int) -> slice:
        """Return the entries below `limit`; with a fixed capacity the slice may be longer."""
        ...

    def read(
        self,
        name: str,
        value: Float[Tensor, ""] | Int[Tensor, ""],
        default: float | None = None,
    ) -> float:
        """Return a number on the CPU: this step's, or with deferred read-back an earlier step's.

        Until an earlier one has arrived, `default` is returned; None waits for this step's.
        """
        ...

    def end_step(self) -> None:
        """End a step: start its read-backs, and take those that have arrived."""
        ...


class ExactBuffers:
    """Lists of exactly the entries needed, and numbers read at once; for the CPU."""

    deferred = False

    def begin_step(self, rays: int) -> None:
        """Do nothing."""

    def capacity(self, name: str, limit: int) -> int | None:
        """Return None: as many entries as needed."""
        return None

    def record(self, name: str, count: Int[Tensor, ""]) -> None:
        """Do nothing."""

    def indices(self, name: str, mask: Bool[Tensor, "n"]) -> Int[Tensor, "k"]:
        """Return the indices where a mask is set, ascending."""
        return mask.nonzero()[:, 0]

    def rows(self, mask: Bool[Tensor, "n"]) -> Int[Tensor, "k"]:
        """Return the indices where a mask is set, ascending."""
        return mask.nonzero()[:, 0]

    def prefix(self, name: str, ascending: Int[Tensor, "n"], limit: int) -> slice:
        """Return the entries below `limit`."""
        return slice(0, int(torch.searchsorted(ascending, limit)))

    def read(
        self,
        name: str,
        value: Float[Tensor, ""] | Int[Tensor, ""],
        default: float | None = None,
    ) -> float:
        """Return this step's number."""
        return float(value.detach())

    def end_step(self) -> None:
        """Do nothing."""


class FixedBuffers:
    """Lists of fixed capacity, and numbers read two steps later; for a GPU."""

    deferred = True

    def __init__(self) -> None:
        self.n_rays = 1
        self.needed: dict[str, float] = {}  # entries a ray of each list, a decaying maximum
        self.values: dict[str, float] = {}  # the numbers that have arrived
        # Of this step: entries a ray and other numbers; then those on their way to the CPU.
        self.counts: dict[str, Tensor] = {}
        self.numbers: dict[str, Tensor] = {}
        self.pending: deque[tuple[list[str], list[str], Tensor, torch.cuda.Event | None]] = deque()

    def begin_step(self, rays: int) -> None:
        """Begin a step of `rays` rays."""
        self.n_rays = rays

    def capacity(self, name: str, limit: int) -> int | None:
        """Return the capacity of a list; `limit` while nothing is recorded of it."""
        if name not in self.needed:
            return limit
        return min(limit, max(MIN_CAPACITY, int(HEADROOM * self.needed[name] * self.n_rays) + 1))

    def record(self, name: str, count: Int[Tensor, ""]) -> None:
        """Record the entries that a list needed."""
        self.counts[name] = count.detach() / self.n_rays

    def indices(self, name: str, mask: Bool[Tensor, "n"]) -> Int[Tensor, "k"]:
        """Return the indices where a mask is set, then n - 1 up to the capacity."""
        last = mask.shape[0] - 1
        self.record(name, mask.sum())
        capacity = self.capacity(name, last + 1) or 1
        found = torch.nonzero_static(mask[:-1], size=capacity - 1, fill_value=last)[:, 0]
        return torch.cat([found, torch.full_like(mask[:1], last, dtype=torch.long)])

    def rows(self, mask: Bool[Tensor, "n"]) -> Int[Tensor, "n"]:
        """Return all indices."""
        return torch.arange(mask.shape[0], device=mask.device)

    def prefix(self, name: str, ascending: Int[Tensor, "n"], limit: int) -> slice:
        """Return the entries below `limit`, and others up to the capacity."""
        self.record(name, (ascending < limit).sum())
        return slice(0, self.capacity(name, ascending.shape[0]))

    def read(
        self,
        name: str,
        value: Float[Tensor, ""] | Int[Tensor, ""],
        default: float | None = None,
    ) -> float:
        """Return the latest number that has arrived, else `default`, else wait for this one."""
        self.numbers[name] = value.detach()
        if name in self.values:
            return self.values[name]
        return float(value.detach()) if default is None else default

    def end_step(self) -> None:
        """Start this step's read-backs, and take those that are due."""
        computed = [*self.counts.values(), *self.numbers.values()]
        if not computed:
            return
        packed = torch.stack([each.float() for each in computed])
        arrival = None
        if packed.is_cuda:
            pinned = torch.empty(packed.shape, device="cpu", pin_memory=True)
            pinned.copy_(packed, non_blocking=True)
            arrival = torch.cuda.Event()
            arrival.record()
            packed = pinned
        self.pending.append((list(self.counts), list(self.numbers), packed, arrival))
        self.counts, self.numbers = {}, {}
        while len(self.pending) >= (READ_BACK_DELAY if self.values else 1):
            counted, read, packed, arrival = self.pending.popleft()
            if arrival is not None:
                arrival.synchronize()
            values = to_numpy(packed).tolist()
            for name, value in zip(counted, values[: len(counted)], strict=True):
                self.needed[name] = max(value, DECAY * self.needed.get(name, 0.0))
            self.values.update(zip(read, values[len(counted) :], strict=True))


def buffers_for(device: torch.device) -> Buffers:
    """Return the buffers for a device: fixed ones for a GPU, exact ones elsewhere."""
    return FixedBuffers() if device.type == "cuda" else ExactBuffers()
