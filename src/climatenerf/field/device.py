"""On which device a field is fitted and rendered."""

import contextlib
import importlib.metadata
import os
import re
import shutil
import sysconfig
from collections.abc import Iterator
from pathlib import Path

import torch

from climatenerf.core.errors import UserError

TRITON = (3, 4)  # the first that takes our kernels; PyTorch 2.8 brings it


def check_triton() -> None:
    """What a GPU's kernels need beside PyTorch is there.

    Raises:
        UserError: what is missing, and where to get it.
    """
    try:
        version = importlib.metadata.version("triton")
    except importlib.metadata.PackageNotFoundError:
        version = "0"
    if tuple(map(int, re.findall(r"\d+", version)[:2])) < TRITON:
        raise UserError(
            "--device cuda needs Triton 3.4, which comes with PyTorch 2.8 for CUDA on Linux;"
            " install that PyTorch or a newer one, or leave --device out"
        )
    # Triton builds what starts its kernels, and looks for a compiler in this order.
    compiler = os.environ.get("CC") or shutil.which("gcc") or shutil.which("clang")
    headers = Path(sysconfig.get_path("include"), "Python.h")
    if compiler is None or shutil.which(compiler) is None or not headers.is_file():
        raise UserError(
            "Triton needs a C compiler and Python's headers, and lacks one of them; install both"
            " (apt install gcc python3-dev), or leave --device out"
        )


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
    check_triton()
    with torch.device(device):
        yield
