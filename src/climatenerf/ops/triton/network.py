"""GPU kernels in Triton: an encoding together with a network of one hidden layer on it.

The twin is `reference.mlp(reference.hash_encode(u, ...), ...)`. The backward pass computes features
and hidden layer again instead of storing them. Samples are the rows of tiles that go through the
tensor cores.
"""

# pyright cannot know the types of Triton's functions.
# pyright: reportCallIssue=false, reportArgumentType=false, reportAttributeAccessIssue=false
# pyright: reportOperatorIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOptionalSubscript=false

import triton
import triton.language as tl
from torch import Tensor

from climatenerf.ops.triton.encoding import (
    feature_pointers,
    features_at,
    hash_encode,
    hash_encode_backward,
    hash_encode_slopes,
)
from climatenerf.ops.triton.tiles import launch, padded, points

SAMPLES = 32  # per tile
WARPS = 4  # per program
PROGRAMS = 1024  # of a backward pass, at most: each sums the weights' gradients of its tiles
# Three passes through the tensor cores reach single precision.
EXACT = tl.constexpr("tf32x3")
FAST = tl.constexpr("tf32")  # one pass: 11 bits, enough for a colour displayed in 8


@triton.jit
def first_layer(w1, b1, SIZES: tl.constexpr):
    """Load weights of the first features [levels, hidden], of the second ones, and biases."""
    PADDED: tl.constexpr = SIZES[1]
    H: tl.constexpr = SIZES[2]
    HIDDEN: tl.constexpr = SIZES[3]
    level, unit = tl.arange(0, PADDED)[:, None], tl.arange(0, H)[None, :]
    mask = (level < SIZES[0]) & (unit < HIDDEN)
    at = w1 + 2 * level * HIDDEN + unit
    even = tl.load(at, mask=mask, other=0.0)
    odd = tl.load(at + HIDDEN, mask=mask, other=0.0)
    bias = tl.load(b1 + tl.arange(0, H), mask=tl.arange(0, H) < HIDDEN, other=0.0)
    return even, odd, bias


@triton.jit
def hidden_of(first, second, layer, PRECISION: tl.constexpr):
    """Return the hidden layer before its ReLU [samples, hidden]."""
    even, odd, bias = layer
    h = tl.dot(first, even, input_precision=PRECISION)
    return tl.dot(second, odd, h, input_precision=PRECISION) + bias[None, :]


@triton.jit
def _second_layer(w2, SIZES: tl.constexpr):
    """Load the weights of the second layer [hidden, out]."""
    unit, out = tl.arange(0, SIZES[2])[:, None], tl.arange(0, SIZES[4])[None, :]
    mask = (unit < SIZES[3]) & (out < SIZES[5])
    return tl.load(w2 + unit * SIZES[5] + out, mask=mask, other=0.0)


@triton.jit
def _shared_pointers(shared, row, i, valid, SIZES: tl.constexpr):
    """Return pointers to what each sample's ray adds to the hidden layer, and a mask."""
    ray, unit = tl.load(row + i, mask=valid, other=0), tl.arange(0, SIZES[2])[None, :]
    return shared + ray[:, None] * SIZES[3] + unit, valid[:, None] & (unit < SIZES[3])


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
    i, valid, ux, uy, uz = points(u, tl.program_id(0), n, BLOCK)
    first, second = features_at(ux, uy, uz, valid, encoding, SIZES)
    h = hidden_of(first, second, first_layer(w1, b1, SIZES), EXACT)
    if SHARED:
        pointers, mask = _shared_pointers(rays[0], rays[1], i, valid, SIZES)
        h += tl.load(pointers, mask=mask, other=0.0)
    h = tl.maximum(h, 0.0)
    y = tl.dot(h, _second_layer(w2, SIZES), input_precision=EXACT)
    c = tl.arange(0, WIDTH)
    y += tl.load(b2 + c, mask=c < OUT, other=0.0)[None, :]
    tl.store(out + i[:, None] * OUT + c[None, :], y, mask=valid[:, None] & (c < OUT)[None, :])


