"""Values whose gradients are not their own."""

import torch
from jaxtyping import Float
from torch import Tensor


class _ScaledGradient(torch.autograd.Function):
    @staticmethod
    def forward(ctx, value, factor):
        ctx.save_for_backward(factor)
        return value.view_as(value)

    @staticmethod
    def backward(ctx, grad):
        (factor,) = ctx.saved_tensors
        return grad * factor, None


def scale_gradient(value: Float[Tensor, "*n"], factor: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """The same value, its gradient multiplied by a factor."""
    return _ScaledGradient.apply(value, factor)
