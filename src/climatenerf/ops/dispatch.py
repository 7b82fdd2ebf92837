"""The operations as the rest of the program calls them: one function each, with gradients.

The device of the tensors decides the kernel. Those of 32 bits go to Numba on a CPU (`cpu.py`), to
Triton on an NVIDIA GPU (`gpu.py`, the same functions but for what is said here); all others go to
the reference, which is slow and always right.
"""

from collections.abc import Sequence
from types import ModuleType
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from climatenerf.core.vectors import unit
from climatenerf.ops import reference
from climatenerf.ops.cpu import kernels as cpu
from climatenerf.ops.cpu import network as cpu_network


def _kernels(*tensors: Tensor) -> ModuleType | None:
    """The module with the kernels for these tensors; None: the reference takes them."""
    if not all(t.dtype in (torch.float32, torch.int64, torch.uint8) for t in tensors):
        return None
    devices = {t.device.type for t in tensors}
    if devices == {"cpu"}:
        return cpu
    if devices == {"cuda"}:
        from climatenerf.ops.triton import kernels as gpu

        return gpu
    return None


def _array(tensor: Tensor) -> Any:
    """A tensor's numbers as kernels take them; a copy if they do not lie in order."""
    tensor = tensor.detach().contiguous()
    return tensor if tensor.is_cuda else tensor.numpy()


CAPACITY = 1024  # samples a ray may have; a ray across all cascades takes 850 whole steps
CPU_RAYS = 2048  # marched at once; a multiple of cpu.RAY_BLOCK
GPU_RAYS = 2**15  # the same; the room for their samples takes 12 kB a ray


class _HashEncode(torch.autograd.Function):
    @staticmethod
    def forward(ctx, u, table, resolutions, kernels):
        out = u.new_empty(2 * table.shape[0], u.shape[0])
        kernels.hash_encode(_array(u), _array(table), _array(resolutions), _array(out))
        ctx.kernels = kernels
        ctx.save_for_backward(u, resolutions)
        ctx.table = table
        return out.T

    @staticmethod
    def backward(ctx, grad):
        u, resolutions = ctx.saved_tensors
        table = ctx.table
        grad_u = None
        if ctx.needs_input_grad[0]:
            grad_u = torch.empty_like(u, memory_format=torch.contiguous_format)
            ctx.kernels.hash_encode_slopes(
                _array(u), _array(grad.T), _array(table), _array(resolutions), _array(grad_u)
            )
        if not ctx.needs_input_grad[1]:
            return grad_u, None, None, None
        # A buffer kept on the table saves zeroing and copying megabytes each step: the optimiser
        # clears what it has used (training/optimiser.py).
        buffer = getattr(table, "grad_buffer", None)
        target = torch.zeros_like(table) if buffer is None else buffer
        ctx.kernels.hash_encode_backward(
            _array(u), _array(grad.T), _array(resolutions), _array(target)
        )
        return grad_u, (target if buffer is None else None), None, None


def hash_encode(
    u: Float[Tensor, "n 3"],
    table: Float[Tensor, "levels rows 2"],
    resolutions: Int[Tensor, "levels"],
) -> Float[Tensor, "n features"]:
    """See `reference.hash_encode`; gradients to the table and to the positions (once)."""
    if kernels := _kernels(u, table):
        return _HashEncode.apply(u, table, resolutions, kernels)
    return reference.hash_encode(u, table, resolutions)


class _RenderWeights(torch.autograd.Function):
    @staticmethod
    def forward(ctx, tau, offsets, kernels):
        # Zeros: what follows the last ray's samples belongs to none.
        weights, left = torch.zeros_like(tau), tau.new_empty(offsets.shape[0] - 1)
        kernels.weights_forward(_array(tau), _array(offsets), _array(weights), _array(left))
        ctx.kernels = kernels
        ctx.save_for_backward(tau, offsets)
        return weights, left

    @staticmethod
    def backward(ctx, grad_w, grad_t):
        tau, offsets = ctx.saved_tensors
        grad = torch.zeros_like(tau)
        ctx.kernels.weights_backward(
            _array(tau), _array(offsets), _array(grad_w), _array(grad_t), _array(grad)
        )
        return grad, None, None


