"""GPU kernels in Triton, for blocks of samples or rays; `reference.py` specifies them.

Function by function the interface of `cpu.py`, on tensors of the device, but for what is packed or
turned for a CPU (`dispatch.cells_of`, `_cpu_net`). Marching is in `gpu_march.py`, whole rays are in
`gpu_render.py`, encodings with their networks in `gpu_network.py`, witnesses in `gpu_witness.py`.
Triton comes with PyTorch for CUDA, compiles at the first launch, and has a C compiler build what
starts kernels. Its interpreter runs the same code on the CPU (TRITON_INTERPRET=1), which is how it
is tested without a GPU.
"""

# Triton's functions have no types that pyright could know.
# pyright: reportCallIssue=false, reportArgumentType=false, reportAttributeAccessIssue=false
# pyright: reportOperatorIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOptionalSubscript=false

import triton
import triton.language as tl
from torch import Tensor

from climatenerf.ops.triton import marching as gpu_march
from climatenerf.ops.triton.encoding import (
    features_at,
    lattice,
    over,
    padded,
    pair_at,
    points,
    rows_of,
    share_of,
    unit_cube,
)
from climatenerf.ops.triton.marching import weight_of

density_at, march = gpu_march.density_at, gpu_march.march

SAMPLES = 64  # of a tile of an encoding
LIST = 64  # rays of a block of compositing
ENTRIES = 1024  # of a block of the optimiser's


# --- hash encoding -------------------------------------------------------------------------------


@triton.jit
def both(features, i, n, some, SIZES: tl.constexpr):
    """Where a level's first and second feature of samples lie in [2L,n], and which there are."""
    level = tl.arange(0, SIZES[1])[None, :].to(tl.int64)
    first = features + 2 * level * n + i[:, None]
    return first, first + n, some[:, None] & (level < SIZES[0])


@triton.jit(do_not_specialize=["n"])
def _hash_encode(u, encoding, out, n, SIZES: tl.constexpr, BLOCK: tl.constexpr):
    i, some, ux, uy, uz = points(u, tl.program_id(0), n, BLOCK)
    first, second = features_at(ux, uy, uz, some, encoding, SIZES)
    at_first, at_second, known = both(out, i, n, some, SIZES)
    tl.store(at_first, first, mask=known)
    tl.store(at_second, second, mask=known)


def hash_encode(u: Tensor, table: Tensor, resolutions: Tensor, out: Tensor) -> None:
    """Features of n points: u [n,3] in [0,1), table [L,T,2] → out [2L,n]."""
    n, levels, size = u.shape[0], table.shape[0], table.shape[1]
    encoding = table, resolutions, size
    over(_hash_encode, n, SAMPLES)(
        u, encoding, out, n, SIZES=(levels, padded(levels)), BLOCK=SAMPLES
    )


@triton.jit(do_not_specialize=["n"])
def _hash_encode_backward(u, grad_out, encoding, n, SIZES: tl.constexpr, BLOCK: tl.constexpr):
    grad_table, resolutions, size = encoding
    i, some, ux, uy, uz = points(u, tl.program_id(0), n, BLOCK)
    at_first, at_second, known = both(grad_out, i, n, some, SIZES)
    first = tl.load(at_first, mask=known, other=0.0)
    second = tl.load(at_second, mask=known, other=0.0)
    scatter(first, second, ux, uy, uz, known, grad_table, resolutions, size, SIZES)


@triton.jit
def scatter(first, second, ux, uy, uz, known, grad_table, resolutions, size, SIZES: tl.constexpr):
    """Adds gradients to both features of the levels [samples, levels] to the table's."""
    cell, place, resolution = lattice(ux, uy, uz, resolutions, SIZES)
    known = known & ((first != 0.0) | (second != 0.0))
    for corner in tl.static_range(8):
        at = grad_table + 2 * rows_of(cell, corner, resolution, size)
        weight = share_of(place, corner)
        tl.atomic_add(at, weight * first, mask=known, sem="relaxed")
        tl.atomic_add(at + 1, weight * second, mask=known, sem="relaxed")


def hash_encode_backward(
    u: Tensor, grad_out: Tensor, resolutions: Tensor, grad_table: Tensor
) -> None:
    """Adds the gradient of `hash_encode` to grad_table [L,T,2]; the sum's order is not fixed."""
    n, levels, size = u.shape[0], grad_table.shape[0], grad_table.shape[1]
    encoding = grad_table, resolutions, size
    over(_hash_encode_backward, n, SAMPLES)(
        u, grad_out, encoding, n, SIZES=(levels, padded(levels)), BLOCK=SAMPLES
    )


