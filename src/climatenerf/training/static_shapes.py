"""Lists of fixed length and numbers that come late, so that a step never waits for the card.

How many entries a mask holds, a GPU can tell only when it has done all that it was asked before;
asked that forty times a step, it and the processor take turns waiting for each other. So there a
list has room for half as many again as the last steps took, and what is left of the room points at
the mask's last entry, which its owner keeps without weight. Numbers that the program decides by are
those of two steps before. On a CPU nothing has to be waited for: lists are exact, numbers at hand.
"""

from collections import deque

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from climatenerf.core.device import to_numpy

LATE = 2  # steps until the card's numbers are read: when it still has the last one to do
SPARE = 1.5  # times what the last steps took
LEAST = 1024  # entries of a room, where there are so many
FORGET = 0.9  # of what most took, a step


class Rooms:
    """What the steps of a fit have room for, and what is known of them."""

    def __init__(self, fixed: bool):
        """`fixed`: as on a GPU, else exact."""
        self.fixed = fixed
        self.rays = 1
        self.taken: dict[str, float] = {}
        self.known: dict[str, float] = {}
        # Of this step, of entries a ray and of other numbers; and of those that are on their way.
        self.counted: dict[str, Tensor] = {}
        self.noted: dict[str, Tensor] = {}
        self.sent: deque[tuple[list[str], list[str], Tensor, torch.cuda.Event | None]] = deque()

    def begin(self, rays: int) -> None:
        """Begins a step of so many rays, with which what it takes grows."""
        self.rays = rays

    def room(self, name: str, most: int) -> int:
        """Entries that a list is given of `most`; all as long as nothing is known of it."""
        if name not in self.taken:
            return most
        return min(most, max(LEAST, int(SPARE * self.taken[name] * self.rays) + 1))

    def took(self, name: str, count: Int[Tensor, ""]) -> None:
        """Tells the entries that a list took, for its next rooms."""
        if self.fixed:
            self.counted[name] = count.detach() / self.rays

    def chosen(self, name: str, mask: Bool[Tensor, "n"]) -> Int[Tensor, "k"]:
        """Indices where a mask is set, ascending.

        In a fixed room the last are n - 1, at least one of them, whether it is set there or not;
        what finds no room is left out.
        """
        if not self.fixed:
            return mask.nonzero()[:, 0]
        last = mask.shape[0] - 1
        self.took(name, mask.sum())
        room = self.room(name, last + 1)
        found = torch.nonzero_static(mask[:-1], size=room - 1, fill_value=last)[:, 0]
        return torch.cat([found, torch.full_like(mask[:1], last, dtype=torch.long)])

    def below(self, name: str, ascending: Int[Tensor, "n"], limit: int) -> slice:
        """Those of some numbers, in order, that are below a limit; in a fixed room also others."""
        if not self.fixed:
            return slice(0, int(torch.searchsorted(ascending, limit)))
        self.took(name, (ascending < limit).sum())
        return slice(0, self.room(name, ascending.shape[0]))

    def late(
        self, name: str, value: Float[Tensor, ""] | Int[Tensor, ""], unknown: float | None = None
    ) -> float:
        """A number to decide by: this step's, or of fixed rooms one of two steps before.

        As long as there is none, `unknown`; without it the first are waited for.
        """
        if not self.fixed:
            return float(value.detach())
        self.noted[name] = value.detach()
        if name in self.known:
            return self.known[name]
        return float(value.detach()) if unknown is None else unknown

    def next_step(self) -> None:
        """Ends a step: sends its numbers off, and takes in those that should have come by now."""
        noted = [*self.counted.values(), *self.noted.values()]
        if not noted:
            return
        numbers = torch.stack([each.float() for each in noted])
        arrived = None
        if numbers.is_cuda:
            there = torch.empty(numbers.shape, device="cpu", pin_memory=True)
            there.copy_(numbers, non_blocking=True)
            arrived = torch.cuda.Event()
            arrived.record()
            numbers = there
        self.sent.append((list(self.counted), list(self.noted), numbers, arrived))
        self.counted, self.noted = {}, {}
        while len(self.sent) >= (LATE if self.known else 1):
            counted, noted, numbers, arrived = self.sent.popleft()
            if arrived is not None:
                arrived.synchronize()
            values = to_numpy(numbers).tolist()
            for name, value in zip(counted, values[: len(counted)], strict=True):
                self.taken[name] = max(value, FORGET * self.taken.get(name, 0.0))
            self.known.update(zip(noted, values[len(counted) :], strict=True))
