"""Multi-resolution hash encoding, with gradients."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.ops import dispatch, reference


class _HashEncode(torch.autograd.Function):
    @staticmethod
    def forward(ctx, u, table, resolutions, kernels):
        out = u.new_empty(2 * table.shape[0], u.shape[0])
        kernels.hash_encode(
            dispatch.kernel_array(u),
            dispatch.kernel_array(table),
            dispatch.kernel_array(resolutions),
            dispatch.kernel_array(out),
        )
        ctx.kernels = kernels
        ctx.save_for_backward(u, resolutions)
        ctx.table = table
        return out.T

    @staticmethod
    def backward(ctx, grad):
        u, resolutions = ctx.saved_tensors
        table = ctx.table
        grad_u = None
        if ctx.needs_input_grad[0]:
            grad_u = torch.empty_like(u, memory_format=torch.contiguous_format)
            ctx.kernels.hash_encode_slopes(
                dispatch.kernel_array(u),
                dispatch.kernel_array(grad.T),
                dispatch.kernel_array(table),
                dispatch.kernel_array(resolutions),
                dispatch.kernel_array(grad_u),
            )
        if not ctx.needs_input_grad[1]:
            return grad_u, None, None, None
        # A buffer kept on the table saves zeroing and copying megabytes each step: the optimiser
        # clears what it has used (training/optimiser.py).
        buffer = getattr(table, "grad_buffer", None)
        target = torch.zeros_like(table) if buffer is None else buffer
        ctx.kernels.hash_encode_backward(
            dispatch.kernel_array(u),
            dispatch.kernel_array(grad.T),
            dispatch.kernel_array(resolutions),
            dispatch.kernel_array(target),
        )
        return grad_u, (target if buffer is None else None), None, None


def hash_encode(
    u: Float[Tensor, "n 3"],
    table: Float[Tensor, "levels rows 2"],
    resolutions: Int[Tensor, "levels"],
) -> Float[Tensor, "n features"]:
    """See `reference.hash_encode`; gradients to the table and to the positions (once)."""
    if kernels := dispatch.kernels("encoding", u, table):
        return _HashEncode.apply(u, table, resolutions, kernels)
    return reference.hash_encode(u, table, resolutions)
