"""Marching of rays through occupied space, and the density that it evaluates. No gradients.

Lengths are in grid units (see `reference.contract`).
"""

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from climatenerf.ops import dispatch, reference
from climatenerf.ops.cpu import marching as cpu

MAX_RAY_SAMPLES = 1024  # capacity of a ray; a ray across all cascades takes 850 whole steps
CPU_RAYS = 2048  # rays per launch on a CPU; a multiple of cpu.RAY_BLOCK
GPU_RAYS = 2**15  # rays per launch on a GPU; the scratch memory takes 12 kB a ray

Net = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]
"""Table and resolutions of an encoding; w1, b1, w2, b2 of the network of one hidden layer on it.

Weights are [inputs, outputs].
"""
Cells = tuple[Int[Tensor, "k w w w"] | UInt8[Tensor, "k g g g"], UInt8[Tensor, "k b b b"]]
"""The result of `cells_of`: 64-bit words of 4³ cells on a CPU, cells on a GPU; and blocks."""


def _cpu_net(net: Net) -> tuple:
    """Return a network as the CPU kernels take it: weights [outputs, inputs], b2 a float."""
    table, resolutions, w1, b1, w2, b2 = net
    arrays = dispatch.kernel_arrays(table, resolutions, w1.T, b1, w2.T, b2)
    return *arrays[:-1], arrays[-1][0]


@torch.no_grad()
def density(q: Float[Tensor, "n 3"], net: Net) -> Float[Tensor, "n"]:
    """Return the density (1/grid unit) at q: `reference.density` with one hidden layer."""
    kernels = dispatch.kernels("marching", q, *net)
    if kernels is None:
        table, resolutions, w1, b1, w2, b2 = net
        return reference.density(q, table, resolutions, [(w1, b1), (w2, b2)])
    out = q.new_empty(q.shape[0])
    arrays = _cpu_net(net) if kernels is cpu else dispatch.kernel_arrays(*net)
    kernels.density_at(dispatch.kernel_array(q), arrays, dispatch.kernel_array(out))
    return out


def density_slopes(q: Float[Tensor, "n 3"], net: Net) -> Float[Tensor, "n 3"]:
    """Return the gradient of the logarithm of the density at q: `reference.density_slopes`."""
    kernels = dispatch.kernels("marching", q, *net)
    table, resolutions, w1, b1, w2, b2 = (each.detach() for each in net)
    if kernels is None:
        return reference.density_slopes(q, table, resolutions, [(w1, b1), (w2, b2)])
    out = torch.empty_like(q, memory_format=torch.contiguous_format)
    if kernels is cpu:
        q_array, w1_array, out_array = dispatch.kernel_arrays(q, w1, out)
        cpu.density_slopes(q_array, _cpu_net(net), w1_array, out_array)
    else:
        q_array, out_array = dispatch.kernel_arrays(q, out)
        kernels.density_slopes(q_array, dispatch.kernel_arrays(*net), out_array)
    return out


@torch.no_grad()
def positions(
    rays: tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]],
    offsets: Int[Tensor, "n+1"],
    t: Float[Tensor, "s"],
) -> Float[Tensor, "s 3"]:
    """Return the unit-cube coordinates (`reference.contract`) of packed samples on rays."""
    kernels = dispatch.kernels("marching", *rays, offsets, t)
    if kernels is None:
        o, d = (torch.repeat_interleave(each, offsets.diff(), dim=0) for each in rays)
        return reference.contract(o + t[:, None] * d)
    u = t.new_zeros(t.shape[0], 3)
    kernels.grid_positions(*dispatch.kernel_arrays(*rays, offsets, t, u))
    return u


def cells_of(occupied: UInt8[Tensor, "k g g g"]) -> Cells:
    """Return an occupancy as `march` reads it: its cells, and which blocks of 8³ cells hold one.

    On a CPU the cells are bits, 4³ of them in a word, so that they stay in the inner caches. Where
    the side is no multiple of 32, blocks would reach into the cube of the next finer cascade; then
    a block is one cell.
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
    cpu.pack_cells(*dispatch.kernel_arrays(occupied, words))
    if whole:
        cpu.occupied_blocks(*dispatch.kernel_arrays(words, blocks))
    return words, blocks


@torch.no_grad()
def march(
    rays: tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]],
    spans: Float[Tensor, "n 3"],
    cells: Cells,
    steps: tuple[float, float, float],
    stop: float,
    net: Net,
    capacity: int | None = None,
) -> tuple[Int[Tensor, "n+1"], Float[Tensor, "3 s"]]:
    """Return the samples of rays in occupied space, packed: `reference.march` for each ray.

    Args:
        rays: origins and unit directions.
        spans: first and last length of each ray, jitter: the fraction of the first step to skip.
        cells: the occupied cells, by `cells_of`.
        steps: smallest step, step per length, optical depth below which a sample counts as empty.
        stop: transmittance at which a ray ends.
        net: encoding and network of the density.
        capacity: length of the list of samples. It is padded with zeros, at least one; samples
            beyond it are dropped. None: as long as needed, which synchronises with a GPU.

    Returns:
        Offsets; t, dt (grid units) and sigma (1/grid unit) of the samples.

    Raises:
        TypeError: the tensors are not float32 on one device, a CPU or an NVIDIA GPU.
    """
    kernels = dispatch.kernels("marching", *rays, *net)
    if kernels is None:
        raise TypeError("rays and field must be float32 and on one device, a CPU or an NVIDIA GPU")
    chunk = CPU_RAYS if kernels is cpu else GPU_RAYS
    arrays = _cpu_net(net) if kernels is cpu else dispatch.kernel_arrays(*net)
    occupied = dispatch.kernel_arrays(*cells)
    # Shared by all chunks: fresh memory for each would cost more than marching.
    scratch = dispatch.kernel_array(_scratch(rays[0], chunk, kernels is cpu))
    parts, ends = [], [spans.new_zeros(1, dtype=torch.long)]
    out = None if capacity is None else spans.new_zeros(3, capacity)
    for o, d, span in zip(*(x.split(chunk) for x in (*rays, spans)), strict=True):
        count = o.new_zeros(o.shape[0], dtype=torch.long)
        o_array, d_array, span_array, count_array = dispatch.kernel_arrays(o, d, span, count)
        kernels.march(
            o_array, d_array, span_array, occupied, steps, stop, arrays, scratch, count_array
        )
        start, chunk_ends = ends[-1][-1:], count.cumsum(0)
        if out is None:
            part = o.new_empty(3, int(count.sum()))
            kernels.pack(scratch, *dispatch.kernel_arrays(torch.cat([ends[0], chunk_ends]), part))
            parts.append(part)
            ends.append(start + chunk_ends)
        else:
            ends.append((start + chunk_ends).clamp_max(out.shape[1] - 1))
            kernels.pack(scratch, *dispatch.kernel_arrays(torch.cat([start, ends[-1]]), out))
    return torch.cat(ends), torch.cat(parts, dim=1) if out is None else out


def _scratch(rays_o: Tensor, chunk: int, by_block: bool) -> Tensor:
    """Return memory for the samples of a chunk of rays: by blocks of rays, or a column a ray."""
    n = min(chunk, max(rays_o.shape[0], 1))
    if by_block:
        return rays_o.new_empty(3, -(-n // cpu.RAY_BLOCK), cpu.RAY_BLOCK * MAX_RAY_SAMPLES)
    return rays_o.new_empty(3, MAX_RAY_SAMPLES, n)
