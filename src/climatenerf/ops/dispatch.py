"""The operations as the rest of the program calls them: one function each, with gradients.

The device of the tensors decides the kernel. CPU tensors of 32 bits go to Numba (`cpu.py`);
everything else goes to the reference, which is slow and always right.
"""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.ops import cpu, cpu_network, reference


def _fast(*tensors: Tensor) -> bool:
    return all(t.device.type == "cpu" and t.dtype in (torch.float32, torch.int64) for t in tensors)


def _np(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()


class _HashEncode(torch.autograd.Function):
    @staticmethod
    def forward(ctx, u, table, resolutions):
        out = torch.empty(2 * table.shape[0], u.shape[0])
        cpu.hash_encode(_np(u), _np(table), _np(resolutions), out.numpy())
        ctx.save_for_backward(u, resolutions)
        ctx.table = table
        return out.T

    @staticmethod
    def backward(ctx, grad):
        u, resolutions = ctx.saved_tensors
        table = ctx.table
        grad_u = None
        if ctx.needs_input_grad[0]:
            grad_u = torch.empty_like(u)
            cpu.hash_encode_slopes(
                _np(u), _np(grad.T), _np(table), _np(resolutions), grad_u.numpy()
            )
        if not ctx.needs_input_grad[1]:
            return grad_u, None, None
        # A buffer kept on the table saves zeroing and copying megabytes each step: the optimiser
        # clears what it has used (training/optimiser.py).
        buffer = getattr(table, "grad_buffer", None)
        target = torch.zeros_like(table) if buffer is None else buffer
        cpu.hash_encode_backward(_np(u), _np(grad.T), _np(resolutions), target.numpy())
        return grad_u, (target if buffer is None else None), None


def hash_encode(
    u: Float[Tensor, "n 3"],
    table: Float[Tensor, "levels rows 2"],
    resolutions: Int[Tensor, "levels"],
) -> Float[Tensor, "n features"]:
    """See `reference.hash_encode`; gradients to the table and to the positions (once)."""
    if _fast(u, table):
        return _HashEncode.apply(u, table, resolutions)
    return reference.hash_encode(u, table, resolutions)


class _RenderWeights(torch.autograd.Function):
    @staticmethod
    def forward(ctx, tau, offsets):
        weights, left = torch.empty_like(tau), torch.empty(offsets.shape[0] - 1)
        cpu.weights_forward(_np(tau), _np(offsets), weights.numpy(), left.numpy())
        ctx.save_for_backward(tau, offsets)
        return weights, left

    @staticmethod
    def backward(ctx, grad_w, grad_t):
        tau, offsets = ctx.saved_tensors
        grad = torch.empty_like(tau)
        cpu.weights_backward(_np(tau), _np(offsets), _np(grad_w), _np(grad_t), grad.numpy())
        return grad, None


def render_weights(
    tau: Float[Tensor, "s"], offsets: Int[Tensor, "rays+1"]
) -> tuple[Float[Tensor, "s"], Float[Tensor, "rays"]]:
    """See `reference.render_weights`."""
    if _fast(tau, offsets):
        return _RenderWeights.apply(tau, offsets)
    return reference.render_weights(tau, offsets)


class _Accumulate(torch.autograd.Function):
    @staticmethod
    def forward(ctx, weights, values, offsets):
        out = torch.empty(offsets.shape[0] - 1, values.shape[1])
        cpu.accumulate_forward(_np(weights), _np(values), _np(offsets), out.numpy())
        ctx.save_for_backward(weights, values, offsets)
        return out

    @staticmethod
    def backward(ctx, grad):
        weights, values, offsets = ctx.saved_tensors
        grad_w, grad_v = torch.empty_like(weights), torch.empty(values.shape)
        cpu.accumulate_backward(
            _np(weights), _np(values), _np(offsets), _np(grad), grad_w.numpy(), grad_v.numpy()
        )
        return grad_w, grad_v, None


def accumulate(
    weights: Float[Tensor, "s"], values: Float[Tensor, "s c"], offsets: Int[Tensor, "rays+1"]
) -> Float[Tensor, "rays c"]:
    """See `reference.accumulate`."""
    if _fast(weights, values, offsets):
        return _Accumulate.apply(weights, values, offsets)
    return reference.accumulate(weights, values, offsets)


class _Distortion(torch.autograd.Function):
    @staticmethod
    def forward(ctx, weights, s, ds, offsets):
        out = torch.empty(offsets.shape[0] - 1)
        cpu.distortion_forward(_np(weights), _np(s), _np(ds), _np(offsets), out.numpy())
        ctx.save_for_backward(weights, s, ds, offsets)
        return out

    @staticmethod
    def backward(ctx, grad):
        weights, s, ds, offsets = ctx.saved_tensors
        grad_w = torch.empty_like(weights)
        cpu.distortion_backward(
            _np(weights), _np(s), _np(ds), _np(offsets), _np(grad), grad_w.numpy()
        )
        return grad_w, None, None, None


def distortion(
    weights: Float[Tensor, "s"],
    s: Float[Tensor, "s"],
    ds: Float[Tensor, "s"],
    offsets: Int[Tensor, "rays+1"],
) -> Float[Tensor, "rays"]:
    """See `reference.distortion`; gradients to the weights only."""
    if _fast(weights, s, ds, offsets):
        return _Distortion.apply(weights, s, ds, offsets)
    return reference.distortion(weights, s, ds, offsets)


class _Network(torch.autograd.Function):
    """One hidden layer. Keeps none of it: the backward pass computes it again, block by block."""

    @staticmethod
    def forward(ctx, x, shared, row, w1, b1, w2, b2):
        common = torch.empty(0, w1.shape[1]) if shared is None else shared
        rows = torch.empty(0, dtype=torch.long) if row is None else row
        out = torch.empty(w2.shape[1], x.shape[0])
        cpu_network.network_forward(
            _np(x.T),
            _np(common),
            _np(rows),
            _np(w1.T),
            _np(b1),
            _np(w2.T),
            _np(b2),
            out.numpy(),
        )
        ctx.save_for_backward(x, common, rows, w1, b1, w2)
        return out.T

    @staticmethod
    def backward(ctx, grad):
        x, common, rows, w1, b1, w2 = ctx.saved_tensors
        inputs, hidden = w1.shape
        borders = cpu_network.chunk_borders(rows.numpy(), x.shape[0])
        chunks = borders.shape[0] - 1
        sums1 = torch.zeros(chunks, hidden, inputs + 1)
        sums2 = torch.zeros(chunks, w2.shape[1], hidden + 1)
        grad_x = torch.empty(inputs if ctx.needs_input_grad[0] else 0, x.shape[0])
        grad_shared = torch.zeros_like(common if ctx.needs_input_grad[1] else common[:0])
        cpu_network.network_backward(
            (_np(x.T), _np(common), _np(rows)),
            (_np(w1.T), _np(b1), _np(w2.T)),
            (_np(w1), _np(w2)),
            _np(grad.T),
            borders,
            (grad_x.numpy(), grad_shared.numpy(), sums1.numpy(), sums2.numpy()),
        )
        first, second = sums1.sum(0), sums2.sum(0)
        return (
            grad_x.T if ctx.needs_input_grad[0] else None,
            grad_shared if ctx.needs_input_grad[1] else None,
            None,
            first[:, :-1].T,
            first[:, -1],
            second[:, :-1].T,
            second[:, -1],
        )


def mlp(
    x: Float[Tensor, "n i"],
    layers: list[tuple[Tensor, Tensor]],
    shared: Float[Tensor, "m h"] | None = None,
    row: Int[Tensor, "n"] | None = None,
) -> Float[Tensor, "n o"]:
    """See `reference.mlp`, which deeper networks than those of one hidden layer go to."""
    if _fast(x) and len(layers) == 2:
        return _Network.apply(x, shared, row, *layers[0], *layers[1])
    return reference.mlp(x, layers, shared, row)


def merge_order(
    t_a: Float[Tensor, "a"],
    offsets_a: Int[Tensor, "rays+1"],
    t_b: Float[Tensor, "b"],
    offsets_b: Int[Tensor, "rays+1"],
) -> tuple[Int[Tensor, "a+b"], Int[Tensor, "rays+1"]]:
    """See `reference.merge_order`."""
    if not _fast(t_a, t_b, offsets_a, offsets_b):
        return reference.merge_order(t_a, offsets_a, t_b, offsets_b)
    offsets = offsets_a + offsets_b
    order = torch.empty(t_a.shape[0] + t_b.shape[0], dtype=torch.long)
    cpu.merge_order(_np(t_a), _np(offsets_a), _np(t_b), _np(offsets_b), _np(offsets), order.numpy())
    return order, offsets
