import numpy as np
import pytest
import torch

from climatenerf.core.colour import decode_srgb, encode_srgb, luma
from climatenerf.core.srgb import linear_colour, to_display, to_linear


def test_the_curve_has_the_values_of_the_standard():
    display = torch.tensor([0.0, 0.04045, 0.5, 1.0], dtype=torch.float64)
    linear = torch.tensor([0.0, 0.0031308, 0.2140411, 1.0], dtype=torch.float64)
    assert torch.allclose(decode_srgb(display), linear, atol=1e-6)
    assert torch.allclose(encode_srgb(linear), display, atol=1e-6)
    assert encode_srgb(torch.tensor([-0.3])) == 0 and decode_srgb(torch.tensor([-0.3])) == 0


def test_encoding_and_decoding_are_inverse():
    x = torch.linspace(0, 3, 100001, dtype=torch.float64)
    # The two branches of the standard meet within 1e-7 only.
    assert torch.allclose(encode_srgb(decode_srgb(x)), x, atol=1e-6)
    assert torch.allclose(decode_srgb(encode_srgb(x)), x, atol=1e-6)


@pytest.mark.parametrize("curve", [encode_srgb, decode_srgb])
def test_the_curve_is_continuous_and_increasing(curve):
    x = torch.linspace(0, 2, 200001, dtype=torch.float64)
    steps = curve(x).diff()
    assert (steps > 0).all()
    assert steps.max() < 1.001 * 12.92 * 1e-5  # at most the maximum slope times the step


@pytest.mark.parametrize("curve", [encode_srgb, decode_srgb])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_are_finite_and_positive_from_black_to_overexposed(curve, dtype):
    x = torch.tensor([0.0, 1e-9, 0.0031308, 0.04045, 0.5, 1.0, 5.0], dtype=dtype)
    x.requires_grad_()
    curve(x).sum().backward()
    assert torch.isfinite(x.grad).all() and (x.grad > 0).all()
    below = torch.tensor([-1.0], dtype=dtype, requires_grad=True)
    curve(below).sum().backward()
    assert torch.isfinite(below.grad).all()


@pytest.mark.parametrize("curve", [encode_srgb, decode_srgb])
def test_gradients_match_finite_differences(curve):
    x = torch.tensor([0.001, 0.003, 0.02, 0.05, 0.3, 0.9, 1.2, -0.1], dtype=torch.float64)
    x.requires_grad_()
    (slope,) = torch.autograd.grad(curve(x).sum(), x)
    with torch.no_grad():
        measured = (curve(x + 1e-7) - curve(x - 1e-7)) / 2e-7
    assert torch.allclose(slope, measured, rtol=1e-6)


@pytest.mark.parametrize("curve", [encode_srgb, decode_srgb])
def test_the_curve_is_linear_above_one_with_the_slope_at_one(curve):
    x = torch.tensor([0.99999, 1.0, 1.5, 2.0, 7.0], dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(curve(x).sum(), x)
    assert torch.allclose(slope[1:], slope[4].expand(4), atol=1e-12)
    assert abs(slope[0] - slope[4]) < 1e-4


def test_arrays_and_tensors_use_the_same_curve():
    x = np.linspace(0.0, 1.0, 1001)
    tensor = torch.from_numpy(x)
    assert np.allclose(to_linear(x), decode_srgb(tensor).numpy(), rtol=1e-12, atol=0)
    assert np.allclose(to_display(x), encode_srgb(tensor).numpy(), rtol=1e-12, atol=1e-15)
    assert np.allclose(to_display(np.array([-0.5, 1.5])), [0.0, 1.0], atol=1e-15)
    for colour in x[:999].reshape(-1, 3):
        assert np.allclose(linear_colour(tuple(colour)), to_linear(colour), rtol=1e-12, atol=0)


def test_luma_of_white_is_one():
    assert torch.allclose(luma(torch.ones(2, 3)), torch.ones(2))
    assert luma(torch.tensor([[0.0, 1.0, 0.0]])) > luma(torch.tensor([[1.0, 0.0, 0.0]]))
