"""Values and gradients of each CPU kernel against its twin in `ops/reference.py`."""

import numpy as np
import pytest
import torch

from climatenerf.ops import compositing, encoding, marching, network, reference
from climatenerf.ops.cpu import encoding as cpu
from climatenerf.ops.cpu import simd


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(3)


def packed(generator, rays=40, limit=12):
    """Offsets of rays with fewer than `limit` samples each; at least one ray is empty."""
    counts = torch.randint(0, limit, (rays,), generator=generator)
    counts[3] = 0
    return torch.cat([torch.zeros(1, dtype=torch.long), counts.cumsum(0)])


def grid(generator, levels=4, log2_rows=9):
    table = torch.randn(levels, 2**log2_rows, 2, generator=generator)
    return table, torch.tensor([4, 9, 21, 50])[:levels]


@pytest.mark.parametrize("large", [False, True])
def test_hash_encoding_and_its_gradient_match_the_twin(generator, large):
    """Rows of `large` tables, dense and hashed, are prefetched."""
    table, resolutions = grid(generator, log2_rows=18 if large else 9)
    if large:
        resolutions = torch.tensor([9, 60, 90, 200])
        sides = (9, 60, 90, 200)
        assert [simd.exceeds_cache(table.numpy(), s) for s in sides] == [False, True, True, True]
    u = torch.rand(709, 3, generator=generator) * 0.999999
    u[0], u[1] = 0.0, 0.999999
    fast_table = table.clone().requires_grad_()
    slow_table = table.double().clone().requires_grad_()
    fast = encoding.hash_encode(u, fast_table, resolutions)
    slow = reference.hash_encode(u.double(), slow_table, resolutions)
    assert torch.allclose(fast.double(), slow, atol=2e-4)
    upstream = torch.randn(fast.shape, generator=generator)
    (fast * upstream).sum().backward()
    (slow * upstream.double()).sum().backward()
    assert torch.allclose(fast_table.grad.double(), slow_table.grad, atol=2e-3)


def test_gradient_to_positions_matches_the_twin(generator):
    """At cell faces the kernel and the twin use the same side."""
    table, resolutions = grid(generator)
    u = torch.rand(700, 3, generator=generator) * 0.999
    u[0], u[1] = 0.0, 0.5
    fast, slow = u.clone().requires_grad_(), u.double().clone().requires_grad_()
    out = encoding.hash_encode(fast, table, resolutions)
    upstream = torch.randn(out.shape, generator=generator)
    (out * upstream).sum().backward()
    (reference.hash_encode(slow, table.double(), resolutions) * upstream.double()).sum().backward()
    assert fast.grad is not None and slow.grad is not None
    error = (fast.grad.double() - slow.grad).abs()
    # Rounding can move a point near a cell face into either cell.
    assert error.quantile(0.99) < 1e-2 and error[1].max() < 1e-2, error.max()


def test_gradients_of_the_twins_pass_gradcheck(generator):
    table, resolutions = grid(generator, levels=2, log2_rows=4)
    u = (torch.rand(5, 3, generator=generator) * 0.9).double()
    assert torch.autograd.gradcheck(
        lambda t: reference.hash_encode(u, t, resolutions), table.double().requires_grad_()
    )
    assert torch.autograd.gradcheck(
        lambda p: reference.hash_encode(p, table.double(), resolutions), u.requires_grad_()
    )
    offsets = torch.tensor([0, 3, 3, 7])
    tau = torch.rand(7, generator=generator).double().requires_grad_()
    assert torch.autograd.gradcheck(lambda x: reference.render_weights(x, offsets), tau)
    s = torch.rand(7, generator=generator).double()
    s = torch.cat([s[:3].sort()[0], s[3:].sort()[0]])
    ds = torch.full_like(s, 0.01)
    weights = torch.rand(7, generator=generator).double().requires_grad_()
    assert torch.autograd.gradcheck(lambda w: reference.distortion(w, s, ds, offsets), weights)


def test_a_trilinear_function_is_reproduced_on_dense_levels():
    """A level that fits its table has no collisions, so a linear function is exact."""
    side = 5
    corners = torch.stack(
        torch.meshgrid(*[torch.arange(side + 1.0)] * 3, indexing="ij"), dim=-1
    ).permute(2, 1, 0, 3)  # x varies fastest in a table
    table = torch.zeros(1, 512, 2)
    table[0, : (side + 1) ** 3, 0] = (corners @ torch.tensor([1.0, 2.0, 3.0])).flatten()
    u = torch.rand(50, 3) * 0.99
    out = encoding.hash_encode(u, table, torch.tensor([side]))
    assert torch.allclose(out[:, 0], u * side @ torch.tensor([1.0, 2.0, 3.0]), atol=1e-4)