@triton.jit
def slopes_of(first, second, ux, uy, uz, known, encoding, SIZES: tl.constexpr):
    """Gradient to the positions from those to both features of the levels."""
    table, resolutions, size = encoding
    cell, place, resolution = lattice(ux, uy, uz, resolutions, SIZES)
    fx, fy, fz = place
    tx, ty, tz = tl.zeros_like(fx), tl.zeros_like(fx), tl.zeros_like(fx)
    for corner in tl.static_range(8):
        a, b = pair_at(table, rows_of(cell, corner, resolution, size), known)
        value = first * a + second * b
        wx = fx if corner & 1 else 1.0 - fx
        wy = fy if corner >> 1 & 1 else 1.0 - fy
        wz = fz if corner >> 2 else 1.0 - fz
        tx += value * wy * wz * (1.0 if corner & 1 else -1.0)
        ty += value * wx * wz * (1.0 if corner >> 1 & 1 else -1.0)
        tz += value * wx * wy * (1.0 if corner >> 2 else -1.0)
    scale = resolution.to(tl.float32)[None, :]
    return tl.sum(tx * scale, 1), tl.sum(ty * scale, 1), tl.sum(tz * scale, 1)


@triton.jit(do_not_specialize=["n"])
def _hash_encode_slopes(u, grad_out, encoding, grad_u, n, SIZES: tl.constexpr, BLOCK: tl.constexpr):
    i, some, ux, uy, uz = points(u, tl.program_id(0), n, BLOCK)
    at_first, at_second, known = both(grad_out, i, n, some, SIZES)
    first = tl.load(at_first, mask=known, other=0.0)
    second = tl.load(at_second, mask=known, other=0.0)
    gx, gy, gz = slopes_of(first, second, ux, uy, uz, known, encoding, SIZES)
    tl.store(grad_u + 3 * i, gx, mask=some)
    tl.store(grad_u + 3 * i + 1, gy, mask=some)
    tl.store(grad_u + 3 * i + 2, gz, mask=some)


def hash_encode_slopes(
    u: Tensor, grad_out: Tensor, table: Tensor, resolutions: Tensor, grad_u: Tensor
) -> None:
    """Gradient of `hash_encode` to the positions: grad_out [2L,n] → grad_u [n,3]."""
    n, levels, size = u.shape[0], table.shape[0], table.shape[1]
    encoding = table, resolutions, size
    over(_hash_encode_slopes, n, SAMPLES)(
        u, grad_out, encoding, grad_u, n, SIZES=(levels, padded(levels)), BLOCK=SAMPLES
    )


# --- lists of samples: a block of rays goes along them side by side ------------------------------


@triton.jit
def _lists(offsets, n, BLOCK: tl.constexpr):
    """A block's rays, where their samples begin, and how many they are (0 beyond the last ray)."""
    r = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    some = r < n
    first = tl.load(offsets + r, mask=some, other=0)
    return r, first, tl.load(offsets + r + 1, mask=some, other=0) - first


@triton.jit(do_not_specialize=["n", "total"])
def _pack(rows, offsets, out, n, total, capacity, BLOCK: tl.constexpr):
    r, first, count = _lists(offsets, n, BLOCK)
    longest = tl.max(count, 0)
    k = 0
    while k < longest:
        some = k < count
        for kind in tl.static_range(3):
            value = tl.load(rows + (kind * capacity + k) * n + r, mask=some)
            tl.store(out + kind * total + first + k, value, mask=some)
        k += 1


def pack(rows: Tensor, offsets: Tensor, out: Tensor) -> None:
    """Packs what `march` has left in rows into out [3, samples]."""
    n = offsets.shape[0] - 1
    over(_pack, n, LIST)(rows, offsets, out, n, out.shape[1], rows.shape[1], BLOCK=LIST)


@triton.jit(do_not_specialize=["n"])
def _grid_positions(rays_o, rays_d, offsets, t, out, n, BLOCK: tl.constexpr):
    r, first, count = _lists(offsets, n, BLOCK)
    some = r < n
    ox = tl.load(rays_o + 3 * r, mask=some)
    oy = tl.load(rays_o + 3 * r + 1, mask=some)
    oz = tl.load(rays_o + 3 * r + 2, mask=some)
    dx = tl.load(rays_d + 3 * r, mask=some)
    dy = tl.load(rays_d + 3 * r + 1, mask=some)
    dz = tl.load(rays_d + 3 * r + 2, mask=some)
    longest = tl.max(count, 0)
    k = 0
    while k < longest:
        i, own = first + k, k < count
        far = tl.load(t + i, mask=own, other=0.0)
        ux, uy, uz, _ = unit_cube(ox + far * dx, oy + far * dy, oz + far * dz)
        tl.store(out + 3 * i, ux, mask=own)
        tl.store(out + 3 * i + 1, uy, mask=own)
        tl.store(out + 3 * i + 2, uz, mask=own)
        k += 1


