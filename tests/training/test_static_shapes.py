"""Fixed rooms: a step is what it is exactly, and nothing in it has to be waited for."""

import numpy as np
import pytest
import torch
from support.toy_fit import with_labels
from torch.utils._python_dispatch import TorchDispatchMode

from climatenerf.training import static_shapes as module
from climatenerf.training.settings import Losses
from climatenerf.training.static_shapes import Rooms

ASKING = {  # operations whose result has a size, or is a number, that the processor must know
    torch.ops.aten.nonzero.default,
    torch.ops.aten._local_scalar_dense.default,
    torch.ops.aten.masked_select.default,
    torch.ops.aten.bincount.default,
    torch.ops.aten._unique2.default,
    torch.ops.aten.unique_dim.default,
    torch.ops.aten.repeat_interleave.Tensor,
    torch.ops.aten.equal.default,
    torch.ops.aten.lift_fresh.default,  # numbers of the processor's, as `torch.tensor` brings
}
BY_INDEX = {
    torch.ops.aten.index.Tensor,
    torch.ops.aten.index_put_.default,
    torch.ops.aten.index_put.default,
    torch.ops.aten._index_put_impl_.default,
}


class Watch(TorchDispatchMode):
    """Notes what a GPU would have to be waited for; kernels of our own are not seen."""

    def __init__(self):
        super().__init__()
        self.met = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        by_mask = func in BY_INDEX and any(
            each is not None and each.dtype in (torch.bool, torch.uint8) for each in args[1]
        )
        if func in ASKING or by_mask:
            self.met.append(func)
        return func(*args, **(kwargs or {}))


def begun(scene, fixed):
    """A fit with labels, points, relative depth and masks, in which no parameter moves."""
    losses = Losses(normal_consistency=0.01)
    fitting = with_labels(scene, np.asarray, losses=losses, refine_poses=True)
    pixels = fitting.pixels
    depth = torch.rand(pixels.rgb.shape[0], generator=torch.Generator().manual_seed(1))
    pixels.relative = torch.where(depth > 0.9, torch.nan, depth)
    assert fitting.carving.ground is not None and fitting.knows_sky and fitting.learns_classes
    fitting.rooms = Rooms(fixed)
    fitting.grid_adam.step = lambda rate: None
    fitting.net_adam.step = lambda: None
    # As found after some time: matter in sight, much of it in the ground's way and in the sky's.
    with torch.no_grad():
        fitting.field.geometry_net[-1].add_(2.5)
    return fitting


def learned_in(fitting, batch):
    """All gradients of a step."""
    for table in fitting.grid_adam.tables:
        table.grad_buffer.zero_()
    fitting.generator.manual_seed(3)
    told = fitting.step(batch)
    named = {name: p.grad for name, p in fitting.field.named_parameters() if p.grad is not None}
    for name, module_ in (("masks", fitting.masks), ("poses", fitting.poses)):
        named |= {f"{name}.{n}": p.grad for n, p in module_.named_parameters()}
    tables = {str(i): t.grad_buffer.clone() for i, t in enumerate(fitting.grid_adam.tables)}
    return told, {name: each.clone() for name, each in named.items()} | tables


def late_samples(fitting):
    return 600 * fitting.rooms.known["used"]


@pytest.fixture
def batch_of():
    return lambda fitting: fitting.pixels.draw(600, torch.Generator().manual_seed(2), 100, 0.1)


def test_a_step_in_fixed_rooms_learns_what_an_exact_one_does(scene, batch_of):
    results = []
    for fixed in (False, True):
        fitting = begun(scene, fixed)
        asked = []
        chosen = fitting.rooms.chosen
        fitting.rooms.chosen = lambda name, mask, c=chosen, a=asked: a.append(name) or c(name, mask)
        for _ in range(4):  # of fixed rooms the later ones are smaller, and their sums differ
            learned_in(fitting, batch_of(fitting))
            fitting.relative.sums.zero_()
        results.append(learned_in(fitting, batch_of(fitting)))
        assert {"heavy", "kept", "seen", "ground", "far", "rest", "sky"} <= set(asked)
        if fixed:
            assert len(fitting.rooms.taken) == 10
            assert fitting.rooms.room("samples", 600 * 1024) < 2 * late_samples(fitting)
    (exact, wanted), (late, found) = results
    assert late[0] == pytest.approx(exact[0], rel=1e-4) and late[1] == exact[1] > 5000
    assert wanted.keys() == found.keys()
    moved = 0
    for name, gradient in wanted.items():
        moved += bool((gradient != 0).any())
        off = (found[name] - gradient).abs().max()
        assert off <= 2e-3 * gradient.abs().max() + 1e-12, (name, off, gradient.abs().max())
    assert moved > 20, "all parts of the field, masks and poses learn"