def render_weights(
    tau: Float[Tensor, "s"], offsets: Int[Tensor, "rays+1"]
) -> tuple[Float[Tensor, "s"], Float[Tensor, "rays"]]:
    """See `reference.render_weights`."""
    if kernels := _kernels(tau, offsets):
        return _RenderWeights.apply(tau.contiguous(), offsets, kernels)
    return reference.render_weights(tau, offsets)


class _Accumulate(torch.autograd.Function):
    """On a CPU values lie in rows, as networks leave them, elsewhere side by side."""

    @staticmethod
    def forward(ctx, weights, values, offsets, kernels):
        out = values.new_empty(offsets.shape[0] - 1, values.shape[1])
        given = values.T if kernels is cpu else values
        kernels.accumulate_forward(_array(weights), _array(given), _array(offsets), _array(out))
        ctx.kernels = kernels
        ctx.save_for_backward(weights, values, offsets)
        return out

    @staticmethod
    def backward(ctx, grad):
        weights, values, offsets = ctx.saved_tensors
        given = values.T if ctx.kernels is cpu else values
        grad_w, grad_v = torch.zeros_like(weights), values.new_zeros(given.shape)
        ctx.kernels.accumulate_backward(
            *map(_array, (weights, given, offsets, grad, grad_w, grad_v))
        )
        return grad_w, grad_v.T if ctx.kernels is cpu else grad_v, None, None


def accumulate(
    weights: Float[Tensor, "s"], values: Float[Tensor, "s c"], offsets: Int[Tensor, "rays+1"]
) -> Float[Tensor, "rays c"]:
    """See `reference.accumulate`."""
    if kernels := _kernels(weights, values, offsets):
        return _Accumulate.apply(weights.contiguous(), values, offsets, kernels)
    return reference.accumulate(weights, values, offsets)


class _Surface(torch.autograd.Function):
    @staticmethod
    def forward(ctx, weights, raw, target, offsets):
        n = offsets.shape[0] - 1
        logits, apart = raw.new_empty(n, raw.shape[1] - 3), raw.new_empty(n)
        cpu.surface_forward(*map(_array, (weights, raw.T, target, offsets, logits, apart)))
        ctx.save_for_backward(weights, raw, target, offsets)
        return logits, apart

    @staticmethod
    def backward(ctx, grad_logits, grad_apart):
        weights, raw, target, offsets = ctx.saved_tensors
        grad = raw.new_zeros(raw.shape[1], raw.shape[0])
        given = (weights, raw.T, target, offsets, grad_logits, grad_apart, grad)
        cpu.surface_backward(*map(_array, given))
        return None, grad.T, None, None


def surface(
    weights: Float[Tensor, "s"],
    raw: Float[Tensor, "s 3+c"],
    target: Float[Tensor, "s 3"] | None,
    offsets: Int[Tensor, "rays+1"],
) -> tuple[Float[Tensor, "rays c"], Float[Tensor, "rays"]]:
    """See `reference.surface`; gradients to raw only."""
    weights, goal = weights.detach(), raw.new_empty(0, 3) if target is None else target.detach()
    kernels = _kernels(weights, raw, goal, offsets)
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
        kernels.distortion_forward(*map(_array, (weights, s, ds, offsets, out)))
        ctx.kernels = kernels
        ctx.save_for_backward(weights, s, ds, offsets)
        return out

    @staticmethod
    def backward(ctx, grad):
        weights, s, ds, offsets = ctx.saved_tensors
        grad_w = torch.zeros_like(weights)
        ctx.kernels.distortion_backward(*map(_array, (weights, s, ds, offsets, grad, grad_w)))
        return grad_w, None, None, None, None


