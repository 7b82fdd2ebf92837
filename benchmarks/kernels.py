"""Measure the speed of each kernel, and compare it with its eager PyTorch twin and a bound.

python benchmarks/kernels.py
python benchmarks/kernels.py --samples 131072 --repeats 7

Rates are million samples per second, forward alone and with backward. Twins that loop over rays in
Python get fewer samples and fewer repeats.

`bound` is the highest rate that the machine allows. Three limits are measured in the same run:
reads of 64 bits at random rows of one level's table, multiply-adds of a large matrix product (by
PyTorch's library), and memory traffic of the addition of two arrays. `NEEDS` states how many reads,
multiply-adds and bytes each kernel needs per sample; the slowest of the three is its bound.
"""

import argparse
from collections.abc import Callable

import common
import numpy as np
import torch
from numba import njit, prange

from climatenerf.field import activations
from climatenerf.field.hash_field import Field
from climatenerf.field.presets import PRESETS
from climatenerf.ops import compositing, encoding, marching, network, reference
from climatenerf.ops.cpu import optimiser as cpu_optimiser

SAMPLES_PER_RAY = 32

SIZE = PRESETS["cpu"]
COLOURED = 2 * SIZE.appearance_levels * SIZE.colour_hidden, 3 * SIZE.colour_hidden
DENSE = (2 * SIZE.geometry_levels + 1) * SIZE.geometry_hidden
NEEDS = {  # per sample: reads of table rows, multiply-adds, bytes
    "hash encode": (8 * SIZE.appearance_levels, 16 * SIZE.appearance_levels, 12),
    # Every row is read once forward, and read and written backward.
    "hash encode + backward": (24 * SIZE.appearance_levels, 32 * SIZE.appearance_levels, 24),
    "density": (8 * SIZE.geometry_levels, 16 * SIZE.geometry_levels + DENSE, 16),
    "march": (8 * SIZE.geometry_levels, 16 * SIZE.geometry_levels + DENSE, 12),
    "density slopes": (8 * SIZE.geometry_levels, 64 * SIZE.geometry_levels + 2 * DENSE, 24),
    "network": (0, sum(COLOURED), 108),
    # Forward; the hidden layer again; gradients of the first layer's weights and inputs, of the
    # second layer's weights, and of the hidden layer.
    "network + backward": (0, 4 * COLOURED[0] + 3 * COLOURED[1], 312),
    # Inputs are read and outputs written once, forward and backward.
    "weights + backward": (0, 0, 20),
    "accumulate + backward": (0, 0, 48),
    "surface + backward": (0, 0, 136),
    "distortion + backward": (0, 0, 28),
    "merge": (0, 0, 24),
    # Three values: 8 bytes each forward, 16 backward.
    "radiance + backward": (0, 0, 72),
}


@njit(parallel=True, fastmath=True)
def read_rows(table, index, out):
    for part in prange(out.shape[0]):
        total = np.int64(0)
        for i in range(index.shape[1]):
            total ^= table[index[part, i]]
        out[part] = total


def bounds(repeats: int, samples: int) -> dict[str, float]:
    """Measure reads of table rows, multiply-adds and bytes per second with all cores."""
    random, parts = np.random.default_rng(0), torch.get_num_threads()
    table = random.integers(0, 2**40, 2**SIZE.appearance_log2_rows)
    index = random.integers(0, table.shape[0], (parts, 2**20))
    reads = common.measure(lambda: read_rows(table, index, np.empty(parts, np.int64)), repeats)
    square = torch.rand(1024, 1024)
    products = common.measure(lambda: square @ square, repeats)
    a, b, c = torch.rand(3, samples)
    added = common.measure(lambda: [torch.add(a, b, out=c) for _ in range(100)], repeats)
    return {
        "GB/s": 100 * 12 * samples / added["median"] / 1e9,
        "Mreads/s": index.size / reads["median"] / 1e6,
        "Gmultiply-adds/s": 1024**3 / products["median"] / 1e9,
    }


def packed(n: int) -> torch.Tensor:
    return torch.arange(0, n + 1, SAMPLES_PER_RAY)


def backward(*outputs: torch.Tensor) -> None:
    torch.autograd.backward([o.sum() for o in outputs])


