"""Rays against a height field: the kernel, the twin on any device, the slow reference, a plane."""

import math

import pytest
import torch
from scipy import ndimage

from climatenerf.ops import heightfield
from climatenerf.ops import heightfield_reference as reference

SIDE = 24
"""Nodes along each side of the random surfaces."""


def kernel(height, o, d, span):
    return heightfield.first_crossing(height, o, d, span)


def twin(height, o, d, span):
    """What runs on devices without a kernel."""
    slope = heightfield.steepest_slope(height)
    return heightfield._first_crossing(height, o, d, span, slope)


FAST = pytest.mark.parametrize("cross", [kernel, twin])


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(5)


def surface(generator, roughness=6.0):
    """Random heights, smooth over about two cells, in cells."""
    values = torch.randn(SIDE, SIDE, generator=generator).numpy()
    return torch.from_numpy(ndimage.gaussian_filter(values, 1.5) * roughness)


def normalised(d):
    return torch.nn.functional.normalize(d, dim=-1)


def endless(n, begin=0.0):
    return torch.tensor([begin, math.inf]).repeat(n, 1)


def anywhere(generator, n, low, high):
    """Positions above or below the raster, in cells."""
    at = torch.rand(n, 3, generator=generator)
    return at * torch.tensor([SIDE - 1.0, SIDE - 1.0, high - low]) + torch.tensor([0.0, 0.0, low])


def rays(kind, height, generator, n=60):
    """Origins and unit directions in cells."""
    d = normalised(torch.randn(n, 3, generator=generator))
    o = anywhere(generator, n, float(height.max()) + 0.5, float(height.max()) + 6)
    if kind == "downwards":
        d[:, 2] = -d[:, 2].abs()
    elif kind == "under the ground":
        o = anywhere(generator, n, float(height.min()) - 4, float(height.min()) - 0.5)
    elif kind == "among the hills":
        o = anywhere(generator, n, float(height.min()), float(height.max()))
        d[:, 2] *= 0.3
    elif kind == "level":
        o = anywhere(generator, n, float(height.min()), float(height.max()))
        d[:, 2] = 0.0
    elif kind == "vertical":
        d = torch.tensor([0.0, 0.0, -1.0]).repeat(n, 1)
        d[::2, 2] = 1.0
    elif kind == "along an axis":
        d[:, 2] = -d[:, 2].abs() * 0.2
        d[::2, 0] = 0.0
        d[1::2, 1] = 0.0
    elif kind == "outside":
        o[:, :2] = o[:, :2] * 3 - SIDE
        d[:, 2] = -d[:, 2].abs() * 0.5
    elif kind == "grazing":
        o = anywhere(generator, n, float(height.max()) + 0.1, float(height.max()) + 0.6)
        d[:, 2] = -0.1 - 0.2 * torch.rand(n, generator=generator)
    return o, normalised(d)


KINDS = ["downwards", "under the ground", "among the hills", "level", "vertical",
         "along an axis", "outside", "grazing"]  # fmt: skip


@FAST
@pytest.mark.parametrize("kind", KINDS)
def test_crossings_match_the_reference(cross, kind, generator):
    height = surface(generator)
    o, d = rays(kind, height, generator)
    found, expected = cross(height, o, d, endless(len(o))), torch.empty(len(o))
    expected = reference.first_crossing(height.double(), o.double(), d.double(), endless(len(o)))
    met = found.isfinite()
    if kind in ("downwards", "grazing", "along an axis", "among the hills", "level"):
        assert expected.isfinite().float().mean() > 0.1, "the test has crossings"
    # A ray that dips under the ground by less than the reference's step meets it in one of them.
    agree = met == expected.isfinite()
    agree[met & agree] &= (found - expected)[met & agree].abs() < 0.05
    assert (~agree).sum() <= 1, (o[~agree], d[~agree], found[~agree], expected[~agree])


def test_the_kernel_equals_its_twin(generator):
    height = surface(generator)
    for kind in KINDS:
        o, d = rays(kind, height, generator, 400)
        first, second = (cross(height, o, d, endless(400)) for cross in (kernel, twin))
        met = first.isfinite()
        assert (met != second.isfinite()).sum() <= 1, kind
        both = met & second.isfinite()
        assert (first - second)[both].abs().lt(2e-2).all(), kind


