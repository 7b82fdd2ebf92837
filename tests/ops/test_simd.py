"""SIMD intrinsics against NumPy, and density slopes against autograd."""

import copy
import hashlib
import os
import platform
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from numba import njit

from climatenerf.core.vectors import length, unit
from climatenerf.field.occupancy import Occupancy
from climatenerf.ops import encoding, marching, optimiser, reference
from climatenerf.ops.cpu import encoding as cpu_encoding
from climatenerf.ops.cpu import marching as cpu_marching
from climatenerf.ops.cpu import metaballs, simd, simd_metaballs
from climatenerf.ops.cpu import network as cpu_network
from climatenerf.ops.cpu import optimiser as cpu_optimiser
from climatenerf.ops.cpu.simd import LANES


@njit
def product(weight, rows, out, count):
    simd.add_product(weight, rows, out, count)


@njit
def outer(left, right, out, count):
    simd.add_outer(left, right, out, count)


@njit
def density_network(features, w1, b1, w2, b2, out):
    simd.network(features, w1, b1, w2, b2, out)


def test_kernels_contain_the_digest_of_the_simd_modules():
    """Numba's cache depends on the kernel's own file only, so the file contains a digest."""
    base, balls = (Path(each.__file__).read_bytes() for each in (simd, simd_metaballs))
    for module in (cpu_encoding, cpu_marching, cpu_network, cpu_optimiser, metaballs):
        text = base + balls if module is metaballs else base
        digest = hashlib.sha256(text).hexdigest()[:12]
        assert digest == module.SIMD_DIGEST, f'write "{digest}" into {Path(module.__file__).name}'


@pytest.mark.parametrize(("m", "k", "vectors"), [(64, 24, 8), (3, 7, 3), (1, 32, 1), (5, 1, 2)])
def test_block_products_match_numpy(m, k, vectors):
    """Remainders of rows and vectors are computed, and nothing beyond them is written."""
    random = np.random.default_rng(0)
    weight = random.standard_normal((m, k)).astype(np.float32)
    rows = random.standard_normal((k + 1, (vectors + 1) * LANES)).astype(np.float32)
    out = random.standard_normal((m + 1, (vectors + 2) * LANES)).astype(np.float32)
    expected, end = out.copy(), vectors * LANES
    expected[:m, :end] += weight @ rows[:k, :end]
    product(weight, rows, out, vectors)
    assert np.allclose(out, expected, atol=1e-4)
    left = random.standard_normal((m, (vectors + 1) * LANES)).astype(np.float32)
    sums = random.standard_normal((m, k + 1)).astype(np.float32)
    expected = sums + left[:, :end] @ rows[:, :end].T
    outer(left, rows, sums, vectors)
    assert np.allclose(sums, expected, atol=1e-3)


@pytest.mark.parametrize("hidden", [32, 6])
def test_the_density_network_matches_numpy(hidden):
    random = np.random.default_rng(1)
    features = random.standard_normal((10, LANES)).astype(np.float32)
    w1 = random.standard_normal((hidden, 10)).astype(np.float32)
    b1, w2 = (random.standard_normal(s).astype(np.float32) for s in (hidden, (1, hidden)))
    out = np.zeros((1, LANES), np.float32)
    density_network(features, w1, b1, w2, np.float32(0.7), out)
    expected = w2 @ np.maximum(w1 @ features + b1[:, None], 0) + 0.7
    assert np.allclose(out, expected, atol=1e-4)


