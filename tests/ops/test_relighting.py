"""Kernels of sunlight on samples, beside their slow twins in float64."""

import numpy as np
import pytest
import torch

from climatenerf.ops import relighting
from climatenerf.weather.light.reference_albedo import CHOICES


def double(*tensors):
    return tuple(t.double() if t.is_floating_point() else t for t in tensors)


def test_visibility_equals_its_twin():
    rng = np.random.default_rng(0)
    first = rng.uniform(-3, 3, (2, 9, 9, 1))
    depths = np.concatenate([first, first + rng.exponential(1.0, first.shape)], axis=-1)
    depths[rng.random(first.shape[:3]) < 0.3] = np.inf  # nothing in the sun's way
    depths[rng.random(first.shape[:3]) < 0.1, 1] = np.inf  # leaves that let half of it pass
    depths = torch.from_numpy(depths.astype(np.float32))
    at = torch.from_numpy(rng.uniform(-9, 9, (2000, 3)).astype(np.float32))
    half, bias = (2.0, 8.0), (0.1, 0.3)
    fast = relighting.visibility(depths, half, bias, at)
    slow = relighting.visibility(depths.double(), half, bias, at.double())
    torch.testing.assert_close(fast, slow.float(), rtol=1e-3, atol=1e-4)
    assert 0.1 < float(fast.mean()) < 0.9
    beyond = (at[:, :2].abs() > 8).any(-1)
    assert bool(beyond.any()) and bool((fast[beyond] == 1).all())


def test_leaves_let_half_of_the_light_pass():
    """3/4 passes above the ground, 1/4 only at the ground: a crown that takes half."""
    depths = torch.tensor([-5.0, 0.0]).expand(1, 2, 2, 2).contiguous()
    at = torch.tensor([[0.0, 0.0, z] for z in (-6.0, -4.0, -0.1, 1.0)])
    found = relighting.visibility(depths, (1.0,), (0.2,), at)
    torch.testing.assert_close(found, torch.tensor([1.0, 0.5, 0.5, 0.0]))


def test_interpolation_equals_its_twin_and_a_linear_function():
    rng = np.random.default_rng(1)
    grids = torch.from_numpy(rng.normal(size=(3, 4, 5, 6)).astype(np.float32))
    origin = torch.tensor([1.0, -2.0, 0.5])
    x = torch.from_numpy(rng.uniform(-6, 16, (1000, 3)).astype(np.float32))
    kind = torch.from_numpy(rng.integers(0, 3, 1000))
    fast = relighting.interpolated(grids, origin, 2.0, x, kind)
    slow = relighting.interpolated(grids.double(), origin.double(), 2.0, x.double(), kind)
    torch.testing.assert_close(fast, slow.float(), rtol=1e-4, atol=1e-4)
    ramp = torch.arange(6.0).expand(1, 4, 1, 6).contiguous()
    found = relighting.interpolated(ramp, origin, 2.0, x, torch.zeros(1000, dtype=torch.long))
    torch.testing.assert_close(found, ((x[:, 0] - 1) / 2).clamp(0, 5), rtol=1e-4, atol=1e-4)


def test_expected_fractions_equal_their_twin():
    rng = np.random.default_rng(2)
    choices = torch.tensor(CHOICES)
    sent, shaded, sun = (torch.from_numpy(rng.uniform(0, 3, (1000, 3))).float() for _ in range(3))
    sent[:10] = 0.0
    shaded[5:15], sun[5:15] = 0.0, 0.0
    beam = torch.tensor([3.0, 4.0, 2.0])
    albedo = torch.from_numpy(rng.uniform(-2.0, 0.3, (1000, 2))).float()
    spread = torch.from_numpy(rng.uniform(0.2, 1.0, (1000, 2))).float()
    visibility = torch.from_numpy(rng.random(1000)).float()
    given = choices, sent, shaded, sun, beam, albedo, spread, visibility
    fast = relighting.expected_fractions(*given)
    slow = relighting.expected_fractions(*double(*given))
    torch.testing.assert_close(fast, slow.float(), rtol=1e-3, atol=1e-4)
    assert bool(torch.isfinite(fast).all())


def fractions(sent, shaded, sun, spread, visibility):
    """Of one sample whose usual albedo is .2 and grey, under a white sun of irradiance 4."""
    found = relighting.expected_fractions(
        torch.tensor(CHOICES),
        sent,
        shaded,
        sun,
        torch.full((3,), 4.0),
        torch.tensor([[np.log(0.2), 0.0]]).float(),
        torch.tensor([spread]),
        torch.tensor([visibility]),
    )
    return found[0].tolist()


@pytest.mark.parametrize("fraction", [0.0, 1.0])
@pytest.mark.parametrize("cue", ["brightness", "tint"])
def test_what_photos_show_outweighs_geometry(fraction, cue):
    """Irradiance is 1 in shadow and 5 in the sun, or redder in the sun; albedo is .2."""
    shaded = torch.tensor([[1.0, 1.0, 1.0 if cue == "brightness" else 4.0]])
    sun = torch.full((1, 3), 4.0)
    spread = [0.3, 5.0] if cue == "brightness" else [5.0, 0.2]
    own, facing = fractions(0.2 * (shaded + fraction * sun), shaded, sun, spread, 1 - fraction)
    assert abs(own + 0.6 * facing - fraction) < 0.25


def test_what_is_too_bright_for_shade_faces_the_sun():
    """The slope that the field has looks away from the sun, but the photo shows sunlight."""
    shaded, dark = torch.full((1, 3), 0.5), torch.zeros(1, 3)
    own, facing = fractions(0.2 * (shaded + 0.6 * 4.0), shaded, dark, [0.3, 0.3], 0.0)
    assert facing > 0.5
    own, facing = fractions(0.2 * shaded, shaded, dark, [0.3, 0.3], 0.0)
    assert facing < 0.01