@FAST
@pytest.mark.parametrize("descent", [1.0, 0.3, 0.05])
def test_crossings_of_a_plane_are_in_closed_form(cross, descent, generator):
    """z = a x + b y + c: t = (a x + b y + c - z) / (dz - a dx - b dy)."""
    a, b, c, n = 0.3, -0.15, 2.0, 500
    columns, rows = 60, 40
    x, y = torch.meshgrid(torch.arange(columns), torch.arange(rows), indexing="xy")
    height = (a * x + b * y + c).float()
    o = torch.rand(n, 3, generator=generator) * torch.tensor([20.0, 10.0, 1.0]) + 15
    o[:, 2] += a * o[:, 0] + b * o[:, 1] + c - 14.9
    d = torch.randn(n, 3, generator=generator)
    d[:, 2] = a * d[:, 0] + b * d[:, 1] - descent  # the rate at which they approach the plane
    d = normalised(d)
    gap = o[:, 2] - (a * o[:, 0] + b * o[:, 1] + c)
    t = gap / (a * d[:, 0] + b * d[:, 1] - d[:, 2])
    end = o + t[:, None] * d
    inside = ((end[:, :2] > 0.01) & (end[:, :2] < torch.tensor([columns - 1.01, rows - 1.01]))).all(
        1
    )
    outside = (
        (end[:, :2] < -0.01) | (end[:, :2] > torch.tensor([columns - 0.99, rows - 0.99]))
    ).any(1)
    found = cross(height, o, d, endless(n))
    assert inside.sum() > 20
    assert torch.allclose(found[inside], t[inside], rtol=1e-3, atol=5e-3 / descent)
    assert found[outside].isinf().all(), "the raster ends"


@FAST
def test_rays_begin_and_end_where_their_span_does(cross):
    height = torch.zeros(8, 8)
    o = torch.tensor([3.0, 3.0, 2.0]).repeat(6, 1)
    d = torch.tensor([0.0, 0.0, -1.0]).repeat(6, 1)
    span = torch.tensor([[0.0, 1.9], [0.0, 2.1], [1.9, 3.0], [2.1, 9.0], [2.1, 1.0], [0.0, 1e9]])
    found = cross(height, o, d, span)
    assert found.isfinite().tolist() == [False, True, True, False, False, True]
    assert torch.allclose(found[found.isfinite()], torch.tensor(2.0), atol=2e-3)


@FAST
def test_ground_is_met_from_above_only(cross):
    """From below a ray leaves the ground, and meets it where it enters again."""
    x = torch.arange(40.0)
    height = (2 * torch.sin(x / 4)).repeat(12, 1)
    o = torch.tensor([[6.3, 5.0, 0.0], [6.3, 5.0, 0.0], [6.3, 5.0, -3.0], [18.0, 5.0, 0.0]])
    d = torch.tensor([[1.0, 0, 0], [0, 0, 1.0], [0, 0, -1.0], [1.0, 0, 0]])
    found = cross(height, o, d, endless(4))
    expected = torch.tensor([8 * math.pi - 6.3, math.inf, math.inf, 8 * math.pi - 18])
    assert torch.allclose(found, expected, atol=0.05)


@FAST
def test_a_rising_ray_leaves_the_ground_and_meets_the_next_hill(cross):
    """Under the ground a rising ray nears the surface faster than above it."""
    height = torch.zeros(12, 60)
    height[:, 12:15] = 0.8 * torch.tensor([1.0, 2.0, 1.0])
    o = torch.tensor([[2.0, 5.0, -4.0], [2.0, 6.0, -4.2]])
    d = normalised(torch.tensor([[1.0, 0.0, 0.5], [1.0, 0.0, 0.5]]))
    found = cross(height, o, d, endless(2))
    expected = reference.first_crossing(height, o, d, endless(2))
    assert expected.isfinite().all(), "the slow reference meets the hill"
    assert torch.allclose(found, expected, atol=0.02)


@FAST
@pytest.mark.parametrize("step", [0.0, 2.0, 9.0])
def test_grazing_rays_meet_the_ground_far_away(cross, step):
    """One kerb on the raster makes its steepest slope large, and steps along all rays short."""
    height = torch.zeros(40, 600)
    height[:3] = step
    height[:, -3:] = step
    n = 30
    o = torch.tensor([0.5, 30.0, 30.0]).repeat(n, 1)
    reach = torch.linspace(20, 595, n)
    d = normalised(torch.stack([reach, torch.zeros(n), torch.full((n,), -30.0)], dim=-1))
    found = cross(height, o, d, endless(n))
    assert torch.allclose(found, torch.hypot(reach, torch.tensor(30.0)), atol=0.05)


@FAST
def test_no_rays_meet_nothing(cross):
    assert cross(
        torch.zeros(4, 4), torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0, 2)
    ).shape == (0,)


@FAST
def test_rays_that_are_no_numbers_meet_nothing(cross):
    o = torch.tensor([[math.nan, 1.0, 1.0], [1.0, 1.0, 1.0], [1.0, 1.0, 1.0]])
    d = torch.tensor([[0.0, 0.0, -1.0], [math.nan, 0.0, -1.0], [0.0, 0.0, -1.0]])
    found = cross(torch.zeros(4, 4), o, d, endless(3))
    assert found.isinf().tolist() == [True, True, False]


def test_the_steepest_slope_bounds_every_gradient(generator):
    height = surface(generator).double()
    at = torch.rand(2000, 2, generator=generator).double() * (SIDE - 1)
    step = 1e-5
    rise = [
        (reference.bilinear(height, at + step * axis) - reference.bilinear(height, at)) / step
        for axis in torch.eye(2).double()
    ]
    steepest = torch.hypot(*rise).max()
    assert 0.5 * heightfield.steepest_slope(height) < steepest
    assert steepest <= heightfield.steepest_slope(height) + 1e-4
