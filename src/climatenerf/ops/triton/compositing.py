"""GPU kernels in Triton: compositing. A program goes along the samples of a block of rays.

The slow twins in `ops/reference.py` are the specification.
"""

# pyright cannot know the types of Triton's functions.
# pyright: reportCallIssue=false, reportArgumentType=false, reportAttributeAccessIssue=false
# pyright: reportOperatorIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOptionalSubscript=false

import triton
import triton.language as tl
from torch import Tensor

from climatenerf.ops.triton.tiles import RAY_LISTS, launch, ray_lists


@triton.jit
def weight_of(before, tau):
    """Return the rendering weight of a sample of depth tau behind an optical depth of `before`."""
    # 1 - exp(-tau) loses all digits where tau is small; the series keeps them.
    series = tau * (1.0 - tau * (0.5 - tau * (1.0 / 6.0 - tau / 24.0)))
    return tl.exp(-before) * tl.where(tau < 0.05, series, 1.0 - tl.exp(-tau))


@triton.jit(do_not_specialize=["n"])
def _weights_forward(tau, offsets, weights, transmittance, n, BLOCK: tl.constexpr):
    r, first, count = ray_lists(offsets, n, BLOCK)
    total = tl.zeros([BLOCK], tl.float32)
    longest = tl.max(count, 0)
    k = 0
    while k < longest:
        depth = tl.load(tau + first + k, mask=k < count, other=0.0)
        tl.store(weights + first + k, weight_of(total, depth), mask=k < count)
        total += depth
        k += 1
    tl.store(transmittance + r, tl.exp(-total), mask=r < n)


def weights_forward(tau: Tensor, offsets: Tensor, weights: Tensor, transmittance: Tensor) -> None:
    """Write rendering weights of samples with optical depths tau, and transmittance of rays."""
    n = offsets.shape[0] - 1
    launch(_weights_forward, n, RAY_LISTS)(tau, offsets, weights, transmittance, n, BLOCK=RAY_LISTS)


@triton.jit(do_not_specialize=["n"])
def _weights_backward(tau, offsets, grad_w, grad_t, grad_tau, n, BLOCK: tl.constexpr):
    r, first, count = ray_lists(offsets, n, BLOCK)
    total = tl.zeros([BLOCK], tl.float32)
    longest = tl.max(count, 0)
    k = 0
    while k < longest:
        total += tl.load(tau + first + k, mask=k < count, other=0.0)
        k += 1
    behind = tl.load(grad_t + r, mask=r < n, other=0.0) * tl.exp(-total)
    j = 0
    while j < longest:
        i, mask = first + count - 1 - j, j < count  # back to front
        depth = tl.load(tau + i, mask=mask, other=0.0)
        grad = tl.load(grad_w + i, mask=mask, other=0.0)
        after = tl.exp(-total)
        total -= depth
        tl.store(grad_tau + i, grad * after - behind, mask=mask)
        behind += grad * weight_of(total, depth)
        j += 1


def weights_backward(
    tau: Tensor, offsets: Tensor, grad_w: Tensor, grad_t: Tensor, grad_tau: Tensor
) -> None:
    """Write the gradient of `weights_forward`."""
    n = offsets.shape[0] - 1
    launch(_weights_backward, n, RAY_LISTS)(
        tau, offsets, grad_w, grad_t, grad_tau, n, BLOCK=RAY_LISTS
    )


def _channels(values: Tensor) -> dict[str, object]:
    return {"CHANNELS": values.shape[1], "WIDTH": triton.next_power_of_2(values.shape[1])}


@triton.jit(do_not_specialize=["n"])
def _accumulate_forward(
    weights,
    values,
    offsets,
    out,
    n,
    CHANNELS: tl.constexpr,
    WIDTH: tl.constexpr,
    BLOCK: tl.constexpr,
):
    r, first, count = ray_lists(offsets, n, BLOCK)
    c = tl.arange(0, WIDTH)[None, :]
    total = tl.zeros([BLOCK, WIDTH], tl.float32)
    longest = tl.max(count, 0)
    k = 0
    while k < longest:
        i, inside = first + k, k < count
        weight = tl.load(weights + i, mask=inside, other=0.0)
        mask = inside[:, None] & (c < CHANNELS)
        value = tl.load(values + i[:, None] * CHANNELS + c, mask=mask, other=0.0)
        total += weight[:, None] * value
        k += 1
    tl.store(out + r[:, None] * CHANNELS + c, total, mask=(r < n)[:, None] & (c < CHANNELS))


def accumulate_forward(weights: Tensor, values: Tensor, offsets: Tensor, out: Tensor) -> None:
    """Write the sum over each ray of weights [s] · values [s,c] → out [rays,c]."""
    n = offsets.shape[0] - 1
    launch(_accumulate_forward, n, RAY_LISTS)(
        weights, values, offsets, out, n, **_channels(values), BLOCK=RAY_LISTS
    )


@triton.jit(do_not_specialize=["n"])
def _accumulate_backward(
    weights,
    values,
    offsets,
    grad_out,
    grad_w,
    grad_v,
    n,
    CHANNELS: tl.constexpr,
    WIDTH: tl.constexpr,
    BLOCK: tl.constexpr,
):
    r, first, count = ray_lists(offsets, n, BLOCK)
    c = tl.arange(0, WIDTH)[None, :]
    valid = (r < n)[:, None] & (c < CHANNELS)
    grad = tl.load(grad_out + r[:, None] * CHANNELS + c, mask=valid, other=0.0)
    longest = tl.max(count, 0)
    k = 0
    while k < longest:
        i, inside = first + k, k < count
        mask = inside[:, None] & (c < CHANNELS)
        at = i[:, None] * CHANNELS + c
        value = tl.load(values + at, mask=mask, other=0.0)
        weight = tl.load(weights + i, mask=inside, other=0.0)
        tl.store(grad_v + at, grad * weight[:, None], mask=mask)
        tl.store(grad_w + i, tl.sum(grad * value, 1), mask=inside)
        k += 1


