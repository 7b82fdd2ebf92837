"""Compositing of packed samples along rays: weights, sums, losses and merging, with gradients."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from climatenerf.core.vectors import unit
from climatenerf.ops import dispatch, reference
from climatenerf.ops.cpu import compositing as cpu


class _RenderWeights(torch.autograd.Function):
    @staticmethod
    def forward(ctx, tau, offsets, kernels):
        # Zeros: the padding behind the last ray's samples has no weight.
        weights, transmittance = torch.zeros_like(tau), tau.new_empty(offsets.shape[0] - 1)
        kernels.weights_forward(*dispatch.kernel_arrays(tau, offsets, weights, transmittance))
        ctx.kernels = kernels
        ctx.save_for_backward(tau, offsets)
        return weights, transmittance

    @staticmethod
    def backward(ctx, grad_weights, grad_transmittance):
        tau, offsets = ctx.saved_tensors
        grad = torch.zeros_like(tau)
        ctx.kernels.weights_backward(
            *dispatch.kernel_arrays(tau, offsets, grad_weights, grad_transmittance, grad)
        )
        return grad, None, None


def render_weights(
    tau: Float[Tensor, "s"], offsets: Int[Tensor, "rays+1"]
) -> tuple[Float[Tensor, "s"], Float[Tensor, "rays"]]:
    """Return rendering weights of samples and transmittance of rays: `reference.render_weights`."""
    if kernels := dispatch.kernels("compositing", tau, offsets):
        return _RenderWeights.apply(tau.contiguous(), offsets, kernels)
    return reference.render_weights(tau, offsets)


class _Accumulate(torch.autograd.Function):
    """CPU kernels take values feature-major, as networks return them; GPU kernels sample-major."""

    @staticmethod
    def forward(ctx, weights, values, offsets, kernels):
        out = values.new_empty(offsets.shape[0] - 1, values.shape[1])
        ordered = values.T if kernels is cpu else values
        kernels.accumulate_forward(*dispatch.kernel_arrays(weights, ordered, offsets, out))
        ctx.kernels = kernels
        ctx.save_for_backward(weights, values, offsets)
        return out

    @staticmethod
    def backward(ctx, grad):
        weights, values, offsets = ctx.saved_tensors
        ordered = values.T if ctx.kernels is cpu else values
        grad_weights, grad_values = torch.zeros_like(weights), values.new_zeros(ordered.shape)
        ctx.kernels.accumulate_backward(
            *dispatch.kernel_arrays(weights, ordered, offsets, grad, grad_weights, grad_values)
        )
        return grad_weights, grad_values.T if ctx.kernels is cpu else grad_values, None, None


def accumulate(
    weights: Float[Tensor, "s"], values: Float[Tensor, "s c"], offsets: Int[Tensor, "rays+1"]
) -> Float[Tensor, "rays c"]:
    """Return the weighted sum of values along each ray: `reference.accumulate`."""
    if kernels := dispatch.kernels("compositing", weights, values, offsets):
        return _Accumulate.apply(weights.contiguous(), values, offsets, kernels)
    return reference.accumulate(weights, values, offsets)


class _Surface(torch.autograd.Function):
    @staticmethod
    def forward(ctx, weights, raw, target, offsets):
        n = offsets.shape[0] - 1
        logits, error = raw.new_empty(n, raw.shape[1] - 3), raw.new_empty(n)
        cpu.surface_forward(*dispatch.kernel_arrays(weights, raw.T, target, offsets, logits, error))
        ctx.save_for_backward(weights, raw, target, offsets)
        return logits, error

    @staticmethod
    def backward(ctx, grad_logits, grad_error):
        weights, raw, target, offsets = ctx.saved_tensors
        grad = raw.new_zeros(raw.shape[1], raw.shape[0])
        cpu.surface_backward(
            *dispatch.kernel_arrays(weights, raw.T, target, offsets, grad_logits, grad_error, grad)
        )
        return None, grad.T, None, None


def surface(
    weights: Float[Tensor, "s"],
    raw: Float[Tensor, "s 3+c"],
    target: Float[Tensor, "s 3"] | None,
    offsets: Int[Tensor, "rays+1"],
) -> tuple[Float[Tensor, "rays c"], Float[Tensor, "rays"]]:
    """Return class logits and normal errors of rays: `reference.surface`. Gradients: raw only."""
    weights = weights.detach()
    goal = raw.new_empty(0, 3) if target is None else target.detach()
    kernels = dispatch.kernels("compositing", weights, raw, goal, offsets)
    if kernels is cpu:
        return _Surface.apply(weights, raw, goal, offsets)
    if kernels is None:
        return reference.surface(weights, raw, target, offsets)
    logits = accumulate(weights, raw[:, 3:], offsets)
    if target is None:
        return logits, torch.zeros_like(logits[:, 0])
    error = (unit(raw[:, :3], 1e-6) - goal).square().sum(-1, keepdim=True)
    return logits, accumulate(weights, error, offsets)[:, 0]


class _Distortion(torch.autograd.Function):
    @staticmethod
    def forward(ctx, weights, s, ds, offsets, kernels):
        out = weights.new_empty(offsets.shape[0] - 1)
        kernels.distortion_forward(*dispatch.kernel_arrays(weights, s, ds, offsets, out))
        ctx.kernels = kernels
        ctx.save_for_backward(weights, s, ds, offsets)
        return out

    @staticmethod
    def backward(ctx, grad):
        weights, s, ds, offsets = ctx.saved_tensors
        grad_weights = torch.zeros_like(weights)
        ctx.kernels.distortion_backward(
            *dispatch.kernel_arrays(weights, s, ds, offsets, grad, grad_weights)
        )
        return grad_weights, None, None, None, None


def distortion(
    weights: Float[Tensor, "s"],
    s: Float[Tensor, "s"],
    ds: Float[Tensor, "s"],
    offsets: Int[Tensor, "rays+1"],
) -> Float[Tensor, "rays"]:
    """Return the distortion of each ray: `reference.distortion`. Gradients: the weights only."""
    if kernels := dispatch.kernels("compositing", weights, s, ds, offsets):
        return _Distortion.apply(weights.contiguous(), s, ds, offsets, kernels)
    return reference.distortion(weights, s, ds, offsets)


def merge_order(
    t_a: Float[Tensor, "a"],
    offsets_a: Int[Tensor, "rays+1"],
    t_b: Float[Tensor, "b"],
    offsets_b: Int[Tensor, "rays+1"],
) -> tuple[Int[Tensor, "a+b"], Int[Tensor, "rays+1"]]:
    """Return the order that merges two packed lists by t, and offsets: `reference.merge_order`."""
    kernels = dispatch.kernels("compositing", t_a, t_b, offsets_a, offsets_b)
    if kernels is None:
        return reference.merge_order(t_a, offsets_a, t_b, offsets_b)
    offsets = offsets_a + offsets_b
    order = offsets.new_empty(t_a.shape[0] + t_b.shape[0])
    kernels.merge_order(*dispatch.kernel_arrays(t_a, offsets_a, t_b, offsets_b, offsets, order))
    return order, offsets
