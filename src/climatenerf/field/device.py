"""On which device a field is fitted and rendered."""

import contextlib
from collections.abc import Iterator

import torch

from climatenerf.errors import UserError


@contextlib.contextmanager
def on(device: str) -> Iterator[None]:
    """Work within it is done on that device, "cpu" or "cuda".

    Raises:
        UserError: there is no such device.
    """
    if device == "cpu":
        yield
        return
    if not torch.cuda.is_available():
        raise UserError(
            "PyTorch finds no NVIDIA GPU; install PyTorch with CUDA, the card's driver and the CUDA"
            " toolkit, or leave --device out"
        )
    with torch.device(device):
        yield
