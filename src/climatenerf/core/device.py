"""The device on which a fit or a render computes, and transfers to and from it.

`resolve_device` turns the user's choice into a device, which goes to what is made first: a field
that is loaded, the pixels of a fit. All else takes the device of a tensor at hand, so every call
that creates a tensor names its device. A fit draws its random numbers on the CPU, except the order
of occupied cells, so that one seed gives much the same fit on every device.
"""

import importlib.metadata
import os
import re
import shutil
import sysconfig
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.core.errors import UserError

MIN_TRITON = (3, 4)  # the first version that compiles these kernels; PyTorch 2.8 includes it
CPU = torch.device("cpu")


def to_device(array: np.ndarray, device: torch.device) -> Tensor:
    """Return an array as a tensor on a device; on a CPU it shares the array's memory."""
    return torch.from_numpy(array).to(device)


def to_numpy(tensor: Tensor) -> np.ndarray:
    """Return a tensor as an array; it shares the memory of a tensor on the CPU."""
    return tensor.detach().cpu().numpy()


def upload(tensor: Tensor, device: torch.device) -> Tensor:
    """Copy a tensor of the CPU to a device; to a GPU without waiting for the copy."""
    if device.type != "cuda":
        return tensor.to(device)
    return tensor.pin_memory().to(device, non_blocking=True)


def uniform(generator: torch.Generator, *shape: int, device: torch.device) -> Float[Tensor, "..."]:
    """Return random numbers in [0,1) on a device, drawn on the CPU."""
    return upload(torch.rand(shape, generator=generator, device="cpu"), device)


def integers(
    generator: torch.Generator, low: int, high: int, *shape: int, device: torch.device
) -> Int[Tensor, "..."]:
    """Return random integers from low to high - 1 on a device, drawn on the CPU."""
    drawn = torch.randint(low, high, shape, generator=generator, device="cpu")
    return upload(drawn, device)


def check_triton() -> None:
    """Check for what the GPU kernels need besides PyTorch: Triton, a C compiler, Python's headers.

    Raises:
        UserError: one of them is missing.
    """
    try:
        version = importlib.metadata.version("triton")
    except importlib.metadata.PackageNotFoundError:
        version = "0"
    if tuple(map(int, re.findall(r"\d+", version)[:2])) < MIN_TRITON:
        raise UserError(
            "--device cuda needs Triton 3.4, which comes with PyTorch 2.8 for CUDA on Linux;"
            " install that PyTorch or a newer one, or leave --device out"
        )
    # Triton compiles a launcher for each kernel, and looks for a compiler in this order.
    compiler = os.environ.get("CC") or shutil.which("gcc") or shutil.which("clang")
    headers = Path(sysconfig.get_path("include"), "Python.h")
    if compiler is None or shutil.which(compiler) is None or not headers.is_file():
        raise UserError(
            "Triton needs a C compiler and Python's headers, and one of them is missing; install"
            " both (apt install gcc python3-dev), or leave --device out"
        )


def resolve_device(name: str) -> torch.device:
    """Return the device of a name, "cpu" or "cuda", after a check that it can be used.

    Raises:
        UserError: there is no such device, or something that its kernels need is missing.
    """
    if name == "cpu":
        return CPU
    if not torch.cuda.is_available():
        raise UserError(
            "PyTorch finds no NVIDIA GPU; install the card's driver and PyTorch with CUDA, or leave"
            " --device out"
        )
    check_triton()
    return torch.device(name)
