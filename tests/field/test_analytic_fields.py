"""Samples of the analytic field against dense steps through its density."""

import torch
from support.analytic_fields import AnalyticField, ground, table


def test_march_agrees_with_the_density():
    field = AnalyticField([ground(0.1, 1.0), *table()], extinction=15.0)
    generator = torch.Generator().manual_seed(0)
    origins = torch.randn(200, 3, generator=generator) + torch.tensor([0.0, 0.0, 2.5])
    aims = torch.randn(200, 3, generator=generator) * 0.5
    directions = torch.nn.functional.normalize(aims - origins, dim=-1)
    zero = torch.zeros(200)
    samples = field.march(origins, directions, zero + 0.3, zero + 5.0)
    depth = zero.index_add(0, samples.ray_index(), samples.sigma * samples.dt)
    step = 2e-3
    t = torch.arange(0.3 + step / 2, 5.0, step)
    points = origins[:, None] + t[:, None] * directions[:, None]
    sigma = field.density(points.reshape(-1, 3)).reshape(200, -1)
    expected = sigma.sum(1) * step
    # Rays may end beyond an optical depth of 7: exp(-7) < 1e-3.
    assert (depth.clamp(max=7) - expected.clamp(max=7)).abs().max() < 4 * 15.0 * step
    assert (expected > 1).float().mean() > 0.5
    ordered = samples.t.diff() > 0
    ordered[samples.offsets[1:-1].clamp(1, len(samples.t) - 1) - 1] = True
    assert ordered.all()
