"""Fixed-capacity buffers: the gradients of exact ones, without synchronisation."""

import numpy as np
import pytest
import torch
from support.toy_fit import with_labels
from torch.utils._python_dispatch import TorchDispatchMode

from climatenerf.training import static_shapes as module
from climatenerf.training.settings import Losses
from climatenerf.training.static_shapes import ExactBuffers, FixedBuffers

SYNCHRONISING = {  # operations whose output size or value the CPU must read
    torch.ops.aten.nonzero.default,
    torch.ops.aten._local_scalar_dense.default,
    torch.ops.aten.masked_select.default,
    torch.ops.aten.bincount.default,
    torch.ops.aten._unique2.default,
    torch.ops.aten.unique_dim.default,
    torch.ops.aten.repeat_interleave.Tensor,
    torch.ops.aten.equal.default,
    torch.ops.aten.lift_fresh.default,  # `torch.tensor` copies from the CPU
}
BY_INDEX = {
    torch.ops.aten.index.Tensor,
    torch.ops.aten.index_put_.default,
    torch.ops.aten.index_put.default,
    torch.ops.aten._index_put_impl_.default,
}


class SyncRecorder(TorchDispatchMode):
    """Record operations that would synchronise with a GPU, except those of our own kernels."""

    def __init__(self):
        super().__init__()
        self.recorded = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        by_mask = func in BY_INDEX and any(
            each is not None and each.dtype in (torch.bool, torch.uint8) for each in args[1]
        )
        if func in SYNCHRONISING or by_mask:
            self.recorded.append(func)
        return func(*args, **(kwargs or {}))


def frozen_fit(scene, fixed):
    """A fit with labels, points, relative depth and masks, and without parameter updates."""
    losses = Losses(normal_consistency=0.01)
    trainer = with_labels(scene, np.asarray, losses=losses, refine_poses=True)
    pixels = trainer.pixels
    depth = torch.rand(pixels.rgb.shape[0], generator=torch.Generator().manual_seed(1))
    pixels.relative = torch.where(depth > 0.9, torch.nan, depth)
    assert trainer.evidence.free_space.ground is not None
    assert trainer.evidence.knows_sky and trainer.objective.learns_classes
    trainer.objective.buffers = FixedBuffers() if fixed else ExactBuffers()
    trainer.grid_adam.step = lambda rate: None
    trainer.net_adam.step = lambda: None
    # Like a later state: visible matter, mostly above the ground and in front of the sky.
    with torch.no_grad():
        trainer.field.geometry_net[-1].add_(2.5)
    return trainer


def gradients_of(trainer, batch):
    """Return the result and all gradients of a step."""
    for table in trainer.grid_adam.tables:
        table.grad_buffer.zero_()
    trainer.generator.manual_seed(3)
    result = trainer.step(batch)
    named = {name: p.grad for name, p in trainer.field.named_parameters() if p.grad is not None}
    for name, module_ in (("masks", trainer.masks), ("poses", trainer.poses)):
        named |= {f"{name}.{n}": p.grad for n, p in module_.named_parameters()}
    tables = {str(i): t.grad_buffer.clone() for i, t in enumerate(trainer.grid_adam.tables)}
    return result, {name: each.clone() for name, each in named.items()} | tables


def recorded_samples(trainer):
    return 600 * trainer.buffers.values["used"]


@pytest.fixture
def batch_of():
    return lambda trainer: trainer.pixels.draw(600, torch.Generator().manual_seed(2), 100, 0.1)


@pytest.mark.slow
def test_fixed_capacities_give_the_gradients_of_exact_buffers(scene, batch_of):
    results = []
    for fixed in (False, True):
        trainer = frozen_fit(scene, fixed)
        names = []
        indices = trainer.buffers.indices
        trainer.buffers.indices = lambda name, mask, i=indices, n=names: (
            n.append(name) or i(name, mask)
        )
        for _ in range(4):  # later capacities are smaller, and their sums differ
            gradients_of(trainer, batch_of(trainer))
            trainer.objective.depth_alignment.sums.zero_()
        results.append(gradients_of(trainer, batch_of(trainer)))
        lists = {"heavy", "selected", "visible", "ground", "off ground", "ground hull", "sky"}
        assert lists <= set(names)
        if fixed:
            assert len(trainer.buffers.needed) == 10
            assert trainer.buffers.capacity("samples", 600 * 1024) < 2 * recorded_samples(trainer)
    (exact, expected), (deferred, found) = results
    assert deferred[0] == pytest.approx(exact[0], rel=1e-4) and deferred[1] == exact[1] > 5000
    assert expected.keys() == found.keys()
    count = 0
    for name, gradient in expected.items():
        count += bool((gradient != 0).any())
        off = (found[name] - gradient).abs().max()
        assert off <= 2e-3 * gradient.abs().max() + 1e-12, (name, off, gradient.abs().max())
    assert count > 20, "all parts of the field, masks and poses have gradients"


