"""The step that `benchmarks/engine.py` measures, against plain PyTorch."""

import os
import sys
from pathlib import Path
from unittest import mock

import torch
from support.toy_fit import begin

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
with mock.patch.dict(os.environ):  # the benchmarks set thread variables
    import engine
sys.path.pop(0)


def loss_and_gradients(field, at, plain):
    for parameter in field.parameters():
        parameter.grad = None
    if plain:
        with engine.plain_pytorch():
            loss = engine.loss_of(field, at)
            loss.backward()
    else:
        loss = engine.loss_of(field, at)
        loss.backward()
    named = {name: p.grad for name, p in field.named_parameters() if p.grad is not None}
    return float(loss.detach()), {name: each.clone() for name, each in named.items()}


def test_the_benchmarked_step_has_the_gradients_of_plain_pytorch(scene):
    trainer = begin(scene, steps=10)
    field = trainer.field
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():  # like a later state: varied grids and visible matter
        for name, parameter in field.named_parameters():
            if name.endswith("_grid"):
                parameter.copy_(0.1 * torch.randn(parameter.shape, generator=generator))
        field.geometry_net[-1].add_(2.0)
    for table in trainer.grid_adam.tables:
        del table.grad_buffer  # so that gradients go to .grad
    at = engine.draw_batch(trainer, 30_000)
    ours, gradients = loss_and_gradients(field, at, False)
    twin, expected = loss_and_gradients(field, at, True)
    assert abs(ours - twin) < 1e-5 * abs(twin)
    assert gradients.keys() == expected.keys() and len(expected) > 20
    for name, gradient in expected.items():
        off = (gradients[name] - gradient).norm()
        assert gradient.norm() > 0 and off < 1e-3 * gradient.norm(), (name, off, gradient.norm())