def test_density_slopes_match_autograd():
    """Inside the core, in the shell and at the middle; the last vector is not full."""
    generator = torch.Generator().manual_seed(2)
    table = torch.rand(4, 512, 2, generator=generator) - 0.5
    resolutions = torch.tensor([4, 7, 16, 40])
    w1, w2 = (torch.randn(shape, generator=generator) * 0.4 for shape in ((8, 18), (18, 1)))
    b1, b2 = torch.randn(18, generator=generator) * 0.2, torch.zeros(1)
    q = torch.randn(301, 3, generator=generator)
    q[0] = 0.0
    assert (q.norm(dim=-1) < 1).sum() > 20 and (q.norm(dim=-1) > 1.5).sum() > 20
    found = marching.density_slopes(q, (table, resolutions, w1, b1, w2, b2))
    layers = [(w1.double(), b1.double()), (w2.double(), b2.double())]
    expected = reference.density_slopes(q.double(), table.double(), resolutions, layers)
    error = (found - expected).norm(dim=-1) / expected.norm(dim=-1).clamp_min(1e-3)
    # At a kink (a hidden unit at zero, a cell face) rounding selects the side.
    assert (error > 1e-3).sum() <= 2, error.topk(4)
    assert torch.isfinite(found).all()


def test_encoding_does_not_depend_on_the_number_of_points():
    """Several blocks, the last one shorter, and no points."""
    generator = torch.Generator().manual_seed(5)
    table = torch.rand(3, 512, 2, generator=generator) - 0.5
    resolutions = torch.tensor([4, 16, 40])
    u = torch.rand(2 * cpu_encoding.MAX_BLOCK + 37, 3, generator=generator)
    out = encoding.hash_encode(u, table, resolutions)
    parts = [encoding.hash_encode(part, table, resolutions) for part in u.split(1000)]
    assert torch.allclose(out, torch.cat(parts), atol=1e-6)
    assert encoding.hash_encode(u[:0], table, resolutions).shape == (0, 6)


def test_nan_positions_do_not_read_outside_the_table():
    """The result is undefined, but the index is clamped: reading beyond the table would crash."""
    table, resolutions = torch.ones(2, 512, 2), torch.tensor([4, 40])
    u = torch.full((20, 3), torch.nan)
    assert encoding.hash_encode(u, table, resolutions).shape == (20, 4)


def test_density_slopes_in_double_precision_and_of_no_points():
    generator = torch.Generator().manual_seed(6)
    table, resolutions = torch.rand(2, 512, 2, generator=generator), torch.tensor([4, 16])
    w1, w2 = (torch.randn(shape, generator=generator) for shape in ((4, 8), (8, 1)))
    net = (table, resolutions, w1, torch.zeros(8), w2, torch.zeros(1))
    q = torch.randn(9, 3, generator=generator)
    wide = tuple(each.double() if each.is_floating_point() else each for each in net)
    twin = marching.density_slopes(q.double(), wide)
    assert twin.dtype == torch.float64
    assert torch.allclose(marching.density_slopes(q, net).double(), twin, atol=1e-3)
    assert marching.density_slopes(q[:0], net).shape == (0, 3)