def grid_positions(rays_o: Tensor, rays_d: Tensor, offsets: Tensor, t: Tensor, u: Tensor) -> None:
    """Unit-cube coordinates (after contraction) of packed samples: → u [samples,3]."""
    n = rays_o.shape[0]
    over(_grid_positions, n, LIST)(rays_o, rays_d, offsets, t, u, n, BLOCK=LIST)


@triton.jit(do_not_specialize=["n"])
def _weights_forward(tau, offsets, weights, transmittance, n, BLOCK: tl.constexpr):
    r, first, count = _lists(offsets, n, BLOCK)
    total = tl.zeros([BLOCK], tl.float32)
    longest = tl.max(count, 0)
    k = 0
    while k < longest:
        own = tl.load(tau + first + k, mask=k < count, other=0.0)
        tl.store(weights + first + k, weight_of(total, own), mask=k < count)
        total += own
        k += 1
    tl.store(transmittance + r, tl.exp(-total), mask=r < n)


def weights_forward(tau: Tensor, offsets: Tensor, weights: Tensor, transmittance: Tensor) -> None:
    """Rendering weights of packed samples with optical depths tau; transmittance left per ray."""
    n = offsets.shape[0] - 1
    over(_weights_forward, n, LIST)(tau, offsets, weights, transmittance, n, BLOCK=LIST)


@triton.jit(do_not_specialize=["n"])
def _weights_backward(tau, offsets, grad_w, grad_t, grad_tau, n, BLOCK: tl.constexpr):
    r, first, count = _lists(offsets, n, BLOCK)
    total = tl.zeros([BLOCK], tl.float32)
    longest = tl.max(count, 0)
    k = 0
    while k < longest:
        total += tl.load(tau + first + k, mask=k < count, other=0.0)
        k += 1
    behind = tl.load(grad_t + r, mask=r < n, other=0.0) * tl.exp(-total)
    j = 0
    while j < longest:
        i, known = first + count - 1 - j, j < count  # from the last on
        own = tl.load(tau + i, mask=known, other=0.0)
        grad = tl.load(grad_w + i, mask=known, other=0.0)
        after = tl.exp(-total)
        total -= own
        tl.store(grad_tau + i, grad * after - behind, mask=known)
        behind += grad * weight_of(total, own)
        j += 1


def weights_backward(
    tau: Tensor, offsets: Tensor, grad_w: Tensor, grad_t: Tensor, grad_tau: Tensor
) -> None:
    """Gradient of `weights_forward`."""
    n = offsets.shape[0] - 1
    over(_weights_backward, n, LIST)(tau, offsets, grad_w, grad_t, grad_tau, n, BLOCK=LIST)


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
    r, first, count = _lists(offsets, n, BLOCK)
    c = tl.arange(0, WIDTH)[None, :]
    total = tl.zeros([BLOCK, WIDTH], tl.float32)
    longest = tl.max(count, 0)
    k = 0
    while k < longest:
        i, own = first + k, k < count
        weight = tl.load(weights + i, mask=own, other=0.0)
        known = own[:, None] & (c < CHANNELS)
        value = tl.load(values + i[:, None] * CHANNELS + c, mask=known, other=0.0)
        total += weight[:, None] * value
        k += 1
    tl.store(out + r[:, None] * CHANNELS + c, total, mask=(r < n)[:, None] & (c < CHANNELS))


