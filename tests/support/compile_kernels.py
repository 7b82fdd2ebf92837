"""Compile every GPU kernel for CUDA, without a GPU, and print the names.

Triton's interpreter runs kernels as NumPy, so it accepts code that the compiler rejects.
`test_gpu_kernels.py` runs this file in a process without the interpreter. The argument is the
compute capability, such as 80 or 90.
"""

import functools
import sys
from unittest import mock

import torch
import triton
from triton.backends.compiler import GPUTarget
from triton.runtime import JITFunction

from climatenerf.core.classes import SOLID
from climatenerf.field.presets import PRESETS, FieldSize
from climatenerf.ops.triton import (
    compositing,
    encoding,
    fused_render,
    marching,
    network,
    optimiser,
    visual_hull,
)

TARGET = GPUTarget("cuda", int(sys.argv[1]) if len(sys.argv) > 1 else 80, 32)


class TargetDriver:
    """A driver that names the compilation target only."""

    def get_current_target(self):
        return TARGET

    def get_current_device(self):
        return 0

    def get_current_stream(self, device):
        return 0

    def get_active_torch_device(self):
        return torch.device("cpu")


def net(levels: int, rows: int, hidden: int, outputs: int) -> tuple[torch.Tensor, ...]:
    grid = torch.zeros(levels, 2**rows, 2), torch.full((levels,), 16)
    w1, w2 = torch.zeros(2 * levels, hidden), torch.zeros(hidden, outputs)
    return *grid, w1, torch.zeros(hidden), w2, torch.zeros(outputs)


def net_of(size: FieldSize, kind: str) -> tuple[torch.Tensor, ...]:
    """An encoding with few rows and its network, in the widths of a field of that size."""
    if kind == "geometry":
        return net(size.geometry_levels, 10, size.geometry_hidden, 1)
    if kind == "colour":
        return net(size.appearance_levels, 10, size.colour_hidden, 3)
    levels = size.surface_levels or size.appearance_levels
    return net(levels, 10, size.surface_hidden, 3 + len(SOLID))


def compile_all() -> None:
    n, s = 8, 40
    vectors, values = torch.zeros(n, 3), torch.zeros(s)
    offsets = torch.zeros(n + 1, dtype=torch.long)
    u, order = torch.zeros(s, 3), torch.zeros(s, dtype=torch.long)
    cells = torch.ones(2, 32, 32, 32, dtype=torch.uint8), torch.ones(2, 4, 4, 4, dtype=torch.uint8)
    density = net_of(PRESETS["gpu"], "geometry")
    steps, buffers = (1 / 256, 1 / 160, 1e-3), torch.zeros(3, 1024, n)
    table, resolutions = density[:2]
    features = torch.zeros(24, s)
    encoding.hash_encode(u, table, resolutions, features)
    encoding.hash_encode_backward(u, features, resolutions, table)
    encoding.hash_encode_slopes(u, features, table, resolutions, u)
    one = cells[0][:1, :12, :12, :12].contiguous()  # a single cascade without blocks
    marching.march(
        vectors, vectors, vectors, (one, one), steps, 1e-3, density, buffers, offsets[1:]
    )
    marching.pack(buffers, offsets, torch.zeros(3, s))
    marching.grid_positions(vectors, vectors, offsets, values, u)
    compositing.weights_forward(values, offsets, values, vectors[:, 0])
    compositing.weights_backward(values, offsets, values, vectors[:, 0], values)
    compositing.accumulate_forward(values, u, offsets, vectors)
    compositing.accumulate_backward(values, u, offsets, vectors, values, u)
    compositing.distortion_forward(values, values, values, offsets, vectors[:, 0])
    compositing.distortion_backward(values, values, values, offsets, vectors[:, 0], values)
    compositing.merge_order(values, offsets, values, offsets, offsets, order)
    maps, pair = torch.zeros(s, dtype=torch.uint8), torch.zeros(2, dtype=torch.long)
    views = maps, pair, torch.zeros(2, 2, dtype=torch.long), torch.zeros(2, 4), torch.zeros(2, 4, 4)
    for count in (views, tuple(each[:1] for each in views)):
        visual_hull.label_votes(u, values, count, (1, 0.1, 0.5), maps)
    optimiser.adam(values, values, values, values, 0.1, 0.9, 0.99, 1e-15, 1.0, 1.0)
    for size in PRESETS.values():  # widths are compile-time constants
        rays = torch.zeros(n, size.colour_hidden), order
        for kind, shared in (("geometry", None), ("colour", rays), ("surface", None)):
            layers = net_of(size, kind)
            out = torch.zeros(s, layers[-1].shape[0])
            network.network_forward(u, layers[:2], layers[2:], shared, out)
            grads = layers[0], None if shared is None else shared[0], u if shared is None else None
            network.network_backward(u, layers[:2], layers[2:], shared, out, grads)
        density, colour = net_of(size, "geometry"), net_of(size, "colour")
        marching.density_at(u, density, values)
        marching.march(vectors, vectors, vectors, cells, steps, 1e-3, density, buffers, offsets[1:])
        marching.density_slopes(u, density, u)
        fused_render.composite((vectors, vectors), vectors, cells, steps, (1e-3, 1e-4), density,
                               colour, rays[0], torch.zeros(n, 5))  # fmt: skip


def main() -> None:
    triton.runtime.driver.set_active(TargetDriver())
    run = JITFunction.run

    @functools.wraps(run)
    def compiled(self, *args, warmup, **kwargs):
        kernel = run(self, *args, warmup=True, **kwargs)
        assert ".entry" in kernel.asm["ptx"] and kernel.asm["cubin"]
        print(self.fn.__name__)
        return kernel

    with mock.patch.object(JITFunction, "run", compiled):
        compile_all()


if __name__ == "__main__":
    main()
