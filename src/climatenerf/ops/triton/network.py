"""GPU kernels in Triton: an encoding together with the network of one hidden layer on it.

Their twin is `reference.mlp(reference.hash_encode(u, ...), ...)`. Nothing of the features or the
hidden layer is kept for the backward pass: it computes them again. Samples are the rows of tiles
that go through the tensor cores.
"""

# Triton's functions have no types that pyright could know.
# pyright: reportCallIssue=false, reportArgumentType=false, reportAttributeAccessIssue=false
# pyright: reportOperatorIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOptionalSubscript=false

import triton
import triton.language as tl
from torch import Tensor

from climatenerf.ops.triton.encoding import (
    both,
    features_at,
    hash_encode,
    hash_encode_backward,
    hash_encode_slopes,
)
from climatenerf.ops.triton.tiles import over, padded, points

SAMPLES = 32  # of a tile
WARPS = 4  # of a program
PROGRAMS = 1024  # of a backward pass, at most: each sums its tiles' gradients to the weights
# Products of three tensor-core passes come as near as single precision does.
EXACT = tl.constexpr("tf32x3")
FAST = tl.constexpr("tf32")  # one pass: 11 bits, enough for a colour that is shown in 8


@triton.jit
def first_layer(w1, b1, SIZES: tl.constexpr):
    """Weights of the first features [levels, hidden], of the second, and biases."""
    PADDED: tl.constexpr = SIZES[1]
    H: tl.constexpr = SIZES[2]
    HIDDEN: tl.constexpr = SIZES[3]
    level, unit = tl.arange(0, PADDED)[:, None], tl.arange(0, H)[None, :]
    known = (level < SIZES[0]) & (unit < HIDDEN)
    at = w1 + 2 * level * HIDDEN + unit
    even = tl.load(at, mask=known, other=0.0)
    odd = tl.load(at + HIDDEN, mask=known, other=0.0)
    bias = tl.load(b1 + tl.arange(0, H), mask=tl.arange(0, H) < HIDDEN, other=0.0)
    return even, odd, bias


@triton.jit
def hidden_of(first, second, layer, PRECISION: tl.constexpr):
    """The hidden layer before its ReLU [samples, hidden]."""
    even, odd, bias = layer
    h = tl.dot(first, even, input_precision=PRECISION)
    return tl.dot(second, odd, h, input_precision=PRECISION) + bias[None, :]


@triton.jit
def _second_layer(w2, SIZES: tl.constexpr):
    """Weights of the second layer [hidden, out]."""
    unit, out = tl.arange(0, SIZES[2])[:, None], tl.arange(0, SIZES[4])[None, :]
    known = (unit < SIZES[3]) & (out < SIZES[5])
    return tl.load(w2 + unit * SIZES[5] + out, mask=known, other=0.0)


@triton.jit
def _of_rays(shared, row, i, some, SIZES: tl.constexpr):
    """Where what each sample's ray adds to the hidden layer lies, and which of it there is."""
    ray, unit = tl.load(row + i, mask=some, other=0), tl.arange(0, SIZES[2])[None, :]
    return shared + ray[:, None] * SIZES[3] + unit, some[:, None] & (unit < SIZES[3])


@triton.jit(do_not_specialize=["n"])
def _forward(
    u,
    encoding,
    layers,
    rays,
    out,
    n,
    SHARED: tl.constexpr,
    SIZES: tl.constexpr,
    BLOCK: tl.constexpr,
):
    WIDTH: tl.constexpr = SIZES[4]
    OUT: tl.constexpr = SIZES[5]
    w1, b1, w2, b2 = layers
    i, some, ux, uy, uz = points(u, tl.program_id(0), n, BLOCK)
    first, second = features_at(ux, uy, uz, some, encoding, SIZES)
    h = hidden_of(first, second, first_layer(w1, b1, SIZES), EXACT)
    if SHARED:
        at, known = _of_rays(rays[0], rays[1], i, some, SIZES)
        h += tl.load(at, mask=known, other=0.0)
    h = tl.maximum(h, 0.0)
    y = tl.dot(h, _second_layer(w2, SIZES), input_precision=EXACT)
    c = tl.arange(0, WIDTH)
    y += tl.load(b2 + c, mask=c < OUT, other=0.0)[None, :]
    tl.store(out + i[:, None] * OUT + c[None, :], y, mask=some[:, None] & (c < OUT)[None, :])


