"""Whole rays on a GPU in one launch: march, encode, both networks, composite. In Triton.

The twin is the composition of the separate operations (`field.compositing.composited`). No samples
are stored, so that memory does not grow with their number.
"""

# pyright cannot know the types of Triton's functions.
# pyright: reportCallIssue=false, reportArgumentType=false, reportAttributeAccessIssue=false
# pyright: reportOperatorIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false

import math

import triton
import triton.language as tl
from torch import Tensor

from climatenerf.ops.triton.compositing import weight_of
from climatenerf.ops.triton.encoding import features_at
from climatenerf.ops.triton.marching import (
    RAYS,
    SEARCHES,
    WARPS,
    begin,
    cells_of,
    density_layers,
    density_of,
    middle_of,
    search,
    unit_cube,
)
from climatenerf.ops.triton.network import FAST, first_layer, hidden_of, sizes_of
from climatenerf.ops.triton.tiles import launch

SHARPNESS = tl.constexpr(8.0)  # of the softplus; see `ops.cpu.activations`
SLOPE_ABOVE = tl.constexpr(2.4 / 1.055)  # of the decoding curve above 1; see `core.colour`


@triton.jit
def radiance(raw):
    """Return the linear radiance of network outputs: softplus, then sRGB decoding."""
    x = raw + 0.5
    # For large x softplus is x, and exp would overflow. For very negative x it is exp, which
    # would vanish in the sum with 1.
    e = tl.exp(tl.minimum(x * SHARPNESS, 20.0))
    soft = tl.where(e < 1e-3, e * (1.0 - 0.5 * e), tl.log(1.0 + e)) / SHARPNESS
    x = tl.where(x * SHARPNESS <= 20.0, soft, x)
    curve = tl.exp2(2.4 * tl.log2((tl.maximum(x, 0.04045) + 0.055) / 1.055))
    bright = 1.0 + (x - 1.0) * SLOPE_ABOVE
    return tl.where(x <= 0.04045, x / 12.92, tl.where(x > 1.0, bright, curve))


@triton.jit(do_not_specialize=["n"])
def _composite(
    rays,
    spans,
    cells,
    steps,
    limits,
    density,
    colour,
    shared,
    out,
    n,
    SIZES: tl.constexpr,
    SIZES_C: tl.constexpr,
    BLOCK: tl.constexpr,
):
    r, valid, o, d, t, end = begin(rays, spans, cells[2][0], steps, n, BLOCK)
    layers = density_layers(density[1], SIZES)
    w1, b1, w2, b2 = colour[1]
    layer = first_layer(w1, b1, SIZES_C)
    HIDDEN: tl.constexpr = SIZES_C[3]
    unit, c = tl.arange(0, SIZES_C[2]), tl.arange(0, 16)
    mask = (unit < HIDDEN)[:, None] & (c < 3)[None, :]
    second_layer = tl.load(w2 + unit[:, None] * 3 + c[None, :], mask=mask, other=0.0)
    bias = tl.load(b2 + c, mask=c < 3, other=0.0)
    mask = valid[:, None] & (unit < HIDDEN)[None, :]
    ray_hidden = tl.load(shared + r[:, None] * HIDDEN + unit[None, :], mask=mask, other=0.0)
    tau, length = tl.zeros_like(t), tl.zeros_like(t)
    rgb = tl.zeros([BLOCK, 16], tl.float32)
    live = valid & (t < end)
    searches = 0
    while (tl.max(live.to(tl.int32), 0) > 0) & (searches < SEARCHES):
        searches += 1
        t, found = search(o, d, t, end, live, cells, steps)
        here = found > 0
        if tl.max(found, 0) > 0:
            dt, tm, qx, qy, qz = middle_of(o, d, t, end, steps)
            depth = density_of(qx, qy, qz, here, density[0], layers, SIZES) * dt
            depth = tl.where(here & (depth > steps[2]), depth, 0.0)
            weight = weight_of(tau, depth)
            tau += depth
            length += weight * tm
            heavy = weight > limits[1]
            if tl.max(heavy.to(tl.int32), 0) > 0:
                ux, uy, uz, _distance = unit_cube(qx, qy, qz)
                first, second = features_at(ux, uy, uz, heavy, colour[0], SIZES_C)
                h = tl.maximum(hidden_of(first, second, layer, FAST) + ray_hidden, 0.0)
                y = tl.dot(h, second_layer, input_precision=FAST) + bias[None, :]
                rgb += tl.where(heavy, weight, 0.0)[:, None] * radiance(y)
            t = tl.where(here, t + dt, t)
        live = live & (t < end) & (tau < limits[0])
    tl.store(out + 5 * r[:, None] + c[None, :], rgb, mask=valid[:, None] & (c < 3)[None, :])
    tl.store(out + 5 * r + 3, length, mask=valid)
    tl.store(out + 5 * r + 4, tl.exp(-tau), mask=valid)


def composite(
    rays: tuple[Tensor, Tensor],
    spans: Tensor,
    cells: tuple[Tensor, Tensor],
    steps: tuple[float, float, float],
    limits: tuple[float, float],
    net: tuple[Tensor, ...],
    colours: tuple[Tensor, ...],
    shared: Tensor,
    out: Tensor,
) -> None:
    """Write radiance, weighted sum of lengths and transmittance of rays → out [n,5].

    Args:
        rays: (origins, directions), grid units.
        spans, cells, steps, net: as `marching.march` takes them.
        limits: transmittance at which a ray ends; weight from which a sample's colour is evaluated.
        colours: (table, resolutions, w1, b1, w2, b2) of the appearance.
        shared: [n,H], added to the hidden layer of the appearance.
        out: [n,5].
    """
    nets = []
    for table, resolutions, *layers in (net, colours):
        nets.append(((table, resolutions, table.shape[1]), tuple(layers)))
    n, stop = spans.shape[0], -math.log(limits[0])
    launch(_composite, n, RAYS)(
        rays,
        spans,
        cells_of(cells),
        steps,
        (stop, limits[1]),
        *nets,
        shared,
        out,
        n,
        SIZES=sizes_of(net[0], net[2]),
        SIZES_C=sizes_of(colours[0], colours[2]),
        BLOCK=RAYS,
        num_warps=WARPS,
    )