def test_a_step_in_fixed_rooms_waits_for_nothing(scene, batch_of, monkeypatch):
    fitting = begun(scene, True)
    for _ in range(4):
        fitting.step(batch_of(fitting))
    fitting.reached, fitting.field.pruning_threshold = (
        0.6,
        0.002,
    )  # ever denser samples count as empty
    sending = fitting.rooms.next_step
    fitting.rooms.next_step = lambda: None
    with monkeypatch.context() as patch:
        for way in ("cpu", "tolist"):  # to the processor, that a watch does not see
            patch.setattr(torch.Tensor, way, None)
        with Watch() as watch:
            fitting.step(batch_of(fitting))
            fitting.field.occupancy._occupied_of_static(torch.arange(4000), 1000)
    assert not watch.met, watch.met
    assert any(name.startswith("thinner") for name in fitting.rooms.noted)
    fitting.rooms.next_step = sending
    fitting.rooms.next_step()
    # That the watch sees what there is to see:
    exact = begun(scene, False)
    with Watch() as watch:
        exact.step(batch_of(exact))
    assert len(watch.met) > 10


def test_numbers_come_two_steps_late_and_the_first_at_once():
    rooms = Rooms(True)
    told = []
    for step in range(6):
        told.append(rooms.late("number", torch.tensor(float(step))))
        rooms.next_step()
    assert told == [0, 0, 0, 1, 2, 3]
    exact = Rooms(False)
    assert exact.late("number", torch.tensor(7.0)) == 7.0


def test_rooms_end_on_the_last_entry_and_grow_with_what_they_have_to_hold():
    rooms = Rooms(True)
    mask = torch.zeros(40_000, dtype=torch.bool)
    mask[[3, 500, 39_998]] = True
    everything = rooms.chosen("few", mask)
    assert everything.shape[0] == 40_000, "nothing is known yet"
    assert everything[:4].tolist() == [3, 500, 39_998, 39_999] and (everything[3:] == 39_999).all()
    for _ in range(4):
        rooms.next_step()
        found = rooms.chosen("few", mask)
    assert found.shape[0] == module.LEAST and found[:3].tolist() == [3, 500, 39_998]
    mask[:20_000] = True
    assert rooms.chosen("few", mask).tolist()[-2:] == [1022, 39_999], "what has no room is left out"
    for _ in range(4):
        rooms.next_step()
        found = rooms.chosen("few", mask)
    assert found[20_000] == 39_998 and 30_000 <= found.shape[0] <= 30_100
    assert Rooms(False).chosen("few", mask).shape[0] == 20_001


def test_samples_that_find_no_room_are_left_out(scene):
    fitting = begun(scene, False)
    batch = fitting.pixels.draw(300, torch.Generator().manual_seed(0))
    start, end = torch.full((300,), fitting.field.near), torch.full((300,), 1e9)
    whole = fitting.field.march(batch.rays_o, batch.rays_d, start, end)
    n = int(whole.offsets[-1])
    wide = fitting.field.march(batch.rays_o, batch.rays_d, start, end, capacity=n + 50)
    assert torch.equal(wide.offsets, whole.offsets) and torch.equal(wide.t[:n], whole.t)
    assert not wide.t[n:].any() and not wide.dt[n:].any() and not wide.sigma[n:].any()
    assert torch.equal(wide.ray_index()[:n], whole.ray_index()) and wide.ray_index()[-1] == 299
    narrow = fitting.field.march(batch.rays_o, batch.rays_d, start, end, capacity=n // 2)
    m = n // 2 - 1
    assert torch.equal(narrow.offsets, whole.offsets.clamp_max(m)) and narrow.dt[-1] == 0
    assert torch.equal(narrow.t[:m], whole.t[:m]) and torch.equal(narrow.sigma[:m], whole.sigma[:m])
