"""On which device a field is fitted and rendered."""

import contextlib
import importlib.util
import os
import shutil
from collections.abc import Iterator

import torch

from climatenerf.errors import UserError


@contextlib.contextmanager
def on(device: str) -> Iterator[None]:
    """Work within it is done on that device, "cpu" or "cuda".

    Raises:
        UserError: there is no such device, or what its kernels need is missing.
    """
    if device == "cpu":
        yield
        return
    if not torch.cuda.is_available():
        raise UserError(
            "PyTorch finds no NVIDIA GPU; install the card's driver and PyTorch with CUDA, or leave"
            " --device out"
        )
    if importlib.util.find_spec("triton") is None:
        raise UserError(
            "--device cuda needs Triton, which comes with PyTorch for CUDA on Linux; install it"
            " (pip install triton), or leave --device out"
        )
    if not any(map(shutil.which, (os.environ.get("CC", "cc"), "gcc", "clang"))):
        raise UserError(
            "Triton builds what starts kernels with a C compiler, and finds none; install one"
            " (apt install gcc python3-dev), or leave --device out"
        )
    with torch.device(device):
        yield