def random_network(generator, inputs, width):
    layers = [
        (torch.randn(inputs, width, generator=generator) * 0.3, torch.randn(width) * 0.1),
        (torch.randn(width, 1, generator=generator) * 0.3, torch.zeros(1)),
    ]
    return layers, [p for pair in layers for p in pair]


def test_density_matches_the_twin_inside_and_outside_the_core(generator):
    table, resolutions = grid(generator)
    layers, plain = random_network(generator, 8, 16)
    q = torch.randn(500, 3, generator=generator) * 2
    q[0] = 0.0
    out = marching.density(q, (table, resolutions, *plain))
    twin = reference.density(
        q.double(), table.double(), resolutions, [(w.double(), b.double()) for w, b in layers]
    )
    assert torch.allclose(out.double(), twin, rtol=5e-3)
    assert torch.isfinite(out).all()


@pytest.mark.parametrize(
    ("side", "skips", "fraction", "threshold"),
    [
        (8, (1,), 0.3, 1e-3),
        (8, (1,), 0.3, 0.05),
        (32, (8, 4, 1), 0.01, 1e-3),
        (32, (8, 4, 1), 0.002, 1e-3),
        (32, (8, 4, 1), 0.0, 1e-3),
    ],
)
def test_marching_matches_the_twin(generator, monkeypatch, side, skips, fraction, threshold):
    table, resolutions = grid(generator)
    layers, plain = random_network(generator, 8, 16)
    occupied = (torch.rand(3, side, side, side, generator=generator) < fraction).to(torch.uint8)
    skip = skips[0]
    occupied[0, -skip:] = 1  # cells at one side of the finest cascade
    blocks = occupied.unfold(1, skip, skip).unfold(2, skip, skip).unfold(3, skip, skip)
    cells = marching.cells_of(occupied)
    assert torch.equal(cells[1], blocks.amax((-3, -2, -1)))
    n = 40
    o = torch.randn(n, 3, generator=generator)
    d = torch.nn.functional.normalize(torch.randn(n, 3, generator=generator), dim=-1)
    d[0] = torch.tensor([0.0, 0.0, 1.0])  # along an axis
    o[1] = torch.tensor([9.0, 9.0, 9.0])  # outside all cascades
    jitter = torch.rand(n, generator=generator)
    near, far = torch.full((n,), 0.05), torch.full((n,), 1e9)
    far[2] = 0.5
    steps = (0.05, 0.02, threshold)
    monkeypatch.setattr(marching, "CPU_RAYS", 16)  # two parts
    offsets, found = marching.march(
        (o, d),
        torch.stack([near, far, jitter], dim=-1),
        cells,
        steps,
        1e-3,
        (table, resolutions, *plain),
    )
    counts, packed_samples = offsets.diff().numpy(), found.numpy()
    equal = 0
    for r in range(n):
        twin = reference.march(
            o[r],
            d[r],
            (0.05, float(far[r]), float(jitter[r])),
            occupied,
            steps,
            1e-3,
            lambda q: reference.density(q, table, resolutions, layers),
            skips,
        )
        own = packed_samples[:, counts[:r].sum() : counts[: r + 1].sum()]
        same = counts[r] == len(twin) and np.allclose(
            own, np.array(twin).reshape(-1, 3).T, rtol=2e-2
        )
        equal += same
    # Rounding can move a step that ends on a cell face into either cell.
    assert equal >= n - 2
    assert counts.sum() > 30


def test_rays_end_when_opaque_and_skip_empty_cells(generator):
    table, resolutions = grid(generator)
    _, (w1, b1, w2, _) = random_network(generator, 8, 16)
    net = (table, resolutions, w1, b1, w2, torch.full((1,), 6.0))  # dense everywhere
    rays = torch.zeros(1, 3), torch.tensor([[1.0, 0, 0]])
    for fill in (0, 1):
        occupied = torch.full((2, 8, 8, 8), fill, dtype=torch.uint8)
        span = torch.tensor([[0.0, 1e9, 0.0]])
        offsets, (_, dt, sigma) = marching.march(
            rays, span, marching.cells_of(occupied), (0.01, 0.0, 1e-3), 1e-3, net
        )
        if fill:
            tau = dt * sigma
            assert tau.sum() >= -np.log(1e-3) > tau[:-1].sum()
        else:
            assert offsets.tolist() == [0, 0]


def test_weights_and_their_gradient_match_the_twin(generator):
    offsets = packed(generator)
    n = int(offsets[-1])
    tau = torch.rand(n, generator=generator) * 3
    tau[0], tau[1] = 0.0, 40.0
    fast, slow = tau.clone().requires_grad_(), tau.double().requires_grad_()
    up_w = torch.randn(n, generator=generator)
    up_t = torch.randn(offsets.shape[0] - 1, generator=generator)
    w, transmittance = compositing.render_weights(fast, offsets)
    w2, transmittance2 = reference.render_weights(slow, offsets)
    assert torch.allclose(w.double(), w2, atol=1e-6)
    assert torch.allclose(transmittance.double(), transmittance2, atol=1e-6)
    ((w * up_w).sum() + (transmittance * up_t).sum()).backward()
    ((w2 * up_w.double()).sum() + (transmittance2 * up_t.double()).sum()).backward()
    assert torch.allclose(fast.grad.double(), slow.grad, atol=1e-5)


