"""Small fully connected networks, with gradients, alone or fused with a hash encoding."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.ops import dispatch, encoding, reference
from climatenerf.ops.cpu import network as cpu


class _Network(torch.autograd.Function):
    """Store no hidden layer: the backward pass computes them again, block by block."""

    @staticmethod
    def forward(ctx, x, shared, row, *layers):
        weights, biases = layers[::2], layers[1::2]
        widths = np.array([x.shape[1], *(b.shape[0] for b in biases)])
        shared = x.new_empty(0, widths[1]) if shared is None else shared
        row = x.new_empty(0, dtype=torch.long) if row is None else row
        packed = _packed([w.T for w in weights], biases)
        out = x.new_empty(widths[-1], x.shape[0])
        x_array, shared_array, row_array, out_array = dispatch.kernel_arrays(x.T, shared, row, out)
        cpu.network_forward(x_array, shared_array, row_array, packed, widths, out_array)
        ctx.save_for_backward(x, shared, row, *layers)
        ctx.packed, ctx.widths = packed, widths
        return out.T

    @staticmethod
    def backward(ctx, grad):
        x, shared, row, *layers = ctx.saved_tensors
        packed, widths = ctx.packed, ctx.widths
        transposed = _packed(layers[::2], layers[1::2])
        inputs = dispatch.kernel_arrays(x.T, shared, row)
        chunks = cpu.chunk_bounds(inputs[2], x.shape[0])
        sums = x.new_zeros(chunks.shape[0] - 1, packed.shape[0])
        grad_x = x.new_empty(widths[0] if ctx.needs_input_grad[0] else 0, x.shape[0])
        grad_shared = torch.zeros_like(shared if ctx.needs_input_grad[1] else shared[:0])
        cpu.network_backward(
            inputs,
            packed,
            transposed,
            widths,
            dispatch.kernel_array(grad.T),
            chunks,
            dispatch.kernel_arrays(grad_x, grad_shared, sums),
        )
        grad_layers, start, total = [], 0, sums.sum(0)
        for n_in, n_out in zip(widths[:-1].tolist(), widths[1:].tolist(), strict=True):
            end = start + n_out * (n_in + 1)
            layer = total[start:end].view(n_out, n_in + 1)
            grad_layers += [layer[:, :-1].T, layer[:, -1]]
            start = end
        return (
            grad_x.T if ctx.needs_input_grad[0] else None,
            grad_shared if ctx.needs_input_grad[1] else None,
            None,
            *grad_layers,
        )


def _packed(weights: Sequence[Tensor], biases: Sequence[Tensor]) -> np.ndarray:
    """Return all layers as one flat array, as `cpu.network` takes them."""
    pairs = zip(weights, biases, strict=True)
    return np.concatenate([a.reshape(-1) for pair in pairs for a in dispatch.kernel_arrays(*pair)])


def mlp(
    x: Float[Tensor, "n i"],
    layers: list[tuple[Tensor, Tensor]],
    shared: Float[Tensor, "m h"] | None = None,
    row: Int[Tensor, "n"] | None = None,
) -> Float[Tensor, "n o"]:
    """Return the network's outputs: `reference.mlp`.

    The CPU kernel is for networks with hidden layers. A GPU uses PyTorch's matrix products.
    """
    inputs = [x, *(each for pair in layers for each in pair), *([] if shared is None else [shared])]
    if len(layers) > 1 and dispatch.backend(*inputs) == "cpu":
        return _Network.apply(x, shared, row, *(each for pair in layers for each in pair))
    return reference.mlp(x, layers, shared, row)


class _EncodedNetwork(torch.autograd.Function):
    """An encoding and the network on it in one launch; stores only the positions."""

    @staticmethod
    def forward(ctx, u, table, resolutions, shared, row, w1, b1, w2, b2):
        from climatenerf.ops.triton import network as triton

        out = torch.empty(u.shape[0], w2.shape[1], device=u.device)
        triton.network_forward(
            dispatch.kernel_array(u),
            dispatch.kernel_arrays(table, resolutions),
            dispatch.kernel_arrays(w1, b1, w2, b2),
            None if shared is None else dispatch.kernel_arrays(shared, row),
            out,
        )
        ctx.save_for_backward(u, resolutions, shared, row, w1, b1, w2, b2)
        ctx.table = table
        return out

    @staticmethod
    def backward(ctx, grad):
        from climatenerf.ops.triton import network as triton

        u, resolutions, shared, row, *layers = ctx.saved_tensors
        u = dispatch.kernel_array(u)
        rays = None if shared is None else dispatch.kernel_arrays(shared, row)
        tables = dispatch.kernel_arrays(ctx.table, resolutions)
        # As in `encoding`: the optimiser clears the entries of the buffer that it has used.
        buffer = getattr(ctx.table, "grad_buffer", None)
        grad_table = grad_shared = grad_u = None
        if ctx.needs_input_grad[1]:
            grad_table = torch.zeros_like(tables[0]) if buffer is None else buffer
        if rays and ctx.needs_input_grad[3]:
            grad_shared = torch.zeros_like(rays[0])
        if ctx.needs_input_grad[0]:
            grad_u = torch.empty_like(u, memory_format=torch.contiguous_format)
        grad_layers = triton.network_backward(
            u,
            tables,
            dispatch.kernel_arrays(*layers),
            rays,
            dispatch.kernel_array(grad),
            (grad_table, grad_shared, grad_u),
        )
        return (
            grad_u,
            grad_table if buffer is None else None,
            None,
            grad_shared,
            None,
            *grad_layers,
        )


def encoded_mlp(
    u: Float[Tensor, "n 3"],
    table: Float[Tensor, "levels rows 2"],
    resolutions: Int[Tensor, "levels"],
    layers: list[tuple[Tensor, Tensor]],
    shared: Float[Tensor, "m h"] | None = None,
    row: Int[Tensor, "n"] | None = None,
) -> Float[Tensor, "n o"]:
    """Return `mlp` of `hash_encode`; on a GPU, with one hidden layer, in one launch."""
    inputs = [u, table, *(each for pair in layers for each in pair)]
    inputs += [] if shared is None else [shared]
    if len(layers) == 2 and dispatch.backend(*inputs) == "triton":
        return _EncodedNetwork.apply(u, table, resolutions, shared, row, *layers[0], *layers[1])
    return mlp(encoding.hash_encode(u, table, resolutions), layers, shared, row)