def accumulate_backward(
    weights: Tensor,
    values: Tensor,
    offsets: Tensor,
    grad_out: Tensor,
    grad_w: Tensor,
    grad_v: Tensor,
) -> None:
    """Write the gradient of `accumulate_forward`."""
    n = offsets.shape[0] - 1
    launch(_accumulate_backward, n, RAY_LISTS)(
        weights, values, offsets, grad_out, grad_w, grad_v, n, **_channels(values), BLOCK=RAY_LISTS
    )


@triton.jit(do_not_specialize=["n"])
def _distortion_forward(weights, s, ds, offsets, out, n, BLOCK: tl.constexpr):
    r, first, count = ray_lists(offsets, n, BLOCK)
    total = tl.zeros([BLOCK], tl.float32)
    w_sum, ws_sum = tl.zeros_like(total), tl.zeros_like(total)
    longest = tl.max(count, 0)
    k = 0
    while k < longest:
        i, inside = first + k, k < count
        w = tl.load(weights + i, mask=inside, other=0.0)
        p = tl.load(s + i, mask=inside, other=0.0)
        width = tl.load(ds + i, mask=inside, other=0.0)
        total += 2.0 * w * (p * w_sum - ws_sum) + w * w * width * (1.0 / 3.0)
        w_sum += w
        ws_sum += w * p
        k += 1
    tl.store(out + r, total, mask=r < n)


def distortion_forward(
    weights: Tensor, s: Tensor, ds: Tensor, offsets: Tensor, out: Tensor
) -> None:
    """Write the distortion of each ray in linear time (DVGOv2); see `reference.distortion`."""
    n = offsets.shape[0] - 1
    launch(_distortion_forward, n, RAY_LISTS)(weights, s, ds, offsets, out, n, BLOCK=RAY_LISTS)


@triton.jit(do_not_specialize=["n"])
def _distortion_backward(weights, s, ds, offsets, grad_out, grad_w, n, BLOCK: tl.constexpr):
    r, first, count = ray_lists(offsets, n, BLOCK)
    longest = tl.max(count, 0)
    w_all = tl.zeros([BLOCK], tl.float32)
    ws_all, w_sum, ws_sum = tl.zeros_like(w_all), tl.zeros_like(w_all), tl.zeros_like(w_all)
    k = 0
    while k < longest:
        w = tl.load(weights + first + k, mask=k < count, other=0.0)
        w_all += w
        ws_all += w * tl.load(s + first + k, mask=k < count, other=0.0)
        k += 1
    grad = tl.load(grad_out + r, mask=r < n, other=0.0)
    k = 0
    while k < longest:
        i, inside = first + k, k < count
        w = tl.load(weights + i, mask=inside, other=0.0)
        p = tl.load(s + i, mask=inside, other=0.0)
        width = tl.load(ds + i, mask=inside, other=0.0)
        before = p * w_sum - ws_sum
        w_sum += w
        ws_sum += w * p
        after = (ws_all - ws_sum) - p * (w_all - w_sum)
        gradient = grad * 2.0 * (before + after + w * width * (1.0 / 3.0))
        tl.store(grad_w + i, gradient, mask=inside)
        k += 1


def distortion_backward(
    weights: Tensor, s: Tensor, ds: Tensor, offsets: Tensor, grad_out: Tensor, grad_w: Tensor
) -> None:
    """Write the gradient of `distortion_forward` to the weights."""
    n = offsets.shape[0] - 1
    launch(_distortion_backward, n, RAY_LISTS)(
        weights, s, ds, offsets, grad_out, grad_w, n, BLOCK=RAY_LISTS
    )


@triton.jit(do_not_specialize=["n", "shift"])
def _merge_order(t_a, offsets_a, t_b, offsets_b, offsets, order, n, shift, BLOCK: tl.constexpr):
    r, i, count_a = ray_lists(offsets_a, n, BLOCK)
    _, j, count_b = ray_lists(offsets_b, n, BLOCK)
    _, first, count = ray_lists(offsets, n, BLOCK)
    last_a, last_b = i + count_a, j + count_b
    longest = tl.max(count, 0)
    k = 0
    while k < longest:
        more_a, more_b = i < last_a, j < last_b
        a = tl.load(t_a + i, mask=more_a, other=float("inf"))
        b = tl.load(t_b + j, mask=more_b, other=float("inf"))
        from_a = more_a & ((a <= b) | (j >= last_b))
        tl.store(order + first + k, tl.where(from_a, i, shift + j), mask=k < count)
        i += from_a.to(tl.int64)
        j += (more_b & (from_a == 0)).to(tl.int64)
        k += 1


def merge_order(
    t_a: Tensor, offsets_a: Tensor, t_b: Tensor, offsets_b: Tensor, offsets: Tensor, order: Tensor
) -> None:
    """Write the order that merges two packed lists by t; indices ≥ len(t_a) are list b's."""
    n, shift = offsets.shape[0] - 1, t_a.shape[0]
    launch(_merge_order, n, RAY_LISTS)(
        t_a, offsets_a, t_b, offsets_b, offsets, order, n, shift, BLOCK=RAY_LISTS
    )