def test_weights_and_transmittance_sum_to_one(generator):
    offsets = packed(generator)
    tau = torch.rand(int(offsets[-1]), generator=generator) * 3
    w, transmittance = compositing.render_weights(tau, offsets)
    total = compositing.accumulate(w, torch.ones(len(w), 1), offsets)[:, 0] + transmittance
    assert torch.allclose(total, torch.ones_like(total), atol=1e-6)


def test_accumulation_matches_the_twin(generator):
    offsets = packed(generator)
    n = int(offsets[-1])
    w, v = torch.rand(n, generator=generator), torch.randn(n, 3, generator=generator)
    fast = [w.clone().requires_grad_(), v.clone().requires_grad_()]
    slow = [w.double().requires_grad_(), v.double().requires_grad_()]
    a, b = compositing.accumulate(*fast, offsets), reference.accumulate(*slow, offsets)
    assert torch.allclose(a.double(), b, atol=1e-5)
    up = torch.randn(a.shape, generator=generator)
    (a * up).sum().backward()
    (b * up.double()).sum().backward()
    for x, y in zip(fast, slow, strict=True):
        assert torch.allclose(x.grad.double(), y.grad, atol=1e-5)


@pytest.mark.parametrize("with_target", [True, False])
def test_compositing_of_the_surface_head_matches_the_twin(generator, with_target):
    offsets = packed(generator)
    n, rays = int(offsets[-1]), offsets.shape[0] - 1
    w, raw = torch.rand(n, generator=generator), torch.randn(n, 9, generator=generator)
    raw[0, :3], raw[1, :3] = 0.0, torch.tensor([1e-7, 0.0, 0.0])  # no direction
    target = torch.nn.functional.normalize(torch.randn(n, 3, generator=generator), dim=-1)
    raw[2, :3] = 5 * target[2]  # parallel
    up = torch.randn(rays, 6, generator=generator)
    up_distance = torch.rand(rays, generator=generator)
    found = []
    for run, dtype in ((compositing.surface, torch.float32), (reference.surface, torch.float64)):
        for transposed in (False, True):  # the memory layout of networks, and the contiguous one
            values = raw.T.contiguous().T if transposed else raw
            values = leaf(values, dtype)
            goal = target.to(dtype) if with_target else None
            logits, distance = run(w.to(dtype), values, goal, offsets)
            ((logits * up.to(dtype)).sum() + (distance * up_distance.to(dtype)).sum()).backward()
            grad = values.grad
            assert torch.isfinite(grad).all()
            found.append([logits.detach(), distance.detach(), grad[2:], grad[:2] * 1e-6])
    for fast in found[:2]:
        for a, b in zip(fast, found[2], strict=True):
            assert (a.double() - b).abs().max() < 1e-5 * max(1.0, float(b.abs().max()))
    assert (float(found[0][1].max()) > 0) == with_target


def test_distortion_matches_the_double_sum(generator):
    offsets = packed(generator)
    n = int(offsets[-1])
    s = torch.empty(n)
    for a, b in zip(offsets[:-1].tolist(), offsets[1:].tolist(), strict=True):
        s[a:b] = torch.rand(b - a, generator=generator).sort()[0]
    ds = torch.rand(n, generator=generator) * 0.1
    w = torch.rand(n, generator=generator)
    fast, slow = w.clone().requires_grad_(), w.double().requires_grad_()
    a = compositing.distortion(fast, s, ds, offsets)
    b = reference.distortion(slow, s.double(), ds.double(), offsets)
    assert torch.allclose(a.double(), b, atol=1e-5)
    up = torch.randn(a.shape, generator=generator)
    (a * up).sum().backward()
    (b * up.double()).sum().backward()
    assert torch.allclose(fast.grad.double(), slow.grad, atol=1e-4)


def leaf(tensor, dtype):
    return tensor.clone().to(dtype).requires_grad_()