def network_forward(
    u: Tensor,
    encoding: tuple[Tensor, Tensor],
    layers: tuple[Tensor, Tensor, Tensor, Tensor],
    rays: tuple[Tensor, Tensor] | None,
    out: Tensor,
) -> None:
    """Write the outputs of a network on the encoding of u [n,3] → out [n,o].

    Args:
        u: unit-cube coordinates.
        encoding: (table [L,T,2], resolutions).
        layers: (w1 [2L,h], b1, w2 [h,o], b2).
        rays: (shared [m,h], row [n]), what is added to the hidden layer of each sample; or None.
        out: [n,o].
    """
    table, resolutions = encoding
    w1, _, w2, _ = layers
    n = u.shape[0]
    launch(_forward, n, SAMPLES)(
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
        valid = i < n
        at_first, at_second, feature_mask = feature_pointers(features, i, n, valid, SIZES)
        first = tl.load(at_first, mask=feature_mask, other=0.0)
        second = tl.load(at_second, mask=feature_mask, other=0.0)
        # The layers are loaded again for each tile: kept in registers they would cause spills.
        layer = first_layer(w1, b1, SIZES)
        h = hidden_of(first, second, layer, EXACT)
        if SHARED:
            pointers, mask = _shared_pointers(rays[0], rays[1], i, valid, SIZES)
            h += tl.load(pointers, mask=mask, other=0.0)
        mask = valid[:, None] & (c < OUT)[None, :]
        g = tl.load(grad_out + i[:, None] * OUT + c[None, :], mask=mask, other=0.0)
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
            pointers, mask = _shared_pointers(grad_shared, rays[1], i, valid, SIZES)
            # Zeros are skipped: the padding of a list has only zeros, all for one ray.
            tl.atomic_add(pointers, back, mask=mask & (back != 0.0), sem="relaxed")
        even, odd, _bias = first_layer(w1, b1, SIZES)
        # Gradients to the features overwrite the features.
        tl.store(at_first, tl.dot(back, tl.trans(even), input_precision=FAST), mask=feature_mask)
        tl.store(at_second, tl.dot(back, tl.trans(odd), input_precision=FAST), mask=feature_mask)
        tile += tl.num_programs(0)
    level, unit = tl.arange(0, PADDED)[:, None], tl.arange(0, H)
    # `sums` holds the gradients of w1, b1, w2, b2 one after the other.
    target = sums + tl.program_id(0).to(tl.int64) * ((2 * LEVELS + 1) * HIDDEN + (HIDDEN + 1) * OUT)
    at = target + 2 * level * HIDDEN + unit[None, :]
    mask = (level < LEVELS) & (unit < HIDDEN)[None, :]
    tl.store(at, tl.trans(sum_even), mask=mask)
    tl.store(at + HIDDEN, tl.trans(sum_odd), mask=mask)
    target += 2 * LEVELS * HIDDEN
    tl.store(target + unit, sum_bias, mask=unit < HIDDEN)
    target += HIDDEN
    mask = (unit < HIDDEN)[:, None] & (c < OUT)[None, :]
    tl.store(target + unit[:, None] * OUT + c[None, :], sum_second, mask=mask)
    tl.store(target + HIDDEN * OUT + c, sum_out, mask=c < OUT)


def network_backward(
    u: Tensor,
    encoding: tuple[Tensor, Tensor],
    layers: tuple[Tensor, Tensor, Tensor, Tensor],
    rays: tuple[Tensor, Tensor] | None,
    grad_out: Tensor,
    grads: tuple[Tensor | None, Tensor | None, Tensor | None],
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the gradients of `network_forward` to the layers.

    Args:
        u, encoding, layers, rays: as there.
        grad_out: [n,o].
        grads: gradients of the table and of shared, which are added to, and of u, which is
            overwritten; None: not needed.
    """
    table, resolutions = encoding
    w1, _, w2, _ = layers
    n, (grad_table, grad_shared, grad_u) = u.shape[0], grads
    (inputs, hidden), outputs = w1.shape, w2.shape[1]
    programs = max(1, min(PROGRAMS, triton.cdiv(n, SAMPLES)))
    features = u.new_empty(inputs, n)
    sums = u.new_empty(programs, (inputs + 1) * hidden + (hidden + 1) * outputs)
    # The encoding is a separate launch: in one launch the registers would not suffice.
    hash_encode(u, table, resolutions, features)
    _backward[(programs,)](
        features,
        layers,
        rays or (u, resolutions),  # not read
        grad_out,
        (u if grad_shared is None else grad_shared, sums),
        n,
        SHARED=rays is not None,
        LEARNS=grad_shared is not None,
        SIZES=sizes_of(table, w1, w2),
        BLOCK=SAMPLES,
        num_warps=WARPS,
    )
    if grad_table is not None:
        hash_encode_backward(u, features, resolutions, grad_table)
    if grad_u is not None:
        hash_encode_slopes(u, features, table, resolutions, grad_u)
    parts = sums.sum(0).split([inputs * hidden, hidden, hidden * outputs, outputs])
    return parts[0].view(inputs, hidden), parts[1], parts[2].view(hidden, outputs), parts[3]


def sizes_of(table: Tensor, w1: Tensor, w2: Tensor | None = None) -> tuple[int, ...]:
    """Return SIZES of an encoding and the network on it, with outputs if w2 is given."""
    levels, hidden = table.shape[0], w1.shape[1]
    sizes = levels, padded(levels), padded(hidden), hidden
    return sizes if w2 is None else (*sizes, padded(w2.shape[1]), w2.shape[1])
