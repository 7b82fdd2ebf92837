"""Multi-resolution hash encoding (Müller et al. 2022), with gradients."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.ops import dispatch, reference


class _HashEncode(torch.autograd.Function):
    @staticmethod
    def forward(ctx, u, table, resolutions, kernels):
        out = u.new_empty(2 * table.shape[0], u.shape[0])
        kernels.hash_encode(*dispatch.kernel_arrays(u, table, resolutions, out))
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
                *dispatch.kernel_arrays(u, grad.T, table, resolutions, grad_u)
            )
        if not ctx.needs_input_grad[1]:
            return grad_u, None, None, None
        # A buffer kept on the table avoids zeroing and copying megabytes each step: the optimiser
        # clears the entries that it has used (training/optimiser.py).
        buffer = getattr(table, "grad_buffer", None)
        grad_table = torch.zeros_like(table) if buffer is None else buffer
        ctx.kernels.hash_encode_backward(
            *dispatch.kernel_arrays(u, grad.T, resolutions, grad_table)
        )
        return grad_u, (grad_table if buffer is None else None), None, None


def hash_encode(
    u: Float[Tensor, "n 3"],
    table: Float[Tensor, "levels rows 2"],
    resolutions: Int[Tensor, "levels"],
) -> Float[Tensor, "n features"]:
    """Return the features of unit-cube positions u: `reference.hash_encode`.

    Gradients, of first order only, go to the table and to u. Features are feature-major in memory.
    """
    if kernels := dispatch.kernels("encoding", u, table):
        return _HashEncode.apply(u, table, resolutions, kernels)
    return reference.hash_encode(u, table, resolutions)