KINDS = ["one hidden layer", "shared", "shared, shuffled", "two layers", "two layers, shared"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "widths", [(16, 32, 1), (13, 22, 7)]
)  # multiples of a block, and remainders
def test_network_matches_the_twin_and_autograd(generator, kind, widths):
    n, rays = 9000, 2000  # more than two chunks
    inputs, hidden, outputs = widths
    sizes = [inputs, hidden, *([8] if kind.startswith("two layers") else []), outputs]
    layers = [
        (torch.randn(a, b, generator=generator), torch.randn(b, generator=generator))
        for a, b in zip(sizes[:-1], sizes[1:], strict=True)
    ]
    x = torch.randn(n, inputs, generator=generator)
    shared = torch.randn(rays, hidden, generator=generator)
    row = torch.randint(0, rays, (n,), generator=generator)
    row[100:3000] = 7  # a ray longer than a chunk
    if kind != "shared, shuffled":
        row = row.sort()[0]
    up = torch.randn(n, outputs, generator=generator)
    grads = []
    for run, dtype in ((network.mlp, torch.float32), (reference.mlp, torch.float64)):
        own = [tuple(leaf(p, dtype) for p in pair) for pair in layers]
        given = [leaf(x, dtype), leaf(shared, dtype)]
        if "shared" in kind:
            out = run(given[0], own, given[1], row)
        else:
            out, given = run(given[0], own), given[:1]
        (out * up.to(dtype)).sum().backward()
        grads.append([out, *[t.grad for t in given], *[p.grad for pair in own for p in pair]])
    for fast, slow in zip(*grads, strict=True):
        assert (fast.double() - slow).abs().max() < 1e-5 * slow.abs().max()


def test_layer_gradients_do_not_depend_on_input_gradients(generator):
    layers, _ = random_network(generator, 8, 16)
    x = torch.randn(300, 8, generator=generator)
    found = []
    for needed in (True, False):
        own = [tuple(leaf(p, torch.float32) for p in pair) for pair in layers]
        network.mlp(x.clone().requires_grad_(needed), own).sum().backward()
        found.append([p.grad for pair in own for p in pair])
    for a, b in zip(*found, strict=True):
        assert torch.equal(a, b)


def test_denormal_gradients_are_flushed_to_zero(generator):
    """Denormal numbers are slow on some processors; small normal ones are kept."""
    layers, _ = random_network(generator, 8, 16)
    x = torch.randn(300, 8, generator=generator)
    for size, kept in ((1e-39, False), (1e-31, False), (1e-25, True)):
        own = [tuple(leaf(p, torch.float32) for p in pair) for pair in layers]
        (size * network.mlp(x, own)).sum().backward()
        assert bool(own[0][0].grad.any()) == kept, size


def test_encodings_do_not_depend_on_the_number_of_threads(generator):
    table, resolutions = grid(generator)
    u = torch.rand(1000, 3, generator=generator).numpy()
    levels = table.shape[0]
    up = torch.randn(2 * levels, 1000, generator=generator).numpy()
    found = []
    for threads in (1, 3, 99):  # fewer than levels, and more
        out, grads = np.empty_like(up), np.zeros(table.shape, np.float32)
        cpu._hash_encode(u, table.numpy(), resolutions.numpy(), out, threads)
        cpu._hash_encode_backward(u, up, resolutions.numpy(), grads, threads)
        found.append((out, grads))
    for other in found[1:]:
        assert np.array_equal(found[0][0], other[0]) and np.array_equal(found[0][1], other[1])
    assert np.abs(found[0][1]).sum() > 0


def test_a_network_of_no_samples_has_empty_output():
    layers = [(torch.ones(4, 8), torch.ones(8)), (torch.ones(8, 2), torch.ones(2))]
    x = torch.ones(0, 4, requires_grad=True)
    out = network.mlp(x, layers, torch.ones(3, 8), torch.zeros(0, dtype=torch.long))
    assert out.shape == (0, 2)
    out.sum().backward()
    assert x.grad is not None and x.grad.shape == (0, 4)


def test_merging_two_lists_matches_the_twin(generator):
    lists = []
    for _ in range(2):
        offsets = packed(generator)
        t = torch.empty(int(offsets[-1]))
        for a, b in zip(offsets[:-1].tolist(), offsets[1:].tolist(), strict=True):
            t[a:b] = torch.rand(b - a, generator=generator).sort()[0]
        lists += [t, offsets]
    order, offsets = compositing.merge_order(*lists)
    twin, twin_offsets = reference.merge_order(*lists)
    assert torch.equal(order, twin)
    assert torch.equal(offsets, twin_offsets)


def test_contraction_is_bounded_invertible_and_has_finite_gradients():
    q = (torch.randn(1000, 3) * 5).double().requires_grad_()
    u = reference.contract(q)
    assert (u >= 0).all() and (u < 1).all()
    c = 4 * u - 2
    m = c.norm(dim=-1, keepdim=True)
    back = torch.where(m <= 1, c, c / m / (2 - m))
    assert torch.allclose(back, q, rtol=1e-6)
    zero = torch.zeros(1, 3, requires_grad=True)
    reference.contract(zero).sum().backward()
    assert torch.isfinite(zero.grad).all()
    u.sum().backward()
    assert torch.isfinite(q.grad).all()
