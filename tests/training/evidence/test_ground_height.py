"""The map of the ground from few points: against the surface that they are drawn from."""

import numpy as np
import pytest
import torch

from climatenerf.training.evidence import ground_height as ground_map
from climatenerf.training.evidence.ground_height import fit_ground_height


def hills(xy):
    """Ground that rises and falls by a tenth of a grid unit over some units, on a slope."""
    x, y = xy.unbind(-1)
    return 0.1 * torch.sin(x) * torch.cos(0.8 * y) + 0.15 * x - 0.4


def places(n, seed=0, half=3.5):
    return (2 * torch.rand(n, 2, generator=torch.Generator().manual_seed(seed)) - 1) * half


def on(xy, height):
    return torch.cat([xy, height[:, None]], dim=-1)


def test_hills_are_found_from_few_points_though_a_fifth_of_them_stand_on_it():
    xy = places(800)
    z = hills(xy)
    generator = torch.Generator().manual_seed(1)
    z[:160] += 0.3 * torch.rand(160, generator=generator) + 0.05
    z[160:] += 2e-3 * torch.randn(640, generator=generator)
    ground = fit_ground_height(on(xy, z))
    assert ground is not None
    asked = places(2000, seed=2, half=3.0)
    over, known = ground.height_above(on(asked, hills(asked)))
    assert known.float().mean() > 0.99
    assert over.abs().median() < 3e-3 and over.abs().quantile(0.95) < 0.012
    # Those a tenth above the ground are known to be above it, and rough ground is let be.
    above, _ = ground.height_above(on(asked, hills(asked) + 0.1))
    assert torch.allclose(above - over, torch.full((2000,), 0.1), atol=1e-5)
    assert ground.tolerance > 0.1, "a fifth that stands about makes it rough"


def test_the_tolerance_of_smooth_ground_is_the_least():
    xy = places(500)
    ground = fit_ground_height(on(xy, hills(xy)))
    assert ground is not None and ground.tolerance == ground_map.MIN_TOLERANCE


def test_a_plane_is_exact_far_from_points_too_and_known_near_them_only():
    xy = places(60, half=0.8)
    ground = fit_ground_height(on(xy, 0.2 * xy[:, 0] - 0.1 * xy[:, 1] + 0.7))
    assert ground is not None
    asked = places(500, seed=3, half=3.9)
    over, known = ground.height_above(on(asked, 0.2 * asked[:, 0] - 0.1 * asked[:, 1] + 0.7))
    assert over.abs().max() < 1e-3
    near = torch.cdist(asked, xy).amin(-1)
    assert known[near < 0.2].all() and not known[near > 0.8].any()
    outside = torch.tensor([[4.5, 0.0, 0.0], [4.0, 0.0, 0.0]])  # there as at the map's border
    above, known = ground.height_above(outside)
    assert not known.any() and torch.allclose(above, torch.full((2,), -1.5), atol=1e-3)


def test_points_in_a_line_or_in_one_place_give_numbers():
    line = torch.linspace(-3, 3, 100)
    for xy in (torch.stack([line, 0 * line], -1), torch.zeros(100, 2)):
        ground = fit_ground_height(on(xy, torch.full((100,), 0.25)))
        assert ground is not None and torch.isfinite(ground.height).all()
        assert ground.height_above(torch.tensor([[0.0, 0.0, 0.25]]))[0].abs() < 1e-3


def test_few_points_draw_no_map():
    assert fit_ground_height(torch.zeros(ground_map.MIN_POINTS - 1, 3)) is None
    assert fit_ground_height(torch.full((500, 3), 9.0)) is None, "all of them are outside"


def test_many_points_are_thinned_evenly(monkeypatch):
    monkeypatch.setattr(ground_map, "MAX_POINTS", 300)
    asked = []
    cells = ground_map._cells
    monkeypatch.setattr(ground_map, "_cells", lambda q: asked.append(q) or cells(q))
    xy = places(3000)
    ground = fit_ground_height(on(xy, hills(xy)))
    assert len(asked) == 1 and torch.equal(asked[0], on(xy, hills(xy))[::10])
    assert ground is not None
    assert ground.height_above(on(xy, hills(xy)))[0].abs().quantile(0.9) < 0.012


def test_heights_between_lines_against_scipy():
    interpolate = pytest.importorskip("scipy.interpolate")
    xy = places(500)
    ground = fit_ground_height(on(xy, hills(xy)))
    assert ground is not None
    line = np.linspace(-ground_map.HALF_SIDE, ground_map.HALF_SIDE, ground_map.CELLS)
    twin = interpolate.RegularGridInterpolator((line, line), ground.height.numpy())
    asked = places(300, seed=5)
    real = twin(asked.flip(-1).numpy())
    assert np.abs(ground.height_above(on(asked, torch.zeros(300)))[0].numpy() + real).max() < 1e-5
