"""The step that `benchmarks/engine.py` measures, against the same in plain PyTorch."""

import os
import sys
from pathlib import Path
from unittest import mock

import torch
from support.toy_fit import begin

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
with mock.patch.dict(os.environ):  # the benchmarks' variables of threads are theirs alone
    import engine
sys.path.pop(0)


def learned(field, at, plain):
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


def test_the_benchmarked_step_and_plain_pytorch_have_the_same_loss_and_gradients(scene):
    trainer = begin(scene, steps=10)
    field = trainer.field
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():  # as after a few steps: varied grids and visible matter
        for name, parameter in field.named_parameters():
            if name.endswith("_grid"):
                parameter.copy_(0.1 * torch.randn(parameter.shape, generator=generator))
        field.geometry_net[-1].add_(2.0)
    for table in trainer.grid_adam.tables:
        del table.grad_buffer  # so that gradients go to .grad
    at = engine.draw_batch(trainer, 30_000)
    ours, gradients = learned(field, at, False)
    twin, wanted = learned(field, at, True)
    assert abs(ours - twin) < 1e-5 * abs(twin)
    assert gradients.keys() == wanted.keys() and len(wanted) > 20
    for name, gradient in wanted.items():
        off = (gradients[name] - gradient).norm()
        assert gradient.norm() > 0 and off < 1e-3 * gradient.norm(), (name, off, gradient.norm())
