"""Element-wise functions against PyTorch in double precision."""

import numpy as np
import pytest
import torch

from climatenerf.field.activations import (
    density_from_raw,
    plain_density_from_raw,
    plain_radiance,
    radiance,
)
from climatenerf.field.spherical_harmonics import harmonics, spherical_harmonics
from climatenerf.ops.cpu import activations as cpu_pointwise

# All branches of the curve: black, end of the toe (raw -0.620), white (0.5), very large and small.
RAW = torch.cat(
    [
        torch.linspace(-12, 8, 5000),
        torch.linspace(-0.63, -0.61, 999),
        torch.linspace(0.49, 0.51, 999),
        torch.tensor([60.0, -1.0, 0.5, -1e4]),
    ]
)
RAW = RAW[: RAW.shape[0] // 3 * 3].view(-1, 3)


@pytest.mark.parametrize("rows", [True, False])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_radiance_matches_the_twin(rows, sign):
    raw = (RAW.T.contiguous().T if rows else RAW).clone(memory_format=torch.preserve_format)
    ours, twin = raw.requires_grad_(), raw.detach().double().requires_grad_()
    found, expected = radiance(ours), plain_radiance(twin)
    assert torch.allclose(found.double(), expected, rtol=1e-5, atol=1e-30)
    (grad,) = torch.autograd.grad(sign * found.sum(), ours)
    (goal,) = torch.autograd.grad(sign * expected.sum(), twin)
    # At the kinks of the curve both one-sided slopes are valid.
    smooth = ((raw + 1.0).abs() > 1e-6) & ((raw + 0.6203).abs() > 1e-3) & ((raw - 0.5).abs() > 1e-5)
    assert torch.isfinite(grad).all() and (grad * sign >= 0).all()
    assert torch.allclose(grad.double()[smooth], goal[smooth], rtol=1e-4, atol=1e-12)
    assert (grad != 0).any()


def test_radiance_increases_and_is_zero_for_very_negative_input():
    raw = torch.linspace(-20, 20, 100_002).view(-1, 3)
    found = radiance(raw).detach().reshape(-1)
    assert (found.diff() >= -1e-6 * found[1:]).all() and found[0] < 1e-9
    assert float(radiance(torch.tensor([[0.5, 0.5, 0.5]]))[0, 0]) == pytest.approx(1.0, abs=1e-2)


def test_density_from_raw_matches_the_twin():
    generator = torch.Generator().manual_seed(0)
    u = torch.rand(4000, 3, generator=generator)
    u[:100] = 0.5 + 0.2 * (u[:100] - 0.5)  # in the core, where the contraction is the identity
    raw = torch.linspace(-60, 20, 4000)[torch.randperm(4000, generator=generator)]
    ours, twin = raw.clone().requires_grad_(), raw.double().requires_grad_()
    found = density_from_raw(ours, u)
    expected = plain_density_from_raw(twin, u.double())
    # Near the outermost shell 2 - |u| loses precision in 32 bits.
    assert torch.allclose(found.double(), expected, rtol=4e-3)
    inner = (4 * u - 2).norm(dim=-1) < 1.9
    assert torch.allclose(found.double()[inner], expected[inner], rtol=2e-5)
    (grad,) = torch.autograd.grad(found.sum(), ours)
    (goal,) = torch.autograd.grad(expected.sum(), twin)
    assert torch.allclose(grad.double()[inner], goal[inner], rtol=2e-5)
    assert (grad[raw > cpu_pointwise.MAX_RAW] == 0).all() and (grad[raw < 15] > 0).all()


def test_density_has_gradients_to_positions():
    u = torch.full((3, 3), 0.75, requires_grad=True)
    raw = torch.zeros(3, requires_grad=True)
    density_from_raw(raw, u).sum().backward()
    assert u.grad is not None and (u.grad < 0).all(), "density decreases outwards"


def test_harmonics_match_the_twin():
    generator = torch.Generator().manual_seed(0)
    d = torch.nn.functional.normalize(torch.randn(3000, 3, generator=generator), dim=-1)
    assert torch.allclose(harmonics(d), spherical_harmonics(d.double()).float(), atol=1e-6)
    d.requires_grad_()
    (grad,) = torch.autograd.grad(harmonics(d).square().sum(), d)
    assert torch.isfinite(grad).all() and (grad != 0).any()


def test_exp2_and_log2_are_accurate_over_the_float_range():
    from numba import njit

    @njit(fastmath=True)
    def both(x, powers, logarithms):
        for i in range(x.shape[0]):
            powers[i] = cpu_pointwise._exp2(x[i])
            logarithms[i] = cpu_pointwise._log2(np.float32(2.0) ** x[i])

    x = np.linspace(-125, 125, 10_001, dtype=np.float32)
    powers, logarithms = np.empty_like(x), np.empty_like(x)
    both(x, powers, logarithms)
    assert np.allclose(powers, np.exp2(x.astype(np.float64)), rtol=1e-6)
    assert np.allclose(logarithms, x, atol=1e-5)


def test_nan_is_propagated():
    raw = torch.linspace(-2, 2, 300).view(100, 3).clone()
    raw[7, 1] = raw[50] = torch.nan
    assert torch.equal(radiance(raw).isnan(), raw.isnan())
    assert torch.equal(density_from_raw(raw[:, 1], torch.rand(100, 3)).isnan(), raw[:, 1].isnan())