@pytest.mark.slow
def test_a_step_with_fixed_capacities_does_not_synchronise(scene, batch_of, monkeypatch):
    trainer = frozen_fit(scene, True)
    for _ in range(4):
        trainer.step(batch_of(trainer))
    trainer.resumed_progress, trainer.field.pruning_threshold = (
        0.6,
        0.002,
    )  # the threshold increases
    end_step = trainer.buffers.end_step
    trainer.buffers.end_step = lambda: None
    with monkeypatch.context() as patch:
        for method in ("cpu", "tolist"):  # copies that `SyncRecorder` does not record
            patch.setattr(torch.Tensor, method, None)
        with SyncRecorder() as watch:
            trainer.step(batch_of(trainer))
            trainer.field.occupancy._occupied_of_static(torch.arange(4000), 1000)
    assert not watch.recorded, watch.recorded
    assert any(name.startswith("pruned light") for name in trainer.buffers.numbers)
    trainer.buffers.end_step = end_step
    trainer.buffers.end_step()
    # `SyncRecorder` records the synchronisations of exact buffers.
    exact = frozen_fit(scene, False)
    with SyncRecorder() as watch:
        exact.step(batch_of(exact))
    assert len(watch.recorded) > 10


def test_deferred_read_back_returns_the_number_of_two_steps_before():
    buffers = FixedBuffers()
    read = []
    for step in range(6):
        read.append(buffers.read("number", torch.tensor(float(step))))
        buffers.end_step()
    assert read == [0, 0, 0, 1, 2, 3], "the first ones synchronise"
    assert FixedBuffers().read("number", torch.tensor(1.0), default=5.0) == 5.0
    assert ExactBuffers().read("number", torch.tensor(7.0), default=5.0) == 7.0


def test_fixed_index_lists_are_padded_and_adapt_their_capacity():
    buffers = FixedBuffers()
    mask = torch.zeros(40_000, dtype=torch.bool)
    mask[[3, 500, 39_998]] = True
    everything = buffers.indices("few", mask)
    assert everything.shape[0] == 40_000, "without a record the capacity is the maximum"
    assert everything[:4].tolist() == [3, 500, 39_998, 39_999] and (everything[3:] == 39_999).all()
    for _ in range(4):
        buffers.end_step()
        found = buffers.indices("few", mask)
    assert found.shape[0] == module.MIN_CAPACITY and found[:3].tolist() == [3, 500, 39_998]
    mask[:20_000] = True
    found = buffers.indices("few", mask)
    assert found.tolist()[-2:] == [1022, 39_999], "indices beyond the capacity are dropped"
    for _ in range(4):
        buffers.end_step()
        found = buffers.indices("few", mask)
    assert found[20_000] == 39_998 and 30_000 <= found.shape[0] <= 30_100
    assert ExactBuffers().indices("few", mask).shape[0] == 20_001


def test_both_kinds_of_buffers_have_the_same_interface():
    mask, ascending = torch.tensor([True, False, True]), torch.tensor([0, 0, 1, 4])
    exact, fixed = ExactBuffers(), FixedBuffers()
    assert exact.rows(mask).tolist() == [0, 2] and fixed.rows(mask).tolist() == [0, 1, 2]
    assert ascending[exact.prefix("p", ascending, 2)].tolist() == [0, 0, 1]
    assert ascending[fixed.prefix("p", ascending, 2)].tolist()[:3] == [0, 0, 1]
    assert exact.capacity("p", 7) is None and fixed.capacity("p", 7) == 7
    for device, kind in (("cpu", ExactBuffers), ("cuda", FixedBuffers)):
        assert type(module.buffers_for(torch.device(device))) is kind


def test_samples_beyond_the_capacity_are_dropped(scene):
    trainer = frozen_fit(scene, False)
    batch = trainer.pixels.draw(300, torch.Generator().manual_seed(0))
    start, end = torch.full((300,), trainer.field.near), torch.full((300,), 1e9)
    whole = trainer.field.march(batch.rays_o, batch.rays_d, start, end)
    n = int(whole.offsets[-1])
    wide = trainer.field.march(batch.rays_o, batch.rays_d, start, end, capacity=n + 50)
    assert torch.equal(wide.offsets, whole.offsets) and torch.equal(wide.t[:n], whole.t)
    assert not wide.t[n:].any() and not wide.dt[n:].any() and not wide.sigma[n:].any()
    assert torch.equal(wide.ray_index()[:n], whole.ray_index()) and wide.ray_index()[-1] == 299
    narrow = trainer.field.march(batch.rays_o, batch.rays_d, start, end, capacity=n // 2)
    m = n // 2 - 1
    assert torch.equal(narrow.offsets, whole.offsets.clamp_max(m)) and narrow.dt[-1] == 0
    assert torch.equal(narrow.t[:m], whole.t[:m]) and torch.equal(narrow.sigma[:m], whole.sigma[:m])