def distortion(
    weights: Float[Tensor, "s"],
    s: Float[Tensor, "s"],
    ds: Float[Tensor, "s"],
    offsets: Int[Tensor, "rays+1"],
) -> Float[Tensor, "rays"]:
    """See `reference.distortion`; gradients to the weights only."""
    if kernels := _kernels(weights, s, ds, offsets):
        return _Distortion.apply(weights.contiguous(), s, ds, offsets, kernels)
    return reference.distortion(weights, s, ds, offsets)


class _Network(torch.autograd.Function):
    """Keeps no hidden layer: the backward pass computes them again, block by block."""

    @staticmethod
    def forward(ctx, x, shared, row, *layers):
        weights, widths = layers[::2], np.array([x.shape[1], *(b.shape[0] for b in layers[1::2])])
        common = x.new_empty(0, widths[1]) if shared is None else shared
        rows = x.new_empty(0, dtype=torch.long) if row is None else row
        packed = _in_one_row([w.T for w in weights], layers[1::2])
        out = x.new_empty(widths[-1], x.shape[0])
        cpu_network.network_forward(
            _array(x.T), _array(common), _array(rows), packed, widths, _array(out)
        )
        ctx.save_for_backward(x, common, rows, *layers)
        ctx.given = packed, widths
        return out.T

    @staticmethod
    def backward(ctx, grad):
        x, common, rows, *layers = ctx.saved_tensors
        packed, widths = ctx.given
        turned = _in_one_row(layers[::2], layers[1::2])
        borders = cpu_network.chunk_borders(_array(rows), x.shape[0])
        sums = x.new_zeros(borders.shape[0] - 1, packed.shape[0])
        grad_x = x.new_empty(widths[0] if ctx.needs_input_grad[0] else 0, x.shape[0])
        grad_shared = torch.zeros_like(common if ctx.needs_input_grad[1] else common[:0])
        cpu_network.network_backward(
            (_array(x.T), _array(common), _array(rows)),
            packed,
            turned,
            widths,
            _array(grad.T),
            borders,
            (_array(grad_x), _array(grad_shared), _array(sums)),
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
    return np.concatenate([_array(each).reshape(-1) for pair in pairs for each in pair])


def mlp(
    x: Float[Tensor, "n i"],
    layers: list[tuple[Tensor, Tensor]],
    shared: Float[Tensor, "m h"] | None = None,
    row: Int[Tensor, "n"] | None = None,
) -> Float[Tensor, "n o"]:
    """See `reference.mlp`, which it is but for networks of 32 bits with hidden layers on a CPU."""
    given = [x, *(each for pair in layers for each in pair), *([] if shared is None else [shared])]
    if _kernels(*given) is cpu and len(layers) > 1:  # a GPU's own matrix products are fast
        return _Network.apply(x, shared, row, *(each for pair in layers for each in pair))
    return reference.mlp(x, layers, shared, row)


class _EncodedNetwork(torch.autograd.Function):
    """An encoding and the network on it in one launch. Keeps nothing but where the samples are."""

    @staticmethod
    def forward(ctx, u, table, resolutions, shared, row, w1, b1, w2, b2):
        from climatenerf.ops.triton import network as gpu_network

        rays = None if shared is None else (_array(shared), _array(row))
        encoding, layers = (
            (_array(table), _array(resolutions)),
            tuple(map(_array, (w1, b1, w2, b2))),
        )
        out = torch.empty(u.shape[0], w2.shape[1], device=u.device)
        gpu_network.network_forward(_array(u), encoding, layers, rays, out)
        ctx.save_for_backward(u, resolutions, shared, row, w1, b1, w2, b2)
        ctx.table = table
        return out

    @staticmethod
    def backward(ctx, grad):
        from climatenerf.ops.triton import network as gpu_network

        u, resolutions, shared, row, *layers = ctx.saved_tensors
        u, layers = _array(u), tuple(map(_array, layers))
        rays = None if shared is None else (_array(shared), _array(row))
        encoding = _array(ctx.table), _array(resolutions)
        # As `_HashEncode.backward`: the optimiser clears what it has used.
        buffer = getattr(ctx.table, "grad_buffer", None)
        learns = ctx.needs_input_grad[1]
        of_table = (torch.zeros_like(encoding[0]) if buffer is None else buffer) if learns else None
        of_shared = torch.zeros_like(rays[0]) if rays and ctx.needs_input_grad[3] else None
        of_u = torch.empty_like(u) if ctx.needs_input_grad[0] else None
        of_layers = gpu_network.network_backward(
            u, encoding, layers, rays, _array(grad), (of_table, of_shared, of_u)
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
        _kernels(*given, *([] if shared is None else [shared])) not in (None, cpu)
        and len(layers) == 2
    ):
        return _EncodedNetwork.apply(u, table, resolutions, shared, row, *layers[0], *layers[1])
    return mlp(hash_encode(u, table, resolutions), layers, shared, row)


def merge_order(
    t_a: Float[Tensor, "a"],
    offsets_a: Int[Tensor, "rays+1"],
    t_b: Float[Tensor, "b"],
    offsets_b: Int[Tensor, "rays+1"],
) -> tuple[Int[Tensor, "a+b"], Int[Tensor, "rays+1"]]:
    """See `reference.merge_order`."""
    kernels = _kernels(t_a, t_b, offsets_a, offsets_b)
    if kernels is None:
        return reference.merge_order(t_a, offsets_a, t_b, offsets_b)
    offsets = offsets_a + offsets_b
    order = offsets.new_empty(t_a.shape[0] + t_b.shape[0])
    kernels.merge_order(*map(_array, (t_a, offsets_a, t_b, offsets_b, offsets, order)))
    return order, offsets


# --- without gradients ---------------------------------------------------------------------------

Views = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
"""Maps of some views in one row (8 bits), where each starts, sizes (rows, columns), fx fy cx cy,
c2w."""


def label_votes(
    x: Float[Tensor, "n 3"],
    radius: Float[Tensor, "n"],
    views: Views,
    least: tuple[int, float, float],
) -> Bool[Tensor, "n"]:
    """See `reference.label_votes`."""
    kernels = _kernels(x, radius, *views)
    if kernels is None:
        reach, starts, sizes, pinholes, c2w = views
        corners = zip(starts.tolist(), sizes.tolist(), strict=True)
        maps = [reach[start : start + h * w].view(h, w) for start, (h, w) in corners]
        return reference.label_votes(x, radius, maps, pinholes, c2w, least)
    agreed = torch.empty_like(radius, dtype=torch.uint8)
    given = _array(x), _array(radius), tuple(map(_array, views)), least
    if kernels is cpu:
        cpu.label_votes(*given, _array(agreed))
    else:
        from climatenerf.ops.triton import visual_hull as gpu_witness

        gpu_witness.label_votes(*given, agreed)
    return agreed.bool()


Net = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]
"""Table and resolutions of an encoding; w1, b1, w2, b2 of the network of one hidden layer on it."""
Cells = tuple[Int[Tensor, "k w w w"] | UInt8[Tensor, "k g g g"], UInt8[Tensor, "k b b b"]]
"""What `cells_of` gives: words of 4³ cells on a CPU, cells elsewhere; and blocks."""


