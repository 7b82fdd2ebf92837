"""Ground height fitted to few points, against the surface that they are sampled from."""

import numpy as np
import torch
from scipy.interpolate import RegularGridInterpolator

from climatenerf.training.evidence import ground_height
from climatenerf.training.evidence.ground_height import fit_ground_height


def hills(xy):
    """Sloping ground with hills of a tenth of a grid unit; lengths in grid units."""
    x, y = xy.unbind(-1)
    return 0.1 * torch.sin(x) * torch.cos(0.8 * y) + 0.15 * x - 0.4


def positions(n, seed=0, half=3.5):
    return (2 * torch.rand(n, 2, generator=torch.Generator().manual_seed(seed)) - 1) * half


def points(xy, height):
    return torch.cat([xy, height[:, None]], dim=-1)


def test_hills_are_fitted_despite_a_fifth_of_outliers():
    xy = positions(800)
    z = hills(xy)
    generator = torch.Generator().manual_seed(1)
    z[:160] += 0.3 * torch.rand(160, generator=generator) + 0.05
    z[160:] += 2e-3 * torch.randn(640, generator=generator)
    ground = fit_ground_height(points(xy, z))
    assert ground is not None
    queries = positions(2000, seed=2, half=3.0)
    height, valid = ground.height_above(points(queries, hills(queries)))
    assert valid.float().mean() > 0.99
    assert height.abs().median() < 3e-3 and height.abs().quantile(0.95) < 0.012
    # A tenth of a unit above the ground is measured as such; rough ground raises the tolerance.
    above, _ = ground.height_above(points(queries, hills(queries) + 0.1))
    assert torch.allclose(above - height, torch.full((2000,), 0.1), atol=1e-5)
    assert ground.tolerance > 0.1, "a fifth of outliers counts as roughness"


def test_smooth_ground_has_the_minimum_tolerance():
    xy = positions(500)
    ground = fit_ground_height(points(xy, hills(xy)))
    assert ground is not None and ground.tolerance == ground_height.MIN_TOLERANCE


def test_a_plane_is_exact_everywhere_and_valid_near_points_only():
    xy = positions(60, half=0.8)
    ground = fit_ground_height(points(xy, 0.2 * xy[:, 0] - 0.1 * xy[:, 1] + 0.7))
    assert ground is not None
    queries = positions(500, seed=3, half=3.9)
    height, valid = ground.height_above(
        points(queries, 0.2 * queries[:, 0] - 0.1 * queries[:, 1] + 0.7)
    )
    assert height.abs().max() < 1e-3
    near = torch.cdist(queries, xy).amin(-1)
    assert valid[near < 0.2].all() and not valid[near > 0.8].any()
    outside = torch.tensor([[4.5, 0.0, 0.0], [4.0, 0.0, 0.0]])  # continued from the grid's border
    above, valid = ground.height_above(outside)
    assert not valid.any() and torch.allclose(above, torch.full((2,), -1.5), atol=1e-3)


def test_collinear_and_coincident_points_give_finite_heights():
    line = torch.linspace(-3, 3, 100)
    for xy in (torch.stack([line, 0 * line], -1), torch.zeros(100, 2)):
        ground = fit_ground_height(points(xy, torch.full((100,), 0.25)))
        assert ground is not None and torch.isfinite(ground.height).all()
        assert ground.height_above(torch.tensor([[0.0, 0.0, 0.25]]))[0].abs() < 1e-3


def test_too_few_points_give_no_ground():
    assert fit_ground_height(torch.zeros(ground_height.MIN_POINTS - 1, 3)) is None
    assert fit_ground_height(torch.full((500, 3), 9.0)) is None, "all points are outside the grid"


def test_many_points_are_subsampled_evenly(monkeypatch):
    monkeypatch.setattr(ground_height, "MAX_POINTS", 300)
    xy = positions(3000)
    q = points(xy, hills(xy))
    ground, subset = fit_ground_height(q), fit_ground_height(q[::10])
    assert ground is not None and subset is not None
    assert torch.equal(ground.height, subset.height)
    assert ground.height_above(q)[0].abs().quantile(0.9) < 0.012


def test_interpolation_matches_scipy():
    xy = positions(500)
    ground = fit_ground_height(points(xy, hills(xy)))
    assert ground is not None
    line = np.linspace(-ground_height.HALF_SIDE, ground_height.HALF_SIDE, ground_height.GRID_NODES)
    interpolate = RegularGridInterpolator((line, line), ground.height.numpy())
    queries = positions(300, seed=5)
    expected = -interpolate(queries.flip(-1).numpy())
    height, _ = ground.height_above(points(queries, torch.zeros(300)))
    assert np.abs(height.numpy() - expected).max() < 1e-5
