"""On which device numbers lie.

Work is done on the device of the `with torch.device(...)` block around it: what torch makes lies
there by itself, and this brings the rest. A fit's random numbers (but for its networks' first
values and the order of occupied cells) are drawn on the CPU, so that a seed means much the same on
every device.
"""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor


def to_device(array: np.ndarray) -> Tensor:
    """An array's numbers on the device in use; on a CPU they share its memory."""
    return torch.from_numpy(array).to(torch.get_default_device())


def to_numpy(tensor: Tensor) -> np.ndarray:
    """A tensor's numbers on the CPU; it shares the memory of one that is there."""
    return tensor.detach().cpu().numpy()


def uniform(generator: torch.Generator, *shape: int) -> Float[Tensor, "..."]:
    """Random numbers in [0,1)."""
    return upload(torch.rand(shape, generator=generator, device="cpu"))


def integers(generator: torch.Generator, low: int, high: int, *shape: int) -> Int[Tensor, "..."]:
    """Random whole numbers from low to high - 1."""
    drawn = torch.randint(low, high, shape, generator=generator, device="cpu")
    return upload(drawn)


def upload(tensor: Tensor) -> Tensor:
    """Numbers of the CPU on the device in use; on a GPU they arrive before they are asked for."""
    device = torch.get_default_device()
    if device.type != "cuda":
        return tensor.to(device)
    return tensor.pin_memory().to(device, non_blocking=True)
