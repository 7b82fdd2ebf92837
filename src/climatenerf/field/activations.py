"""Activations of the networks' outputs: radiance and density.

The `plain_` functions are the specification, in PyTorch. float32 tensors on a CPU go to kernels
that compute the same in one pass through memory.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from climatenerf.core.colour import decode_srgb
from climatenerf.core.vectors import length
from climatenerf.ops.cpu import activations as cpu
from climatenerf.ops.cpu.activations import BLACK, MAX_RAW, MIN_SLOPE, SHARPNESS


def radiance(raw: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Return `plain_radiance`, faster for float32 on a CPU."""
    if _on_cpu(raw):  # feature-major, as the networks return it
        return _Radiance.apply(raw.T.contiguous()).T
    return plain_radiance(raw)


def plain_radiance(raw: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Return the linear radiance of network outputs.

    Softplus of raw + 0.5 gives a display value >= 0 without an upper bound, which is decoded. With
    sharpness 8 it is nearly the identity from 0.3 up.
    """
    return decode_srgb(_Brightness.apply(raw + 0.5))


def density_from_raw(raw: Float[Tensor, "n"], u: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Return `plain_density_from_raw`, faster for float32 on a CPU."""
    if _on_cpu(raw, u) and not u.requires_grad:
        return _Density.apply(raw.contiguous(), u.contiguous())
    return plain_density_from_raw(raw, u)


def plain_density_from_raw(raw: Float[Tensor, "n"], u: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Return the density (1/grid unit) at unit-cube u from its logarithm per contracted length.

    Outside the core it is divided by |q|^2 (see `reference.density`), which follows from the
    contracted radius 2 - 1/|q|.
    """
    # 1e-4: in the outermost shell rounding could make it negative.
    shell = (2.0 - length(4.0 * u - 2.0)).clamp(1e-4, 1.0)
    return raw.clamp_max(MAX_RAW).exp() * shell.square()


def _on_cpu(*tensors: Tensor) -> bool:
    return all(t.device.type == "cpu" and t.dtype == torch.float32 for t in tensors)


class _Brightness(torch.autograd.Function):
    """Softplus with a minimum slope for gradients that brighten.

    Near black the slope of a softplus vanishes. Adam takes full steps even for vanishing gradients,
    so that colours which darken for a while would sink ever deeper and never recover: one fit in
    which the sky shone through haze stayed black for good.
    """

    @staticmethod
    def forward(ctx, x):
        ctx.save_for_backward(x)
        return torch.nn.functional.softplus(x, beta=SHARPNESS)

    @staticmethod
    def backward(ctx, grad):
        (x,) = ctx.saved_tensors
        slope = torch.sigmoid(SHARPNESS * x)
        # The optimiser steps against the gradient: negative gradients brighten.
        return grad * torch.where(grad < 0, slope.clamp_min(MIN_SLOPE), slope * (x > BLACK))


class _Radiance(torch.autograd.Function):
    @staticmethod
    def forward(ctx, rows):
        out = torch.empty_like(rows)
        cpu.radiance_forward(*_flat(rows, out))
        ctx.save_for_backward(rows, out)
        return out

    @staticmethod
    def backward(ctx, grad):
        rows, out = ctx.saved_tensors
        grad_rows = torch.empty_like(rows)
        cpu.radiance_backward(*_flat(rows, out, grad.contiguous(), grad_rows))
        return grad_rows


class _Density(torch.autograd.Function):
    @staticmethod
    def forward(ctx, raw, u):
        out = torch.empty_like(raw)
        cpu.density_forward(raw.numpy(), u.numpy(), out.numpy())
        ctx.save_for_backward(raw, out)
        return out

    @staticmethod
    def backward(ctx, grad):
        raw, out = ctx.saved_tensors
        grad_raw = torch.empty_like(raw)
        cpu.density_backward(*_flat(raw, out, grad.contiguous(), grad_raw))
        return grad_raw, None


def _flat(*tensors: Tensor) -> list:
    """Return contiguous tensors as flat arrays that share their memory."""
    return [each.detach().view(-1).numpy() for each in tensors]