def accumulate_forward(weights: Tensor, values: Tensor, offsets: Tensor, out: Tensor) -> None:
    """Sum over each ray of weights [s] · values [s,c] → out [rays,c]."""
    n = offsets.shape[0] - 1
    over(_accumulate_forward, n, LIST)(
        weights, values, offsets, out, n, **_channels(values), BLOCK=LIST
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
    r, first, count = _lists(offsets, n, BLOCK)
    c = tl.arange(0, WIDTH)[None, :]
    some = (r < n)[:, None] & (c < CHANNELS)
    grad = tl.load(grad_out + r[:, None] * CHANNELS + c, mask=some, other=0.0)
    longest = tl.max(count, 0)
    k = 0
    while k < longest:
        i, own = first + k, k < count
        known = own[:, None] & (c < CHANNELS)
        at = i[:, None] * CHANNELS + c
        value = tl.load(values + at, mask=known, other=0.0)
        weight = tl.load(weights + i, mask=own, other=0.0)
        tl.store(grad_v + at, grad * weight[:, None], mask=known)
        tl.store(grad_w + i, tl.sum(grad * value, 1), mask=own)
        k += 1


def accumulate_backward(
    weights: Tensor,
    values: Tensor,
    offsets: Tensor,
    grad_out: Tensor,
    grad_w: Tensor,
    grad_v: Tensor,
) -> None:
    """Gradient of `accumulate_forward`."""
    n = offsets.shape[0] - 1
    over(_accumulate_backward, n, LIST)(
        weights, values, offsets, grad_out, grad_w, grad_v, n, **_channels(values), BLOCK=LIST
    )


@triton.jit(do_not_specialize=["n"])
def _distortion_forward(weights, s, ds, offsets, out, n, BLOCK: tl.constexpr):
    r, first, count = _lists(offsets, n, BLOCK)
    total = tl.zeros([BLOCK], tl.float32)
    w_sum, ws_sum = tl.zeros_like(total), tl.zeros_like(total)
    longest = tl.max(count, 0)
    k = 0
    while k < longest:
        i, own = first + k, k < count
        w = tl.load(weights + i, mask=own, other=0.0)
        p = tl.load(s + i, mask=own, other=0.0)
        width = tl.load(ds + i, mask=own, other=0.0)
        total += 2.0 * w * (p * w_sum - ws_sum) + w * w * width * (1.0 / 3.0)
        w_sum += w
        ws_sum += w * p
        k += 1
    tl.store(out + r, total, mask=r < n)


def distortion_forward(
    weights: Tensor, s: Tensor, ds: Tensor, offsets: Tensor, out: Tensor
) -> None:
    """Distortion loss per ray, in linear time (DVGOv2); see `reference.distortion`."""
    n = offsets.shape[0] - 1
    over(_distortion_forward, n, LIST)(weights, s, ds, offsets, out, n, BLOCK=LIST)


@triton.jit(do_not_specialize=["n"])
def _distortion_backward(weights, s, ds, offsets, grad_out, grad_w, n, BLOCK: tl.constexpr):
    r, first, count = _lists(offsets, n, BLOCK)
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
        i, own = first + k, k < count
        w = tl.load(weights + i, mask=own, other=0.0)
        p = tl.load(s + i, mask=own, other=0.0)
        width = tl.load(ds + i, mask=own, other=0.0)
        before = p * w_sum - ws_sum
        w_sum += w
        ws_sum += w * p
        after = (ws_all - ws_sum) - p * (w_all - w_sum)
        each = grad * 2.0 * (before + after + w * width * (1.0 / 3.0))
        tl.store(grad_w + i, each, mask=own)
        k += 1


def distortion_backward(
    weights: Tensor, s: Tensor, ds: Tensor, offsets: Tensor, grad_out: Tensor, grad_w: Tensor
) -> None:
    """Gradient of `distortion_forward` to the weights."""
    n = offsets.shape[0] - 1
    over(_distortion_backward, n, LIST)(weights, s, ds, offsets, grad_out, grad_w, n, BLOCK=LIST)


@triton.jit(do_not_specialize=["n", "shift"])
def _merge_order(t_a, offsets_a, t_b, offsets_b, offsets, order, n, shift, BLOCK: tl.constexpr):
    r, i, count_a = _lists(offsets_a, n, BLOCK)
    _, j, count_b = _lists(offsets_b, n, BLOCK)
    _, first, count = _lists(offsets, n, BLOCK)
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
    """Order that merges two packed sample lists by t; indices ≥ len(t_a) mean list b."""
    n, shift = offsets.shape[0] - 1, t_a.shape[0]
    over(_merge_order, n, LIST)(
        t_a, offsets_a, t_b, offsets_b, offsets, order, n, shift, BLOCK=LIST
    )


# --- the optimiser's -----------------------------------------------------------------------------


@triton.jit(do_not_specialize=["n", "rate", "correction1", "correction2"])
def _adam(
    parameter,
    gradient,
    first,
    second,
    n,
    rate,
    beta1,
    beta2,
    epsilon,
    correction1,
    correction2,
    BLOCK: tl.constexpr,
):
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    g = tl.load(gradient + i, mask=i < n, other=0.0)
    own = g != 0.0
    m = beta1 * tl.load(first + i, mask=own, other=0.0) + (1.0 - beta1) * g
    v = beta2 * tl.load(second + i, mask=own, other=0.0) + (1.0 - beta2) * g * g
    tl.store(first + i, m, mask=own)
    tl.store(second + i, v, mask=own)
    move = rate * (m / correction1) / (tl.sqrt(v / correction2) + epsilon)
    tl.store(parameter + i, tl.load(parameter + i, mask=own, other=0.0) - move, mask=own)
    tl.store(gradient + i, tl.zeros_like(g), mask=own)


def adam(parameter: Tensor, gradient: Tensor, first: Tensor, second: Tensor, *rates: float) -> None:
    """One Adam step over flat arrays that leaves entries without gradient untouched.

    Rates: rate, beta1, beta2, epsilon, and the corrections of both moments.
    """
    n = parameter.shape[0]
    over(_adam, n, ENTRIES)(
        parameter, gradient, first, second, n, *map(float, rates), BLOCK=ENTRIES
    )
