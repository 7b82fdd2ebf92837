"""Ground height fitted to few points, against the surface that they are sampled from."""

import numpy as np
import pytest
import torch
from scipy.interpolate import RegularGridInterpolator

from climatenerf.scene.terrain_fit import Heights
from climatenerf.training.evidence import ground_height
from climatenerf.training.evidence.ground_height import fit_ground_height

UNIT = 10.0  # m per grid unit
CENTRE = np.array([500.0, -300.0, 20.0])


def hills(xy):
    """Sloping ground with hills of a tenth of a grid unit; lengths in grid units."""
    x, y = xy.unbind(-1)
    return 0.1 * torch.sin(x) * torch.cos(0.8 * y) + 0.05 * x - 0.4


def positions(n, seed=0, half=3.5):
    return (2 * torch.rand(n, 2, generator=torch.Generator().manual_seed(seed)) - 1) * half


def points(xy, height):
    return torch.cat([xy, height[:, None]], dim=-1)


def fitted(q, error=2e-3):
    """The ground through points in grid units, each with a standard error in grid units."""
    x = CENTRE + UNIT * q.double().numpy()
    return fit_ground_height(Heights(x, np.full(len(x), error * UNIT)), CENTRE, UNIT)


def test_hills_are_fitted_despite_a_fifth_of_outliers():
    xy = positions(3000)
    z = hills(xy)
    generator = torch.Generator().manual_seed(1)
    z[:600] += 0.3 * torch.rand(600, generator=generator) + 0.05
    z[600:] += 2e-3 * torch.randn(2400, generator=generator)
    ground = fitted(points(xy, z))
    assert ground is not None
    queries = positions(2000, seed=2, half=3.0)
    height, valid = ground.height_above(points(queries, hills(queries)))
    assert valid.float().mean() > 0.99
    assert height.abs().median() < 3e-3 and height.abs().quantile(0.95) < 0.012
    # A tenth of a unit above the ground is measured as such.
    above, _ = ground.height_above(points(queries, hills(queries) + 0.1))
    assert torch.allclose(above - height, torch.full((2000,), 0.1), atol=1e-5)


def test_the_tolerance_covers_the_error_and_grows_where_points_are_missing():
    xy = positions(3000)
    xy = xy[xy[:, 0].abs() > 0.8]
    ground = fitted(points(xy, hills(xy)))
    assert ground is not None
    queries = positions(2000, seed=2, half=3.0)
    tolerance = ground.tolerance_at(queries)
    assert tolerance.min() > 0.999 * ground_height.MIN_TOLERANCE
    middle = queries[:, 0].abs() < 0.2
    assert tolerance[middle].min() > 2 * tolerance[~middle].median()
    off = ground.height_above(points(queries, hills(queries)))[0].abs()
    assert (off < tolerance).float().mean() > 0.95


def test_single_outliers_above_the_ground_are_no_crests():
    xy = positions(3000)
    z = torch.zeros(3000)
    z[::100] = 1.0
    ground = fitted(points(xy, z))
    assert ground is not None
    queries = points(positions(500, seed=9, half=3.0), torch.full((500,), 0.3))
    assert ground.is_above_crests(queries, torch.full((500,), 0.02)).float().mean() > 0.95


def test_rough_ground_is_valid_and_holds_nothing():
    """Boulders of half a grid unit on one side; smooth ground on the other."""
    xy = positions(4000)
    z = torch.zeros(4000)
    rough = xy[:, 0] > 0.5
    z[rough] = 0.5 * torch.rand(int(rough.sum()), generator=torch.Generator().manual_seed(6))
    ground = fitted(points(xy, z))
    assert ground is not None
    queries = points(positions(1000, seed=7, half=3.0), torch.zeros(1000))
    far, holds = (queries[:, 0] - 0.5).abs() > 0.5, ground.holds(queries)
    boulders = queries[:, 0] > 0.5
    assert ground.height_above(queries)[1].all()
    assert holds[far & ~boulders].all() and holds[far & boulders].float().mean() < 0.25
    outside = torch.tensor([[-4.5, 0.0, 0.0]])
    assert not ground.holds(outside).any()


def test_a_plane_is_exact_near_points_and_valid_there_only():
    xy = positions(60, half=0.8)
    ground = fitted(points(xy, 0.02 * xy[:, 0] - 0.01 * xy[:, 1] + 0.7))
    assert ground is not None
    queries = positions(3000, seed=3, half=3.9)
    height, valid = ground.height_above(
        points(queries, 0.02 * queries[:, 0] - 0.01 * queries[:, 1] + 0.7)
    )
    near = torch.cdist(queries, xy).amin(-1)
    # The membrane flattens the border; the least tolerance covers it.
    assert height[near < 0.2].abs().max() < ground_height.MIN_TOLERANCE
    assert height[near < 0.2].abs().median() < 1e-3
    assert valid[near < 0.2].all() and not valid[near > 0.8].any()
    outside = torch.tensor([[4.5, 0.0, 0.0], [4.0, 0.0, 0.0]])  # continued from the raster's border
    above, valid = ground.height_above(outside)
    assert not valid.any() and torch.allclose(above[0], above[1], atol=1e-5)


def test_collinear_and_coincident_points_give_finite_heights():
    line = torch.linspace(-3, 3, 100)
    for xy in (torch.stack([line, 0 * line], -1), torch.zeros(100, 2)):
        ground = fitted(points(xy, torch.full((100,), 0.25)))
        assert ground is not None and torch.isfinite(ground.height).all()
        assert ground.height_above(torch.tensor([[0.0, 0.0, 0.25]]))[0].abs() < 1e-3


def test_too_few_points_give_no_ground():
    assert fitted(torch.zeros(ground_height.MIN_POINTS - 1, 3)) is None
    assert fitted(torch.full((500, 3), 9.0)) is None, "all points are outside the raster"


@pytest.mark.parametrize("share", [0.3, 0.5])
def test_ground_labels_that_are_wrong_on_walls_and_bushes_do_not_tilt_the_ground(share):
    """A third or half of the points stand on it: hedges on one side of a road."""
    xy = positions(4000)
    z = torch.full((4000,), 0.1)
    generator = torch.Generator().manual_seed(4)
    hedge = (xy[:, 0] > 0.5) & (torch.rand(4000, generator=generator) < 1.2 * share)
    z[hedge] += 0.02 + 0.2 * torch.rand(int(hedge.sum()), generator=generator)
    ground = fitted(points(xy, z))
    assert ground is not None
    queries = positions(2000, seed=5, half=3.0)
    off = ground.height_above(points(queries, torch.full((2000,), 0.1)))[0].abs()
    assert off.median() < 2e-3 and off.quantile(0.95) < 0.03


def test_interpolation_matches_scipy():
    xy = positions(500)
    ground = fitted(points(xy, hills(xy)))
    assert ground is not None
    line = np.linspace(-ground_height.HALF_SIDE, ground_height.HALF_SIDE, ground_height.NODES)
    queries = positions(300, seed=5)
    for values, found in (
        (ground.height, -ground.height_above(points(queries, torch.zeros(300)))[0]),
        (ground.tolerance, ground.tolerance_at(queries)),
    ):
        expected = RegularGridInterpolator((line, line), values.numpy())(queries.flip(-1).numpy())
        assert np.abs(found.numpy() - expected).max() < 1e-5
