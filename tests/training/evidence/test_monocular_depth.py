"""Alignment of relative depth: recovered scale and shift, gradients, and degenerate input."""

import numpy as np
import pytest
import torch

from climatenerf.training.dataset import in_units
from climatenerf.training.evidence.monocular_depth import DepthAlignment


def rays(n=4000, images=3, seed=0):
    generator = torch.Generator().manual_seed(seed)
    image = torch.randint(images, (n,), generator=generator)
    return image, 0.1 + torch.rand(n, generator=generator)


SCALE, SHIFT = torch.tensor([2.0, 0.5, 30.0]), torch.tensor([-1.0, 4.0, 0.1])


def test_scale_and_shift_of_each_image_are_recovered():
    image, inverse = rays()
    relative = DepthAlignment(3)
    loss = relative.loss(inverse, SCALE[image] * inverse + SHIFT[image], image, inverse > 0)
    scale, shift, variance = relative.scale_and_shift()
    assert torch.allclose(scale, SCALE, rtol=1e-3) and torch.allclose(shift, SHIFT, atol=1e-2)
    assert (variance > 0).all() and loss < 1e-6


def test_loss_is_invariant_to_scale_and_shift():
    image, inverse = rays()
    distorted = inverse + 0.1 * torch.sin(20 * inverse)
    first = DepthAlignment(3).loss(inverse, distorted, image, inverse > 0)
    second = DepthAlignment(3).loss(
        inverse, SCALE[image] * distorted + SHIFT[image], image, inverse > 0
    )
    assert first == pytest.approx(float(second), rel=1e-3) and first > 1e-3


def test_gradient_descent_reduces_a_wrong_depth():
    image, inverse = rays()
    given = inverse.clone()
    given[0] += 0.3  # too near
    given.requires_grad_()
    DepthAlignment(3).loss(
        given, SCALE[image] * inverse + SHIFT[image], image, inverse > 0
    ).backward()
    assert given.grad is not None and torch.isfinite(given.grad).all()
    assert given.grad[0] > 0 and given.grad[0] > 10 * given.grad[1:].abs().median()


def test_unusable_or_inverted_depth_gives_no_loss():
    image, inverse = rays()
    relative = DepthAlignment(3)
    distorted = inverse + 0.1 * torch.sin(20 * inverse)
    assert relative.loss(inverse, -distorted, image, inverse > 0) == 0  # inverted depth order
    assert DepthAlignment(3).loss(inverse, distorted, image, inverse > 0) > 0
    none = torch.zeros(len(image), dtype=torch.bool)
    assert relative.loss(inverse, inverse, image, none) == 0
    few = torch.arange(len(image)) < 10
    assert DepthAlignment(3).loss(inverse, inverse, image, few) == 0
    flat = DepthAlignment(3).loss(inverse, torch.ones_like(inverse), image, inverse > 0)
    assert flat == 0 and torch.isfinite(flat)


def test_sums_accumulate_over_steps_with_few_rays():
    image, inverse = rays(60)
    relative = DepthAlignment(3)
    for seed in range(5):
        image, inverse = rays(60, seed=seed)
        relative.loss(inverse, SCALE[image] * inverse + SHIFT[image], image, inverse > 0)
    assert (relative.scale_and_shift()[2] > 0).all()


def test_relative_depth_is_scaled_to_fit_half_floats():
    disparity = np.array([[1.0, 2.0], [60_000.0, np.nan]]) * 100
    kept = in_units(disparity).astype(np.float16)
    assert kept[1, 0] == 1 and kept[0, 1] == pytest.approx(2 * kept[0, 0], rel=1e-2)
    assert np.isnan(kept[1, 1])
    assert (in_units(np.zeros((2, 2))) == 0).all()
    assert in_units(np.array([[np.inf, 0.5]])).tolist() == [[np.inf, 1.0]]