def _cpu_net(net: Net) -> tuple:
    """With the weights turned: a unit's lie side by side."""
    table, resolutions, w1, b1, w2, b2 = net
    return *map(_array, (table, resolutions, w1.T, b1, w2.T)), _array(b2)[0]


@torch.no_grad()
def density(q: Float[Tensor, "n 3"], net: Net) -> Float[Tensor, "n"]:
    """See `reference.density`, which it is for one hidden layer."""
    kernels = _kernels(q, *net)
    if kernels is None:
        table, resolutions, w1, b1, w2, b2 = net
        return reference.density(q, table, resolutions, [(w1, b1), (w2, b2)])
    out = q.new_empty(q.shape[0])
    if kernels is cpu:
        kernels.density_at(_array(q), _cpu_net(net), _array(out))
    else:
        kernels.density_at(_array(q), tuple(map(_array, net)), _array(out))
    return out


def density_slopes(q: Float[Tensor, "n 3"], net: Net) -> Float[Tensor, "n 3"]:
    """See `reference.density_slopes`; q in grid units, no gradient."""
    kernels = _kernels(q, *net)
    table, resolutions, w1, b1, w2, b2 = (each.detach() for each in net)
    if kernels is None:
        return reference.density_slopes(q, table, resolutions, [(w1, b1), (w2, b2)])
    out = torch.empty_like(q, memory_format=torch.contiguous_format)
    if kernels is cpu:
        cpu.density_slopes(_array(q), _cpu_net(net), _array(w1), _array(out))
    else:
        from climatenerf.ops.triton import network as gpu_network

        gpu_network.density_slopes(_array(q), tuple(map(_array, net)), _array(out))
    return out


