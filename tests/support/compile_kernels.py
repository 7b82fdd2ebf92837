"""Compiles every GPU kernel for CUDA, without a GPU: prints its name, or fails.

The interpreter runs kernels as NumPy; what Triton's compiler refuses shows here alone. Run in a
process of its own, by `test_gpu_kernels.py`: it must not be in the interpreter. An argument is the
card's compute capability, such as 80 or 90.
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

CARD = GPUTarget("cuda", int(sys.argv[1]) if len(sys.argv) > 1 else 80, 32)


class NoCard:
    """A driver that knows for which card to compile."""

    def get_current_target(self):
        return CARD

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
    """An encoding of few rows, and the network on it, as a field of that size has them."""
    if kind == "geometry":
        return net(size.geometry_levels, 10, size.geometry_hidden, 1)
    if kind == "colour":
        return net(size.appearance_levels, 10, size.colour_hidden, 3)
    levels = size.surface_levels or size.appearance_levels
    return net(levels, 10, size.surface_hidden, 3 + len(SOLID))


def compile_all() -> None:
    n, s = 8, 40
    real, whole, some = torch.zeros(n, 3), torch.zeros(n + 1, dtype=torch.long), torch.zeros(s)
    u, order = torch.zeros(s, 3), torch.zeros(s, dtype=torch.long)
    cells = torch.ones(2, 32, 32, 32, dtype=torch.uint8), torch.ones(2, 4, 4, 4, dtype=torch.uint8)
    density = net_of(PRESETS["gpu"], "geometry")
    steps, room = (1 / 256, 1 / 160, 1e-3), torch.zeros(3, 1024, n)
    table, resolutions = density[:2]
    features = torch.zeros(24, s)
    encoding.hash_encode(u, table, resolutions, features)
    encoding.hash_encode_backward(u, features, resolutions, table)
    encoding.hash_encode_slopes(u, features, table, resolutions, u)
    one = cells[0][:1, :12, :12, :12].contiguous()  # a single cascade without blocks
    marching.march(real, real, real, (one, one), steps, 1e-3, density, room, whole[1:])
    marching.pack(room, whole, torch.zeros(3, s))
    marching.grid_positions(real, real, whole, some, u)
    compositing.weights_forward(some, whole, some, real[:, 0])
    compositing.weights_backward(some, whole, some, real[:, 0], some)
    compositing.accumulate_forward(some, u, whole, real)
    compositing.accumulate_backward(some, u, whole, real, some, u)
    compositing.distortion_forward(some, some, some, whole, real[:, 0])
    compositing.distortion_backward(some, some, some, whole, real[:, 0], some)
    compositing.merge_order(some, whole, some, whole, whole, order)
    maps, few = torch.zeros(s, dtype=torch.uint8), torch.zeros(2, dtype=torch.long)
    views = maps, few, torch.zeros(2, 2, dtype=torch.long), torch.zeros(2, 4), torch.zeros(2, 4, 4)
    for count in (views, tuple(each[:1] for each in views)):
        visual_hull.label_votes(u, some, count, (1, 0.1, 0.5), maps)
    optimiser.adam(some, some, some, some, 0.1, 0.9, 0.99, 1e-15, 1.0, 1.0)
    for size in PRESETS.values():  # their widths are constants of the kernels
        rays = torch.zeros(n, size.colour_hidden), order
        for kind, shared in (("geometry", None), ("colour", rays), ("surface", None)):
            layers = net_of(size, kind)
            out = torch.zeros(s, layers[-1].shape[0])
            network.network_forward(u, layers[:2], layers[2:], shared, out)
            grads = layers[0], None if shared is None else shared[0], u if shared is None else None
            network.network_backward(u, layers[:2], layers[2:], shared, out, grads)
        density, colour = net_of(size, "geometry"), net_of(size, "colour")
        marching.density_at(u, density, some)
        marching.march(real, real, real, cells, steps, 1e-3, density, room, whole[1:])
        marching.density_slopes(u, density, u)
        fused_render.composite((real, real), real, cells, steps, (1e-3, 1e-4), density, colour,
                             rays[0], torch.zeros(n, 5))  # fmt: skip


def main() -> None:
    triton.runtime.driver.set_active(NoCard())
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
