"""Marching ends for all numbers that a ray can hold; otherwise these tests would hang."""

import numpy as np
import pytest
import torch

from climatenerf.ops import marching, reference
from climatenerf.ops.step_limits import MAX_STEPS

RAYS = 64
HOSTILE = (float("nan"), float("inf"), 1e38, -1e38, 1e30, 1e12, 1e7, 1e-38)


def network():
    generator = torch.Generator().manual_seed(0)
    table = torch.rand(2, 64, 2, generator=generator)
    w1, w2 = (torch.randn(*shape, generator=generator) for shape in ((4, 8), (8, 1)))
    return table, torch.tensor([2, 4]), w1, torch.zeros(8), w2, torch.zeros(1)


def marched(origins, directions, spans, steps, occupied):
    cells = marching.cells_of(occupied)
    return marching.march((origins, directions), spans, cells, steps, 1e-3, network())


@pytest.mark.parametrize("value", HOSTILE)
@pytest.mark.parametrize("where", ["origin", "direction", "begin", "end", "step", "cone"])
@pytest.mark.parametrize("share", [0, 1])
def test_marching_ends(value, where, share):
    generator = torch.Generator().manual_seed(1)
    origins = torch.rand(RAYS, 3, generator=generator)
    directions = torch.nn.functional.normalize(torch.randn(RAYS, 3, generator=generator), dim=-1)
    spans = torch.tensor([[0.05, 1e9, 0.0]]).repeat(RAYS, 1)
    steps = [1 / 256, 1 / 160, 1e-3]
    if where == "origin":
        origins[::2, 1] = value
    elif where == "direction":
        directions[::2, 1] = value
    elif where in ("begin", "end"):
        spans[::2, int(where == "end")] = value
    else:
        steps[int(where == "cone")] = value
    occupied = torch.full((3, 8, 8, 8), share, dtype=torch.uint8)
    offsets, found = marched(origins, directions, spans, tuple(steps), occupied)
    assert offsets.shape == (RAYS + 1,) and found.shape[0] == 3
    assert int(offsets[-1]) <= RAYS * marching.MAX_RAY_SAMPLES


def test_a_step_that_underflows_ends_after_a_bounded_number(monkeypatch):
    """From length 1e7 on, 32 bits do not hold a step of 1e-3."""
    origins, directions = torch.tensor([[-1e7, 0.0, 0.0]]), torch.tensor([[1.0, 0.0, 0.0]])
    spans = torch.tensor([[0.0, 1e9, 0.0]])
    occupied = torch.ones(2, 8, 8, 8, dtype=torch.uint8)
    offsets, _ = marched(origins, directions, spans, (1e-3, 0.0, 1e9), occupied)
    assert int(offsets[-1]) == 0
    calls = []

    def density_at(q):
        calls.append(1)
        return torch.zeros(1)

    monkeypatch.setattr(reference, "MAX_STEPS", 100)
    ray, span = (torch.zeros(3), torch.tensor([1.0, 0.0, 0.0])), (0.5, 4e9, 0.0)
    reference.march(*ray, span, occupied, (1e-9, 0.0, 1e-3), 1e-3, density_at)
    assert len(calls) == 100


def test_steps_of_the_renderer_are_far_below_the_bound():
    """A ray across all cascades, by the smallest steps in use, and no cell skipped."""
    t, steps = 0.005, 0
    while t < 2 * np.sqrt(3) * 2**6:
        t += max(1 / 256, t / 160)
        steps += 1
    assert 8 * steps < MAX_STEPS