def network_forward(
    u: Tensor,
    encoding: tuple[Tensor, Tensor],
    layers: tuple[Tensor, Tensor, Tensor, Tensor],
    rays: tuple[Tensor, Tensor] | None,
    out: Tensor,
) -> None:
    """Outputs [n,o] of a network on the encoding of u [n,3].

    Args: encoding = (table [L,T,2], resolutions); layers = (w1 [2L,h], b1, w2 [h,o], b2);
    rays = (shared [m,h], row [n]): what is added to the hidden layer of each sample, or None.
    """
    table, resolutions = encoding
    w1, _, w2, _ = layers
    n = u.shape[0]
    over(_forward, n, SAMPLES)(
        u,
        (table, resolutions, table.shape[1]),
        layers,
        rays or (u, resolutions),  # not read
        out,
        n,
        SHARED=rays is not None,
        SIZES=sizes_of(table, w1, w2),
        BLOCK=SAMPLES,
        num_warps=WARPS,
    )


@triton.jit(do_not_specialize=["n"])
def _backward(
    features,
    layers,
    rays,
    grad_out,
    grads,
    n,
    SHARED: tl.constexpr,
    LEARNS: tl.constexpr,
    SIZES: tl.constexpr,
    BLOCK: tl.constexpr,
):
    LEVELS: tl.constexpr = SIZES[0]
    PADDED: tl.constexpr = SIZES[1]
    H: tl.constexpr = SIZES[2]
    HIDDEN: tl.constexpr = SIZES[3]
    WIDTH: tl.constexpr = SIZES[4]
    OUT: tl.constexpr = SIZES[5]
    w1, b1, w2, _ = layers
    grad_shared, sums = grads
    c = tl.arange(0, WIDTH)
    sum_even, sum_odd = tl.zeros([H, PADDED], tl.float32), tl.zeros([H, PADDED], tl.float32)
    sum_second, sum_bias = tl.zeros([H, WIDTH], tl.float32), tl.zeros([H], tl.float32)
    sum_out = tl.zeros([WIDTH], tl.float32)
    tile = tl.program_id(0)
    while tile * BLOCK < n:
        i = tile.to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
        some = i < n
        at_first, at_second, there = both(features, i, n, some, SIZES)
        first = tl.load(at_first, mask=there, other=0.0)
        second = tl.load(at_second, mask=there, other=0.0)
        # The layers are read again for each tile: kept, they would crowd all else out of registers.
        layer = first_layer(w1, b1, SIZES)
        h = hidden_of(first, second, layer, EXACT)
        if SHARED:
            at, known = _of_rays(rays[0], rays[1], i, some, SIZES)
            h += tl.load(at, mask=known, other=0.0)
        known = some[:, None] & (c < OUT)[None, :]
        g = tl.load(grad_out + i[:, None] * OUT + c[None, :], mask=known, other=0.0)
        sum_out += tl.sum(g, 0)
        active = h > 0.0
        sum_second += tl.dot(tl.trans(tl.where(active, h, 0.0)), g, input_precision=FAST)
        back = tl.where(
            active, tl.dot(g, tl.trans(_second_layer(w2, SIZES)), input_precision=FAST), 0.0
        )
        sum_bias += tl.sum(back, 0)
        sum_even += tl.dot(tl.trans(back), first, input_precision=FAST)
        sum_odd += tl.dot(tl.trans(back), second, input_precision=FAST)
        if LEARNS:
            at, known = _of_rays(grad_shared, rays[1], i, some, SIZES)
            # Without zeros: what fills a list has none but these, all of one ray.
            tl.atomic_add(at, back, mask=known & (back != 0.0), sem="relaxed")
        even, odd, _bias = first_layer(w1, b1, SIZES)
        # Gradients to the features take the features' place.
        tl.store(at_first, tl.dot(back, tl.trans(even), input_precision=FAST), mask=there)
        tl.store(at_second, tl.dot(back, tl.trans(odd), input_precision=FAST), mask=there)
        tile += tl.num_programs(0)
    level, unit = tl.arange(0, PADDED)[:, None], tl.arange(0, H)
    # One after another in `sums`: those of w1, b1, w2, b2.
    own = sums + tl.program_id(0).to(tl.int64) * ((2 * LEVELS + 1) * HIDDEN + (HIDDEN + 1) * OUT)
    at = own + 2 * level * HIDDEN + unit[None, :]
    known = (level < LEVELS) & (unit < HIDDEN)[None, :]
    tl.store(at, tl.trans(sum_even), mask=known)
    tl.store(at + HIDDEN, tl.trans(sum_odd), mask=known)
    own += 2 * LEVELS * HIDDEN
    tl.store(own + unit, sum_bias, mask=unit < HIDDEN)
    own += HIDDEN
    known = (unit < HIDDEN)[:, None] & (c < OUT)[None, :]
    tl.store(own + unit[:, None] * OUT + c[None, :], sum_second, mask=known)
    tl.store(own + HIDDEN * OUT + c, sum_out, mask=c < OUT)


