"""Small fully connected networks, with gradients, and an encoding fused with one."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.ops import dispatch, encoding, reference
from climatenerf.ops.cpu import network as cpu


class _Network(torch.autograd.Function):
    """Keeps no hidden layer: the backward pass computes them again, block by block."""

    @staticmethod
    def forward(ctx, x, shared, row, *layers):
        weights, widths = layers[::2], np.array([x.shape[1], *(b.shape[0] for b in layers[1::2])])
        common = x.new_empty(0, widths[1]) if shared is None else shared
        rows = x.new_empty(0, dtype=torch.long) if row is None else row
        packed = _in_one_row([w.T for w in weights], layers[1::2])
        out = x.new_empty(widths[-1], x.shape[0])
        cpu.network_forward(
            dispatch.kernel_array(x.T),
            dispatch.kernel_array(common),
            dispatch.kernel_array(rows),
            packed,
            widths,
            dispatch.kernel_array(out),
        )
        ctx.save_for_backward(x, common, rows, *layers)
        ctx.given = packed, widths
        return out.T

    @staticmethod
    def backward(ctx, grad):
        x, common, rows, *layers = ctx.saved_tensors
        packed, widths = ctx.given
        turned = _in_one_row(layers[::2], layers[1::2])
        borders = cpu.chunk_borders(dispatch.kernel_array(rows), x.shape[0])
        sums = x.new_zeros(borders.shape[0] - 1, packed.shape[0])
        grad_x = x.new_empty(widths[0] if ctx.needs_input_grad[0] else 0, x.shape[0])
        grad_shared = torch.zeros_like(common if ctx.needs_input_grad[1] else common[:0])
        cpu.network_backward(
            (
                dispatch.kernel_array(x.T),
                dispatch.kernel_array(common),
                dispatch.kernel_array(rows),
            ),
            packed,
            turned,
            widths,
            dispatch.kernel_array(grad.T),
            borders,
            (
                dispatch.kernel_array(grad_x),
                dispatch.kernel_array(grad_shared),
                dispatch.kernel_array(sums),
            ),
        )
        of_layers, start, total = [], 0, sums.sum(0)
        for inputs, outputs in zip(widths[:-1].tolist(), widths[1:].tolist(), strict=True):
            end = start + outputs * (inputs + 1)
            own = total[start:end].view(outputs, inputs + 1)
            of_layers += [own[:, :-1].T, own[:, -1]]
            start = end
        return (
            grad_x.T if ctx.needs_input_grad[0] else None,
            grad_shared if ctx.needs_input_grad[1] else None,
            None,
            *of_layers,
        )


def _in_one_row(weights: Sequence[Tensor], biases: Sequence[Tensor]) -> np.ndarray:
    """Layers as `cpu_network` takes them."""
    pairs = zip(weights, biases, strict=True)
    return np.concatenate(
        [dispatch.kernel_array(each).reshape(-1) for pair in pairs for each in pair]
    )


def mlp(
    x: Float[Tensor, "n i"],
    layers: list[tuple[Tensor, Tensor]],
    shared: Float[Tensor, "m h"] | None = None,
    row: Int[Tensor, "n"] | None = None,
) -> Float[Tensor, "n o"]:
    """See `reference.mlp`, which it is but for networks of 32 bits with hidden layers on a CPU."""
    given = [x, *(each for pair in layers for each in pair), *([] if shared is None else [shared])]
    if (
        dispatch.kernels("network", *given) is cpu and len(layers) > 1
    ):  # a GPU's own matrix products are fast
        return _Network.apply(x, shared, row, *(each for pair in layers for each in pair))
    return reference.mlp(x, layers, shared, row)


class _EncodedNetwork(torch.autograd.Function):
    """An encoding and the network on it in one launch. Keeps nothing but where the samples are."""

    @staticmethod
    def forward(ctx, u, table, resolutions, shared, row, w1, b1, w2, b2):
        from climatenerf.ops.triton import network as triton

        rays = (
            None if shared is None else (dispatch.kernel_array(shared), dispatch.kernel_array(row))
        )
        encoding, layers = (
            (dispatch.kernel_array(table), dispatch.kernel_array(resolutions)),
            tuple(map(dispatch.kernel_array, (w1, b1, w2, b2))),
        )
        out = torch.empty(u.shape[0], w2.shape[1], device=u.device)
        triton.network_forward(dispatch.kernel_array(u), encoding, layers, rays, out)
        ctx.save_for_backward(u, resolutions, shared, row, w1, b1, w2, b2)
        ctx.table = table
        return out

    @staticmethod
    def backward(ctx, grad):
        from climatenerf.ops.triton import network as triton

        u, resolutions, shared, row, *layers = ctx.saved_tensors
        u, layers = dispatch.kernel_array(u), tuple(map(dispatch.kernel_array, layers))
        rays = (
            None if shared is None else (dispatch.kernel_array(shared), dispatch.kernel_array(row))
        )
        encoding = dispatch.kernel_array(ctx.table), dispatch.kernel_array(resolutions)
        # As `_HashEncode.backward`: the optimiser clears what it has used.
        buffer = getattr(ctx.table, "grad_buffer", None)
        learns = ctx.needs_input_grad[1]
        of_table = (torch.zeros_like(encoding[0]) if buffer is None else buffer) if learns else None
        of_shared = torch.zeros_like(rays[0]) if rays and ctx.needs_input_grad[3] else None
        of_u = torch.empty_like(u) if ctx.needs_input_grad[0] else None
        of_layers = triton.network_backward(
            u, encoding, layers, rays, dispatch.kernel_array(grad), (of_table, of_shared, of_u)
        )
        return of_u, (of_table if buffer is None else None), None, of_shared, None, *of_layers


def encoded_mlp(
    u: Float[Tensor, "n 3"],
    table: Float[Tensor, "levels rows 2"],
    resolutions: Int[Tensor, "levels"],
    layers: list[tuple[Tensor, Tensor]],
    shared: Float[Tensor, "m h"] | None = None,
    row: Int[Tensor, "n"] | None = None,
) -> Float[Tensor, "n o"]:
    """`mlp` of `hash_encode`: on a GPU in one launch, where there is one hidden layer."""
    given = [u, table, *(each for pair in layers for each in pair)]
    if (
        dispatch.kernels("network", *given, *([] if shared is None else [shared]))
        not in (None, cpu)
        and len(layers) == 2
    ):
        return _EncodedNetwork.apply(u, table, resolutions, shared, row, *layers[0], *layers[1])
    return mlp(encoding.hash_encode(u, table, resolutions), layers, shared, row)
