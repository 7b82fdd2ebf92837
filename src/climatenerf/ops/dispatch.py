"""Choice of kernels: dtype and device of the tensors decide which module computes an operation.

float32 tensors (with int64 indices and uint8 masks) on a CPU go to the Numba kernels in `ops/cpu`,
those on an NVIDIA GPU to the Triton kernels in `ops/triton`. Everything else goes to
`ops/reference.py`, which is slow but takes any dtype and device.
"""

from importlib import import_module
from types import ModuleType
from typing import Any, Literal

import torch
from torch import Tensor


def backend(*tensors: Tensor) -> Literal["cpu", "triton"] | None:
    """Return the package of kernels for these tensors; None where only the reference applies."""
    if not all(t.dtype in (torch.float32, torch.int64, torch.uint8) for t in tensors):
        return None
    devices = {t.device.type for t in tensors}
    if devices == {"cpu"}:
        return "cpu"
    return "triton" if devices == {"cuda"} else None


def kernels(operation: str, *tensors: Tensor) -> ModuleType | None:
    """Return the module with an operation's kernels for these tensors; None for the reference.

    Triton is imported on first use, because a computer without an NVIDIA GPU need not have it.
    """
    package = backend(*tensors)
    return None if package is None else import_module(f"climatenerf.ops.{package}.{operation}")


def kernel_array(tensor: Tensor) -> Any:
    """Return a tensor's data in the form that kernels take: contiguous; a NumPy array on a CPU.

    The data are copied only where the tensor is not contiguous.
    """
    tensor = tensor.detach().contiguous()
    return tensor if tensor.is_cuda else tensor.numpy()


def kernel_arrays(*tensors: Tensor) -> tuple[Any, ...]:
    """Return `kernel_array` of each tensor."""
    return tuple(kernel_array(tensor) for tensor in tensors)
