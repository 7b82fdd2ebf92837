"""Compositing along rays of packed samples: weights, sums, losses and merging, with gradients."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.core.vectors import unit
from climatenerf.ops import dispatch, reference
from climatenerf.ops.cpu import compositing as cpu


class _RenderWeights(torch.autograd.Function):
    @staticmethod
    def forward(ctx, tau, offsets, kernels):
        # Zeros: what follows the last ray's samples belongs to none.
        weights, left = torch.zeros_like(tau), tau.new_empty(offsets.shape[0] - 1)
        kernels.weights_forward(
            dispatch.kernel_array(tau),
            dispatch.kernel_array(offsets),
            dispatch.kernel_array(weights),
            dispatch.kernel_array(left),
        )
        ctx.kernels = kernels
        ctx.save_for_backward(tau, offsets)
        return weights, left

    @staticmethod
    def backward(ctx, grad_w, grad_t):
        tau, offsets = ctx.saved_tensors
        grad = torch.zeros_like(tau)
        ctx.kernels.weights_backward(
            dispatch.kernel_array(tau),
            dispatch.kernel_array(offsets),
            dispatch.kernel_array(grad_w),
            dispatch.kernel_array(grad_t),
            dispatch.kernel_array(grad),
        )
        return grad, None, None


def render_weights(
    tau: Float[Tensor, "s"], offsets: Int[Tensor, "rays+1"]
) -> tuple[Float[Tensor, "s"], Float[Tensor, "rays"]]:
    """See `reference.render_weights`."""
    if kernels := dispatch.kernels("compositing", tau, offsets):
        return _RenderWeights.apply(tau.contiguous(), offsets, kernels)
    return reference.render_weights(tau, offsets)


class _Accumulate(torch.autograd.Function):
    """On a CPU values lie in rows, as networks leave them, elsewhere side by side."""

    @staticmethod
    def forward(ctx, weights, values, offsets, kernels):
        out = values.new_empty(offsets.shape[0] - 1, values.shape[1])
        given = values.T if kernels is cpu else values
        kernels.accumulate_forward(
            dispatch.kernel_array(weights),
            dispatch.kernel_array(given),
            dispatch.kernel_array(offsets),
            dispatch.kernel_array(out),
        )
        ctx.kernels = kernels
        ctx.save_for_backward(weights, values, offsets)
        return out

    @staticmethod
    def backward(ctx, grad):
        weights, values, offsets = ctx.saved_tensors
        given = values.T if ctx.kernels is cpu else values
        grad_w, grad_v = torch.zeros_like(weights), values.new_zeros(given.shape)
        ctx.kernels.accumulate_backward(
            *map(dispatch.kernel_array, (weights, given, offsets, grad, grad_w, grad_v))
        )
        return grad_w, grad_v.T if ctx.kernels is cpu else grad_v, None, None


def accumulate(
    weights: Float[Tensor, "s"], values: Float[Tensor, "s c"], offsets: Int[Tensor, "rays+1"]
) -> Float[Tensor, "rays c"]:
    """See `reference.accumulate`."""
    if kernels := dispatch.kernels("compositing", weights, values, offsets):
        return _Accumulate.apply(weights.contiguous(), values, offsets, kernels)
    return reference.accumulate(weights, values, offsets)


class _Surface(torch.autograd.Function):
    @staticmethod
    def forward(ctx, weights, raw, target, offsets):
        n = offsets.shape[0] - 1
        logits, apart = raw.new_empty(n, raw.shape[1] - 3), raw.new_empty(n)
        cpu.surface_forward(
            *map(dispatch.kernel_array, (weights, raw.T, target, offsets, logits, apart))
        )
        ctx.save_for_backward(weights, raw, target, offsets)
        return logits, apart

    @staticmethod
    def backward(ctx, grad_logits, grad_apart):
        weights, raw, target, offsets = ctx.saved_tensors
        grad = raw.new_zeros(raw.shape[1], raw.shape[0])
        given = (weights, raw.T, target, offsets, grad_logits, grad_apart, grad)
        cpu.surface_backward(*map(dispatch.kernel_array, given))
        return None, grad.T, None, None


def surface(
    weights: Float[Tensor, "s"],
    raw: Float[Tensor, "s 3+c"],
    target: Float[Tensor, "s 3"] | None,
    offsets: Int[Tensor, "rays+1"],
) -> tuple[Float[Tensor, "rays c"], Float[Tensor, "rays"]]:
    """See `reference.surface`; gradients to raw only."""
    weights, goal = weights.detach(), raw.new_empty(0, 3) if target is None else target.detach()
    kernels = dispatch.kernels("compositing", weights, raw, goal, offsets)
    if kernels is cpu:
        return _Surface.apply(weights, raw, goal, offsets)
    if kernels is None:
        return reference.surface(weights, raw, target, offsets)
    logits = accumulate(weights, raw[:, 3:], offsets)
    if target is None:
        return logits, torch.zeros_like(logits[:, 0])
    off = (unit(raw[:, :3], 1e-6) - goal).square().sum(-1, keepdim=True)
    return logits, accumulate(weights, off, offsets)[:, 0]


class _Distortion(torch.autograd.Function):
    @staticmethod
    def forward(ctx, weights, s, ds, offsets, kernels):
        out = weights.new_empty(offsets.shape[0] - 1)
        kernels.distortion_forward(*map(dispatch.kernel_array, (weights, s, ds, offsets, out)))
        ctx.kernels = kernels
        ctx.save_for_backward(weights, s, ds, offsets)
        return out

    @staticmethod
    def backward(ctx, grad):
        weights, s, ds, offsets = ctx.saved_tensors
        grad_w = torch.zeros_like(weights)
        ctx.kernels.distortion_backward(
            *map(dispatch.kernel_array, (weights, s, ds, offsets, grad, grad_w))
        )
        return grad_w, None, None, None, None


def distortion(
    weights: Float[Tensor, "s"],
    s: Float[Tensor, "s"],
    ds: Float[Tensor, "s"],
    offsets: Int[Tensor, "rays+1"],
) -> Float[Tensor, "rays"]:
    """See `reference.distortion`; gradients to the weights only."""
    if kernels := dispatch.kernels("compositing", weights, s, ds, offsets):
        return _Distortion.apply(weights.contiguous(), s, ds, offsets, kernels)
    return reference.distortion(weights, s, ds, offsets)


def merge_order(
    t_a: Float[Tensor, "a"],
    offsets_a: Int[Tensor, "rays+1"],
    t_b: Float[Tensor, "b"],
    offsets_b: Int[Tensor, "rays+1"],
) -> tuple[Int[Tensor, "a+b"], Int[Tensor, "rays+1"]]:
    """See `reference.merge_order`."""
    kernels = dispatch.kernels("compositing", t_a, t_b, offsets_a, offsets_b)
    if kernels is None:
        return reference.merge_order(t_a, offsets_a, t_b, offsets_b)
    offsets = offsets_a + offsets_b
    order = offsets.new_empty(t_a.shape[0] + t_b.shape[0])
    kernels.merge_order(
        *map(dispatch.kernel_array, (t_a, offsets_a, t_b, offsets_b, offsets, order))
    )
    return order, offsets