def network_backward(
    u: Tensor,
    encoding: tuple[Tensor, Tensor],
    layers: tuple[Tensor, Tensor, Tensor, Tensor],
    rays: tuple[Tensor, Tensor] | None,
    grad_out: Tensor,
    grads: tuple[Tensor | None, Tensor | None, Tensor | None],
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Gradient of `network_forward` to the layers.

    Args: as there; grad_out [n,o]; grads = (of the table and of shared, which are added to, and of
    u, which is overwritten); None: not wanted.
    """
    table, resolutions = encoding
    w1, _, w2, _ = layers
    n, (of_table, of_shared, of_u) = u.shape[0], grads
    (inputs, hidden), outputs = w1.shape, w2.shape[1]
    programs = max(1, min(PROGRAMS, triton.cdiv(n, SAMPLES)))
    features = u.new_empty(inputs, n)
    sums = u.new_empty(programs, (inputs + 1) * hidden + (hidden + 1) * outputs)
    # The encoding is apart: its corners' rows would crowd the network out of the registers.
    hash_encode(u, table, resolutions, features)
    _backward[(programs,)](
        features,
        layers,
        rays or (u, resolutions),  # not read
        grad_out,
        (u if of_shared is None else of_shared, sums),
        n,
        SHARED=rays is not None,
        LEARNS=of_shared is not None,
        SIZES=sizes_of(table, w1, w2),
        BLOCK=SAMPLES,
        num_warps=WARPS,
    )
    if of_table is not None:
        hash_encode_backward(u, features, resolutions, of_table)
    if of_u is not None:
        hash_encode_slopes(u, features, table, resolutions, of_u)
    parts = sums.sum(0).split([inputs * hidden, hidden, hidden * outputs, outputs])
    return parts[0].view(inputs, hidden), parts[1], parts[2].view(hidden, outputs), parts[3]


def sizes_of(table: Tensor, w1: Tensor, w2: Tensor | None = None) -> tuple[int, ...]:
    """SIZES of an encoding and the network on it; with its second layer's where that is given."""
    levels, hidden = table.shape[0], w1.shape[1]
    own = levels, padded(levels), padded(hidden), hidden
    return own if w2 is None else (*own, padded(w2.shape[1]), w2.shape[1])