def jobs(n: int, fast: bool) -> dict[str, Callable[[], object]]:
    """Return each operation on n samples, by the fast kernels or by their twins."""
    torch.manual_seed(0)
    size = SIZE
    field = Field(size, 10, torch.zeros(3).numpy(), 1.0)
    table, resolutions = field.appearance_grid, field.appearance_resolutions
    table.grad_buffer = torch.zeros_like(table)  # as in the optimiser: avoids a copy
    u, offsets = torch.rand(n, 3), packed(n)
    row = torch.arange(n) // SAMPLES_PER_RAY
    x = torch.rand(2 * size.appearance_levels, n).T.requires_grad_()  # as the encoding
    shared = torch.rand(n // SAMPLES_PER_RAY, size.colour_hidden, requires_grad=True)
    layers = list(zip(field.colour_net[::2], field.colour_net[1::2], strict=True))
    geometry = list(zip(field.geometry_net[::2], field.geometry_net[1::2], strict=True))
    tau = torch.rand(n, requires_grad=True)
    values = torch.rand(3, n).T.requires_grad_()  # memory layout of networks
    t = torch.rand(n // SAMPLES_PER_RAY, SAMPLES_PER_RAY).sort(-1)[0].flatten()
    ds = torch.full((n,), 0.01)
    raw = torch.randn(9, n).T.requires_grad_()
    target = torch.nn.functional.normalize(torch.randn(n, 3), dim=-1)
    q = torch.randn(n, 3)

    radiance = activations.radiance if fast else activations.plain_radiance

    def density() -> torch.Tensor:
        if fast:
            return field.grid_density(q)
        with torch.no_grad():
            return reference.density(q, field.geometry_grid, field.geometry_resolutions, geometry)

    def march() -> torch.Tensor:
        """March rays through occupied cells until they have `SAMPLES_PER_RAY` samples."""
        if fast:
            rays = n // SAMPLES_PER_RAY
            start, end = torch.zeros(rays), torch.full((rays,), SAMPLES_PER_RAY / 256 + 1e-6)
            d = torch.nn.functional.normalize(q[:rays], dim=-1)
            samples = field.march(
                torch.zeros(rays, 3), d, start, end, stop=1e-30, pruning_threshold=0.0
            )
            assert samples.t.shape[0] in range(n, n + rays + 1)
            return samples.sigma
        cells = torch.ones(1, 4, 4, 4, dtype=torch.uint8)
        for d in torch.nn.functional.normalize(q[: n // SAMPLES_PER_RAY], dim=-1):
            reference.march(torch.zeros(3), d, (0.0, SAMPLES_PER_RAY / 256, 0.0), cells,
                            (1 / 256, 1 / 160, 0.0), 1e-30, lambda at: reference.density(
                            at, field.geometry_grid.detach(), field.geometry_resolutions,
                            [(w.detach(), b.detach()) for w, b in geometry]))  # fmt: skip
        return q

    def slopes(field: Field, q: torch.Tensor) -> torch.Tensor:
        if fast:
            return marching.density_slopes(q, field.density_net)
        layers = [(w.detach(), b.detach()) for w, b in geometry]
        grid = field.geometry_grid.detach()
        return reference.density_slopes(q, grid, field.geometry_resolutions, layers)

    encodings, networks, sums = (
        (encoding, network, compositing) if fast else (reference, reference, reference)
    )
    return {
        "hash encode": lambda: encodings.hash_encode(u, table.detach(), resolutions),
        "hash encode + backward": lambda: backward(encodings.hash_encode(u, table, resolutions)),
        "density": density,
        "march": march,
        "density slopes": lambda: slopes(field, q),
        "network": lambda: networks.mlp(x.detach(), [(w.detach(), b.detach()) for w, b in layers],
                                   shared.detach(), row),
        "network + backward": lambda: backward(networks.mlp(x, layers, shared, row)),
        "weights + backward": lambda: backward(*sums.render_weights(tau, offsets)),
        "accumulate + backward": lambda: backward(sums.accumulate(tau, values, offsets)),
        "surface + backward": lambda: backward(*sums.surface(tau.detach(), raw, target, offsets)),
        "distortion + backward": lambda: backward(sums.distortion(tau, t, ds, offsets)),
        "radiance + backward": lambda: backward(radiance(values)),
        "merge": lambda: sums.merge_order(t, offsets, t, offsets),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=2**17)
    parser.add_argument("--twin-samples", type=int, default=2**13)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    twin_samples = min(options.twin_samples, options.samples)
    fast, slow = jobs(options.samples, fast=True), jobs(twin_samples, fast=False)
    best = bounds(options.repeats, options.samples)
    rows: dict[str, dict] = {"machine": best}
    for name in fast:
        a = common.measure(fast[name], options.repeats)
        b = common.measure(slow[name], max(2, options.repeats // 2))
        rate, twin = options.samples / a["median"] / 1e6, twin_samples / b["median"] / 1e6
        rows[name] = {"Msamples/s": rate, "twin Msamples/s": twin, "times": rate / twin,
                      "seconds": a}  # fmt: skip
        if name in NEEDS:
            reads, adds, size = NEEDS[name]
            each = max(
                reads / best["Mreads/s"],
                adds / best["Gmultiply-adds/s"] / 1e3,
                size / best["GB/s"] / 1e3,
            )
            rows[name]["bound Msamples/s"] = 1 / each
            rows[name]["fraction of bound"] = rate * each
    table = torch.randn(2**22)
    gradient = torch.randn(2**22) * (torch.rand(2**22) < 0.1)
    moments = [torch.zeros(2**22).numpy() for _ in range(2)]
    scalars = tuple(map(np.float32, (0.01, 0.9, 0.99, 1e-15, 0.1, 0.01)))
    adam = common.measure(
        lambda: cpu_optimiser.adam(table.numpy(), gradient.clone().numpy(), *moments, *scalars),
        options.repeats,
    )
    rows["Adam, a tenth of the rows with gradients"] = {
        "Mentries/s": 2**22 / adam["median"] / 1e6,
        "seconds": adam,
    }
    common.report("speed of the kernels and their twins", rows, seed=0)


if __name__ == "__main__":
    main()
