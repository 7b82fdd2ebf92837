"""Marching of rays through occupied space, and the density on the way. No gradients."""

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from climatenerf.ops import dispatch, reference
from climatenerf.ops.cpu import marching as cpu

CAPACITY = 1024  # samples a ray may have; a ray across all cascades takes 850 whole steps
CPU_RAYS = 2048  # marched at once; a multiple of cpu.RAY_BLOCK
GPU_RAYS = 2**15  # the same; the room for their samples takes 12 kB a ray
Net = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]
"""Table and resolutions of an encoding; w1, b1, w2, b2 of the network of one hidden layer on it."""
Cells = tuple[Int[Tensor, "k w w w"] | UInt8[Tensor, "k g g g"], UInt8[Tensor, "k b b b"]]
"""What `cells_of` gives: words of 4³ cells on a CPU, cells elsewhere; and blocks."""


def _cpu_net(net: Net) -> tuple:
    """With the weights turned: a unit's lie side by side."""
    table, resolutions, w1, b1, w2, b2 = net
    return *map(dispatch.kernel_array, (table, resolutions, w1.T, b1, w2.T)), dispatch.kernel_array(
        b2
    )[0]


@torch.no_grad()
def density(q: Float[Tensor, "n 3"], net: Net) -> Float[Tensor, "n"]:
    """See `reference.density`, which it is for one hidden layer."""
    kernels = dispatch.kernels("marching", q, *net)
    if kernels is None:
        table, resolutions, w1, b1, w2, b2 = net
        return reference.density(q, table, resolutions, [(w1, b1), (w2, b2)])
    out = q.new_empty(q.shape[0])
    if kernels is cpu:
        kernels.density_at(dispatch.kernel_array(q), _cpu_net(net), dispatch.kernel_array(out))
    else:
        kernels.density_at(
            dispatch.kernel_array(q),
            tuple(map(dispatch.kernel_array, net)),
            dispatch.kernel_array(out),
        )
    return out


def density_slopes(q: Float[Tensor, "n 3"], net: Net) -> Float[Tensor, "n 3"]:
    """See `reference.density_slopes`; q in grid units, no gradient."""
    kernels = dispatch.kernels("marching", q, *net)
    table, resolutions, w1, b1, w2, b2 = (each.detach() for each in net)
    if kernels is None:
        return reference.density_slopes(q, table, resolutions, [(w1, b1), (w2, b2)])
    out = torch.empty_like(q, memory_format=torch.contiguous_format)
    if kernels is cpu:
        cpu.density_slopes(
            dispatch.kernel_array(q),
            _cpu_net(net),
            dispatch.kernel_array(w1),
            dispatch.kernel_array(out),
        )
    else:
        kernels.density_slopes(
            dispatch.kernel_array(q),
            tuple(map(dispatch.kernel_array, net)),
            dispatch.kernel_array(out),
        )
    return out


@torch.no_grad()
def positions(
    rays: tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]],
    offsets: Int[Tensor, "n+1"],
    t: Float[Tensor, "s"],
) -> Float[Tensor, "s 3"]:
    """Where packed samples lie in the unit cube (`reference.contract`); lengths in grid units."""
    kernels = dispatch.kernels("marching", *rays, offsets, t)
    if kernels is None:
        o, d = (torch.repeat_interleave(each, offsets.diff(), dim=0) for each in rays)
        return reference.contract(o + t[:, None] * d)
    u = t.new_zeros(t.shape[0], 3)
    kernels.grid_positions(*map(dispatch.kernel_array, (*rays, offsets, t, u)))
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
    if dispatch.kernels("marching", occupied) is not cpu:
        if whole:
            split = occupied.view(cascades, side // 8, 8, side // 8, 8, side // 8, 8)
            torch.amax(split, dim=(2, 4, 6), out=blocks)
        return occupied, blocks
    words = occupied.new_empty(cascades, *3 * (-(-side // 4),), dtype=torch.int64)
    cpu.pack_cells(dispatch.kernel_array(occupied), dispatch.kernel_array(words))
    if whole:
        cpu.occupied_blocks(dispatch.kernel_array(words), dispatch.kernel_array(blocks))
    return words, blocks


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
    kernels = dispatch.kernels("marching", *rays, *net)
    if kernels is None:
        raise TypeError("rays and field must be of 32 bits and on one device, CPU or NVIDIA GPU")
    at_once = CPU_RAYS if kernels is cpu else GPU_RAYS
    occupied = tuple(map(dispatch.kernel_array, cells))
    weights = _cpu_net(net) if kernels is cpu else tuple(map(dispatch.kernel_array, net))
    # Used again and again: fresh memory would cost more than marching.
    scratch = dispatch.kernel_array(_scratch(rays[0], at_once, kernels is cpu))
    parts, ends = [], [spans.new_zeros(1, dtype=torch.long)]
    out = None if room is None else spans.new_zeros(3, room)
    for o, d, span in zip(*(x.split(at_once) for x in (*rays, spans)), strict=True):
        count = o.new_zeros(o.shape[0], dtype=torch.long)
        given = dispatch.kernel_array(o), dispatch.kernel_array(d), dispatch.kernel_array(span)
        kernels.march(*given, occupied, steps, stop, weights, scratch, dispatch.kernel_array(count))
        begin = ends[-1][-1:]
        own = count.cumsum(0)
        if out is None:
            part = o.new_empty(3, int(count.sum()))
            kernels.pack(
                scratch,
                dispatch.kernel_array(torch.cat([ends[0], own])),
                dispatch.kernel_array(part),
            )
            parts.append(part)
            ends.append(begin + own)
        else:
            ends.append((begin + own).clamp_max(out.shape[1] - 1))
            kernels.pack(
                scratch,
                dispatch.kernel_array(torch.cat([begin, ends[-1]])),
                dispatch.kernel_array(out),
            )
    return torch.cat(ends), torch.cat(parts, dim=1) if out is None else out


def _scratch(rays_o: Tensor, at_once: int, by_block: bool) -> Tensor:
    """Memory for the samples of some rays: in blocks of rays, or a column for each."""
    n = min(at_once, max(rays_o.shape[0], 1))
    if by_block:
        return rays_o.new_empty(3, -(-n // cpu.RAY_BLOCK), cpu.RAY_BLOCK * CAPACITY)
    return rays_o.new_empty(3, CAPACITY, n)