@torch.no_grad()
def positions(
    rays: tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]],
    offsets: Int[Tensor, "n+1"],
    t: Float[Tensor, "s"],
) -> Float[Tensor, "s 3"]:
    """Where packed samples lie in the unit cube (`reference.contract`); lengths in grid units."""
    kernels = _kernels(*rays, offsets, t)
    if kernels is None:
        o, d = (torch.repeat_interleave(each, offsets.diff(), dim=0) for each in rays)
        return reference.contract(o + t[:, None] * d)
    u = t.new_zeros(t.shape[0], 3)
    kernels.grid_positions(*map(_array, (*rays, offsets, t, u)))
    return u


def cells_of(occupied: UInt8[Tensor, "k g g g"]) -> Cells:
    """What `march` reads of an occupancy: its cells, and which blocks of 8³ cells hold one.

    On a CPU cells are bits, 4³ of them a number, so that they stay in the nearer caches. Where the
    side does not allow for blocks (they would reach into the cube of the next finer cascade), they
    are the cells themselves.
    """
    cascades, side = occupied.shape[:2]
    whole = side % 32 == 0
    blocks = occupied.new_empty(cascades, *3 * (side // 8,)) if whole else occupied
    if _kernels(occupied) is not cpu:
        if whole:
            split = occupied.view(cascades, side // 8, 8, side // 8, 8, side // 8, 8)
            torch.amax(split, dim=(2, 4, 6), out=blocks)
        return occupied, blocks
    words = occupied.new_empty(cascades, *3 * (-(-side // 4),), dtype=torch.int64)
    cpu.pack_cells(_array(occupied), _array(words))
    if whole:
        cpu.occupied_blocks(_array(words), _array(blocks))
    return words, blocks


@torch.no_grad()
def adam(
    parameter: Tensor,
    gradient: Tensor,
    moments: tuple[Tensor, Tensor],
    rate: float,
    betas: tuple[float, float],
    epsilon: float,
    step: int,
) -> None:
    """One step of Adam (Kingma & Ba 2015) in place, for tables whose gradients are mostly zero.

    Entries without gradient are left alone with their moments; the gradient is cleared.
    """
    kernels = _kernels(parameter, gradient, *moments)
    if kernels is None:
        raise TypeError("a table and its moments must be of 32 bits and on one device")
    corrections = (1.0 - beta**step for beta in betas)
    scalars = map(np.float32, (rate, *betas, epsilon, *corrections))
    kernels.adam(*(_array(each.view(-1)) for each in (parameter, gradient, *moments)), *scalars)


@torch.no_grad()
def march(
    rays: tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]],
    spans: Float[Tensor, "n 3"],
    cells: Cells,
    steps: tuple[float, float, float],
    stop: float,
    net: Net,
    room: int | None = None,
) -> tuple[Int[Tensor, "n+1"], Float[Tensor, "3 s"]]:
    """See `reference.march`: all rays' samples, packed, and their offsets.

    Args:
        rays: origins and unit directions, grid units.
        spans: first and last length of each ray, share of the first step that it begins after.
        cells: which are occupied, by `cells_of`.
        steps: the smallest one, the step per length, the optical depth below which one is empty.
        stop: transmittance at which a ray ends.
        net: of the density.
        room: length of the samples' list; what is over is 0, the last at least, and samples that
            find no room are left out. None: as many as there are, for which a GPU has to be asked.

    Returns:
        Offsets; t, dt (grid units) and sigma (1/grid unit) of the samples.
    """
    kernels = _kernels(*rays, *net)
    if kernels is None:
        raise TypeError("rays and field must be of 32 bits and on one device, CPU or NVIDIA GPU")
    at_once = CPU_RAYS if kernels is cpu else GPU_RAYS
    occupied = tuple(map(_array, cells))
    weights = _cpu_net(net) if kernels is cpu else tuple(map(_array, net))
    # Used again and again: fresh memory would cost more than marching.
    scratch = _array(_scratch(rays[0], at_once, kernels is cpu))
    parts, ends = [], [spans.new_zeros(1, dtype=torch.long)]
    out = None if room is None else spans.new_zeros(3, room)
    for o, d, span in zip(*(x.split(at_once) for x in (*rays, spans)), strict=True):
        count = o.new_zeros(o.shape[0], dtype=torch.long)
        given = _array(o), _array(d), _array(span)
        kernels.march(*given, occupied, steps, stop, weights, scratch, _array(count))
        begin = ends[-1][-1:]
        own = count.cumsum(0)
        if out is None:
            part = o.new_empty(3, int(count.sum()))
            kernels.pack(scratch, _array(torch.cat([ends[0], own])), _array(part))
            parts.append(part)
            ends.append(begin + own)
        else:
            ends.append((begin + own).clamp_max(out.shape[1] - 1))
            kernels.pack(scratch, _array(torch.cat([begin, ends[-1]])), _array(out))
    return torch.cat(ends), torch.cat(parts, dim=1) if out is None else out


def takes_whole_rays(*tensors: Tensor) -> bool:
    """Whether these are on a GPU, as `composite` wants them."""
    kernels = _kernels(*tensors)
    return kernels is not None and kernels is not cpu


@torch.no_grad()
def composite(
    rays: tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]],
    spans: Float[Tensor, "n 3"],
    cells: Cells,
    steps: tuple[float, float, float],
    limits: tuple[float, float],
    net: Net,
    colours: tuple[Net, Float[Tensor, "n h"]],
) -> Float[Tensor, "n 5"]:
    """Whole rays in one launch, where `takes_whole_rays`; elsewhere march and composite.

    Args:
        rays, spans, cells, steps, net: as those of `march`.
        limits: transmittance at which a ray ends, weight from which a sample has a colour.
        colours: encoding and network of the appearance, and what is added to its hidden layer.

    Returns:
        Linear radiance of matter, weighted sum of ray lengths (grid units), transmittance.
    """
    from climatenerf.ops.triton import fused_render as gpu_render

    looks, shared = colours
    out = spans.new_empty(spans.shape[0], 5)
    weights = tuple(map(_array, net)), tuple(map(_array, looks))
    given = tuple(map(_array, rays)), _array(spans), tuple(map(_array, cells))
    gpu_render.composite(*given, steps, limits, *weights, _array(shared), _array(out))
    return out


def _scratch(rays_o: Tensor, at_once: int, by_block: bool) -> Tensor:
    """Memory for the samples of some rays: in blocks of rays, or a column for each."""
    n = min(at_once, max(rays_o.shape[0], 1))
    if by_block:
        return rays_o.new_empty(3, -(-n // cpu.RAY_BLOCK), cpu.RAY_BLOCK * CAPACITY)
    return rays_o.new_empty(3, CAPACITY, n)
