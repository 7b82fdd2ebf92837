"""A simulated device for PyTorch: tensors in CPU memory that report another device.

An operation that mixes them with CPU tensors raises an error, as it would with a GPU's, so tests
find missing transfers without a GPU. `kernels_for_toys` lets the CPU kernels read their memory.
"""

import contextlib
from unittest import mock

import torch
from torch.utils import _pytree as pytree
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

from climatenerf.ops import dispatch

_setup_privateuseone_for_python_backend("toy")
TOY = torch.device("toy:0")
TRANSFERS = {torch.ops.aten._to_copy.default, torch.ops.aten.copy_.default}
"""Operations that may have tensors of both devices."""


class Toy(torch.Tensor):
    """A tensor of the toy device that wraps a CPU tensor, `raw`."""

    raw: torch.Tensor

    def __repr__(self, **_) -> str:
        return f"Toy({self.raw!r})"

    @staticmethod
    def __new__(cls, raw: torch.Tensor):
        out = torch.Tensor._make_wrapper_subclass(
            cls,
            raw.size(),
            strides=raw.stride(),
            storage_offset=raw.storage_offset(),
            dtype=raw.dtype,
            device=TOY,
        )
        out.raw = raw
        return out

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return _call(func, args, kwargs or {})


def _call(func, args, kwargs):
    """Call an operation on the wrapped CPU tensors and wrap its result.

    Raises:
        RuntimeError: it mixes devices: CPU tensors that are not scalars, or a CPU generator.
    """
    inputs, _ = pytree.tree_flatten((args, kwargs))
    toys = {id(x.raw): x for x in inputs if isinstance(x, Toy)}
    for x in inputs:
        on_cpu = isinstance(x, torch.Tensor) and not isinstance(x, Toy)
        if on_cpu and x.dim() and toys and func not in TRANSFERS:
            raise RuntimeError(f"{func}: tensors on the toy device and on the CPU")
    device = kwargs.get("device")
    target = None if device is None else torch.device(device).type
    if (target == "toy" or toys) and kwargs.get("generator") is not None:
        raise RuntimeError(f"{func}: a CPU generator for the toy device")
    args, kwargs = pytree.tree_map(_unwrap, (args, kwargs))
    out = func(*args, **kwargs)
    if target == "cpu" or not isinstance(out, (torch.Tensor, tuple, list)):
        return out
    return pytree.tree_map(lambda x: _wrap(x, toys), out)


def _unwrap(x):
    """Return the CPU tensor or CPU device of a toy one; anything else as it is."""
    if isinstance(x, Toy):
        return x.raw
    return torch.device("cpu") if isinstance(x, torch.device) and x.type == "toy" else x


def _wrap(x, toys):
    """Return a CPU tensor as a toy one: that of `toys` (id of CPU tensor: wrapper), else new."""
    if not isinstance(x, torch.Tensor) or isinstance(x, Toy):
        return x
    return toys.get(id(x)) if id(x) in toys else Toy(x)  # in-place operations return their input


def _toy_kernel(func):
    return lambda *args, **kwargs: _call(func, args, kwargs)


_fallback = torch.library.Library("_", "IMPL")
_fallback.fallback(lambda func, *args, **kwargs: _call(func, args, kwargs), "PrivateUse1")
_aten = torch.library.Library("aten", "IMPL")
# PyTorch decomposes these before it calls the fallback; `arange` would resize its output.
for _name in (
    "_to_copy",
    "empty.memory_format",
    "empty_strided",
    "copy_",
    "_copy_from",
    "arange",
    "arange.start",
    "arange.start_step",
    "linspace",
    "eye",
    "eye.m",
):
    _packet, _, _overload = _name.partition(".")
    _func = getattr(getattr(torch.ops.aten, _packet), _overload or "default")
    _aten.impl(_name, _toy_kernel(_func), "PrivateUse1")


@contextlib.contextmanager
def kernels_for_toys():
    """Run the CPU kernels on toy tensors within the context."""

    def backend(*tensors):
        if any(t.dtype not in (torch.float32, torch.int64, torch.uint8) for t in tensors):
            return None
        (kind,) = {t.device.type for t in tensors}
        assert kind in ("toy", "cpu")
        return "cpu"

    def kernel_array(tensor):
        tensor = tensor.detach().contiguous()
        return (tensor.raw if isinstance(tensor, Toy) else tensor).numpy()

    with mock.patch.multiple(dispatch, backend=backend, kernel_array=kernel_array):
        yield
