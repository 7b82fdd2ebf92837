"""A device that is none: its tensors lie on the CPU, but refuse to meet tensors that do.

Where no GPU is at hand this shows which code would fail on one. Kernels read its tensors as they
would a GPU's (`kernels_for_toys`).
"""

import contextlib
from unittest import mock

import torch
from torch.utils import _pytree as pytree
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

from climatenerf.ops import dispatch

_setup_privateuseone_for_python_backend("toy")
TOY = torch.device("toy:0")
CROSSING = {torch.ops.aten._to_copy.default, torch.ops.aten.copy_.default}


class Toy(torch.Tensor):
    """A tensor of that device, around one of the CPU."""

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
    given, _ = pytree.tree_flatten((args, kwargs))
    toys = {id(x.raw): x for x in given if isinstance(x, Toy)}
    for x in given:
        foreign = isinstance(x, torch.Tensor) and not isinstance(x, Toy)
        if foreign and x.dim() and toys and func not in CROSSING:
            raise RuntimeError(f"{func}: tensors of the device and of the CPU")
    device = kwargs.get("device")
    here = device is not None and torch.device(device).type == "toy"
    if (here or toys) and kwargs.get("generator") is not None:
        raise RuntimeError(f"{func}: a generator of the CPU on the device")
    args, kwargs = pytree.tree_map(_bare, (args, kwargs))
    out = func(*args, **kwargs)
    leaves = device is not None and torch.device(device).type == "cpu"
    if leaves or not isinstance(out, (torch.Tensor, tuple, list)):
        return out
    return pytree.tree_map(lambda x: _dressed(x, toys), out)


def _bare(x):
    if isinstance(x, Toy):
        return x.raw
    return torch.device("cpu") if isinstance(x, torch.device) and x.type == "toy" else x


def _dressed(x, toys):
    if not isinstance(x, torch.Tensor) or isinstance(x, Toy):
        return x
    return toys.get(id(x)) if id(x) in toys else Toy(x)  # in-place: the tensor itself


def _as_kernel(func):
    return lambda *args, **kwargs: _call(func, args, kwargs)


_rest = torch.library.Library("_", "IMPL")
_rest.fallback(lambda func, *args, **kwargs: _call(func, args, kwargs), "PrivateUse1")
_aten = torch.library.Library("aten", "IMPL")
# Those that PyTorch would make of others before the fallback is asked, and arange by resizing.
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
    _aten.impl(_name, _as_kernel(_func), "PrivateUse1")


@contextlib.contextmanager
def kernels_for_toys():
    """Within it the CPU's kernels compute for the device."""

    def backend(*tensors):
        if any(t.dtype not in (torch.float32, torch.int64, torch.uint8) for t in tensors):
            return None
        (kind,) = {t.device.type for t in tensors}
        assert kind in ("toy", "cpu")
        return "cpu"

    def kernel_array(tensor):
        bare = tensor.detach().contiguous()
        return (bare.raw if isinstance(bare, Toy) else bare).numpy()

    with mock.patch.multiple(dispatch, backend=backend, kernel_array=kernel_array):
        yield