@pytest.mark.parametrize("side", [32, 8, 6])
def test_each_cell_is_one_bit_of_a_word(side):
    generator = torch.Generator().manual_seed(3)
    occupied = (torch.rand(2, side, side, side, generator=generator) < 0.3).to(torch.uint8)
    words, blocks = marching.cells_of(occupied)
    k, x, y, z = np.indices(occupied.shape)
    word = words.numpy()[k, x >> 2, y >> 2, z >> 2].view(np.uint64)
    bit = ((x & 3) | (y & 3) << 2 | (z & 3) << 4).astype(np.uint64)
    assert np.array_equal((word >> bit & np.uint64(1)).astype(np.uint8), occupied.numpy())
    assert blocks.shape[1] == (side // 8 if side == 32 else side)


def test_cells_are_repacked_when_they_change():
    """Cells written in place, replaced, and changed in a copy."""
    occupancy = Occupancy(cascades=2, side=32)
    assert (occupancy.cells()[0] == -1).all()
    same = occupancy.cells()
    assert occupancy.cells()[0] is same[0]
    occupancy.occupied.view(-1)[:] = 0
    assert (occupancy.cells()[0] == 0).all()
    occupancy.occupied = torch.ones_like(occupancy.occupied)
    assert (occupancy.cells()[0] == -1).all()
    twin = copy.deepcopy(occupancy)
    assert twin.packed is None, "a copy has a version counter of its own"
    twin.occupied.zero_()
    assert (twin.cells()[0] == 0).all() and (occupancy.cells()[0] == -1).all()
    with torch.inference_mode():
        occupancy.occupied = torch.zeros_like(occupancy.occupied)
        assert (occupancy.cells()[0] == 0).all()


def test_adam_skips_entries_without_gradient():
    """Compare with PyTorch's Adam, with vectors of no, some and only non-zero gradients."""
    n = 4096 + 3 * LANES + 5
    values, gradients = torch.randn(n), torch.randn(2, n)
    gradients[:, LANES : 2 * LANES] = 0.0
    gradients[:, ::3] = 0.0
    gradients[1, 1::3] = 0.0  # changed by the first step only
    first, second = torch.zeros(n), torch.zeros(n)
    other = torch.nn.Parameter(values.clone())
    adam = torch.optim.Adam([other], lr=0.1, betas=(0.9, 0.99), eps=1e-15)
    for step, gradient in enumerate(gradients, start=1):
        before = values.clone(), first.clone(), second.clone()
        other.grad = gradient.clone()
        adam.step()
        moved = gradient != 0
        optimiser.adam(values, gradient.clone(), (first, second), 0.1, (0.9, 0.99), 1e-15, step)
        assert torch.allclose(values[moved], other[moved], atol=1e-6) and moved.sum() > n // 4
        for now, then in zip((values, first, second), before, strict=True):
            assert torch.equal(now[~moved], then[~moved])
    cleared = gradients[0].clone()
    optimiser.adam(values, cleared, (first, second), 0.1, (0.9, 0.99), 1e-15, 3)
    assert (cleared == 0).all()


def test_lengths_and_unit_vectors_have_finite_gradients():
    v = torch.randn(20, 3, dtype=torch.float64, requires_grad=True)
    assert torch.allclose(length(v), v.norm(dim=-1))
    assert torch.allclose(unit(v), torch.nn.functional.normalize(v, dim=-1))
    assert torch.autograd.gradcheck(unit, v)
    zero = torch.zeros(2, 3, requires_grad=True)
    (length(zero).sum() + unit(zero, 1e-6).sum()).backward()
    assert zero.grad is not None and torch.isfinite(zero.grad).all()
    assert (unit(zero) == 0).all()


WIDTH = """
import numpy as np
from numba import njit
from climatenerf.ops.cpu import simd

@njit
def product(weight, rows, out, count):
    simd.add_product(weight, rows, out, count)

product(np.ones((4, 2), np.float32), np.ones((2, 32), np.float32), np.ones((4, 32), np.float32), 2)
(text,) = product.inspect_asm().values()
print(next(width for width in ("zmm", "ymm", "xmm") if width in text))
"""


@pytest.mark.slow
@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="names of x86 processors")
@pytest.mark.parametrize(("processor", "widest"), [("haswell", "ymm"), ("x86-64", "xmm")])
def test_kernels_match_the_twins_on_processors_with_shorter_vectors(processor, widest, tmp_path):
    """Compile all kernels for AVX2 and for the x86-64 baseline, and compare with the twins."""
    environment = {
        **os.environ,
        "NUMBA_CPU_NAME": processor,
        "NUMBA_CPU_FEATURES": "",
        "NUMBA_CACHE_DIR": str(tmp_path),
    }
    options = {"env": environment, "capture_output": True, "text": True}
    done = subprocess.run([sys.executable, "-c", WIDTH], **options)
    assert done.stdout.strip() == widest, done.stderr[-2000:]
    names = ("test_kernels.py", "test_simd.py", "test_metaballs.py")
    files = [str(Path(__file__).with_name(name)) for name in names]
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *files]
    done = subprocess.run(command, **options)
    assert done.returncode == 0, done.stdout[-3000:]
