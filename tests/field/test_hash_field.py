import numpy as np
import torch
from support.random_field import directions, points, random_field

from climatenerf.field.activations import _Brightness
from climatenerf.ops import compositing, reference


def ends(n, t_max=1e9):
    return torch.zeros(n), torch.full((n,), t_max)


def test_density_is_zero_in_empty_cells_and_the_network_output_elsewhere():
    field = random_field()
    x = points(field, 4000)
    occupied = field.occupancy.occupied_at(field.to_grid(x)).bool()
    density = field.density(x)
    assert 0.1 < occupied.float().mean() < 0.5
    assert (density[~occupied] == 0).all()
    expected = field.grid_density(field.to_grid(x[occupied])) / field.unit
    # The position of a point within a SIMD vector affects its rounding.
    assert torch.allclose(density[occupied], expected, rtol=1e-5) and (density[occupied] > 0).all()
    lower, upper = field.bounds
    outside = torch.stack([upper + 0.01, lower - 0.01, field.centre + torch.tensor([0, 0, 11.0])])
    field.occupancy.occupied.fill_(1)
    assert (field.density(outside) == 0).all()
    assert (field.density(torch.stack([upper - 0.01, lower + 0.01])) > 0).all()


def test_density_with_gradient_equals_the_density_of_marching():
    field = random_field()
    q = field.to_grid(points(field, 3000, spread=4.0))
    with_gradient = field.density_with_gradient(reference.contract(q))
    assert torch.allclose(with_gradient, field.grid_density(q), rtol=5e-3)


def test_density_has_gradients_to_geometry_parameters_only():
    field = random_field().requires_grad_(True)
    field.density_with_gradient(torch.rand(100, 3)).sum().backward()
    moved = {n for n, p in field.named_parameters() if p.grad is not None and p.grad.any()}
    assert moved == {"geometry_grid", *(f"geometry_net.{i}" for i in range(4))}


def dense(field):
    """The field with 150 times the density, so that marching prunes few samples."""
    field.geometry_net[3].add_(5.0)
    return field


def test_samples_have_the_density_at_their_positions():
    field = dense(random_field())
    n = 300
    o, d = points(field, n, spread=0.5), directions(n)
    samples = field.march(o, d, *ends(n), stop=1e-38)
    ray = samples.ray_index()
    assert samples.t.numel() > 3000
    x = o[ray] + samples.t[:, None] * d[ray]
    same = torch.isclose(samples.sigma, field.density(x), rtol=5e-3)
    # Rounding can move a point on a cell face into the neighbouring cell.
    assert same.float().mean() > 0.999
    inside = samples.offsets[1:] > samples.offsets[:-1]
    assert inside.any()
    first = samples.offsets[:-1][inside]
    falls = samples.t.diff() <= 0
    falls[(first[1:] - 1).clamp_min(0)] = False
    assert not falls.any(), "front to back"
    assert (samples.dt > 0).all()


def test_optical_depth_of_samples_is_the_integral_of_density():
    """Compare optical depths along rays with sums over many small steps."""
    field = dense(random_field())
    n, reach, count = 50, 6.0, 6000
    o, d = points(field, n, spread=0.3), directions(n)
    samples = field.march(o, d, *ends(n, reach), step_scale=0.25, stop=1e-38)
    depth = torch.zeros(n).index_add(0, samples.ray_index(), samples.sigma * samples.dt)
    t = (torch.arange(count) + 0.5) / count * reach
    x = o[:, None] + t[:, None] * d[:, None]
    plain = field.density(x.view(-1, 3)).view(n, count).sum(1) * reach / count
    # A step that crosses a cell face causes an error of at most one step.
    assert torch.allclose(depth, plain, rtol=0.05, atol=0.05 * float(plain.mean()))


def test_marching_respects_the_limits_of_each_ray():
    field = dense(random_field(full=True))
    n = 100
    o, d = points(field, n, spread=0.3), directions(n)
    samples = field.march(o, d, torch.full((n,), 0.7), torch.full((n,), 2.0), stop=1e-38)
    assert (samples.t - samples.dt / 2 >= 0.7 - 1e-4).all()
    assert (samples.t + samples.dt / 2 <= 2.0 + 1e-4).all()
    length = torch.zeros(n).index_add(0, samples.ray_index(), samples.dt)
    assert torch.allclose(length, torch.full((n,), 1.3), atol=1e-3)
    none = field.march(o, d, torch.full((n,), 2.0), torch.full((n,), 1.0))
    assert none.t.numel() == 0 and none.offsets.shape == (n + 1,)


def test_samples_of_a_ray_do_not_depend_on_other_rays():
    field = random_field()
    o, d = points(field, 500, spread=0.5), directions(500)
    together = field.march(o, d, *ends(500))
    for r in (0, 77, 499):
        one = field.march(o[r : r + 1], d[r : r + 1], *ends(1))
        part = slice(int(together.offsets[r]), int(together.offsets[r + 1]))
        for name in ("t", "dt", "sigma"):
            assert torch.equal(getattr(one, name), getattr(together, name)[part])


def test_sample_positions_are_contracted_points():
    field = random_field()
    o, d = points(field, 200), directions(200)
    samples = field.march(o, d, *ends(200))
    ray = samples.ray_index()
    x = o[ray] + samples.t[:, None] * d[ray]
    u = field.sample_positions(o, d, samples)
    assert torch.allclose(u, reference.contract(field.to_grid(x)), atol=1e-5)


def test_colour_with_a_ray_index_equals_colour_per_sample():
    field = random_field()
    x, d = points(field, 3000), directions(40)
    ray = torch.randint(0, 40, (3000,), generator=torch.Generator().manual_seed(1))
    by_ray = field.colour(x, d, ray)
    assert torch.allclose(by_ray, field.colour(x, d[ray]), atol=1e-5)
    assert (by_ray >= 0).all() and torch.isfinite(by_ray).all()
    assert by_ray.std() > 0.01


def test_colour_and_sky_use_the_mean_appearance():
    field = random_field()
    x, d = points(field, 100), directions(100)
    u = reference.contract(field.to_grid(x))
    mean = field.embeddings.mean(0, keepdim=True).expand(100, -1)
    expected = field.colour_at(u, torch.arange(100), d, mean)
    assert torch.allclose(field.colour(x, d), expected, atol=1e-5)
    assert torch.equal(field.sky(d), field.sky_colour(d, mean))
    other = field.sky_colour(d, field.embeddings[:1].expand(100, -1))
    assert (other - field.sky(d)).abs().max() > 1e-3


def test_changing_the_appearance_leaves_density_bit_identical():
    field = random_field()
    x, d = points(field, 2000), directions(2000)
    density, colour = field.density(x), field.colour(x, d)
    march = field.march(x, d, *ends(2000))
    with torch.no_grad():
        for name, parameter in field.named_parameters():
            if not name.startswith("geometry"):
                parameter.mul_(1.7).add_(0.1)
    assert torch.equal(field.density(x), density)
    again = field.march(x, d, *ends(2000))
    assert torch.equal(again.sigma, march.sigma) and torch.equal(again.t, march.t)
    assert (field.colour(x, d) - colour).abs().max() > 0.01


def test_marching_prunes_exactly_the_samples_below_the_threshold():
    field = dense(random_field(full=True))
    n = 200
    o, d = points(field, n, spread=0.5), directions(n)
    everything = field.march(o, d, *ends(n), stop=1e-38)
    tau = everything.sigma * everything.dt
    field.pruning_threshold = float(tau.median())
    pruned = field.march(o, d, *ends(n), stop=1e-38)
    minimum, maximum = (
        int((tau > factor * field.pruning_threshold).sum()) for factor in (1 + 1e-5, 1 - 1e-5)
    )
    assert 0.3 * len(tau) < minimum <= pruned.t.numel() <= maximum
    assert (pruned.sigma * pruned.dt).min() > (1 - 1e-5) * field.pruning_threshold


def test_rays_that_start_inside_matter_are_absorbed_like_camera_rays():
    """Rays that start inside matter have short steps, each below the threshold."""
    field = random_field(full=True)
    with torch.no_grad():
        field.geometry_net[2].zero_()
        field.geometry_net[3].fill_(2.3)  # 10 per grid unit
    field.pruning_threshold = 0.1
    o, d = field.centre[None], torch.tensor([[0.0, 0.0, 1.0]])
    transmittance = {}
    for name, view, start in (
        ("camera", field, 5 * field.unit),  # from five units away
        ("inside", field, 0.0),
        ("snow", field.observed_only(), 0.0),
    ):
        begin = torch.full((1,), start)
        samples = view.march(o - start * d, d, begin, begin + field.unit)
        _, remaining = compositing.render_weights(samples.sigma * samples.dt, samples.offsets)
        transmittance[name] = float(remaining)
    assert transmittance["camera"] < 1e-3 and transmittance["snow"] < 1e-3
    assert transmittance["inside"] == 1
    assert field.pruning_threshold == 0.1, "the field itself is unchanged"


def test_observed_only_shares_parameters_and_empties_unseen_cells():
    field = random_field(full=True)
    with torch.no_grad():
        field.geometry_net[3].add_(4.0)  # dense enough for rays to end within the core
    o, d = points(field, 400, spread=0.2), directions(400)
    towards = d * torch.tensor([1.0, 1.0, 0.2])
    field.sampler.mark_seen(o, torch.nn.functional.normalize(towards, dim=-1))
    observed = field.observed_only()
    for (name, original), (_, shared) in zip(
        field.named_parameters(), observed.named_parameters(), strict=True
    ):
        assert original is shared, name
    assert field.occupancy.occupied.all(), "the field itself is unchanged"
    seen = field.occupancy.seen.bool()
    kept = observed.occupancy.occupied.bool()
    assert seen.any() and kept[seen].all()
    assert 0 < kept.sum() < kept.numel()
    # A cell stays occupied if it is seen or adjacent to a seen cell.
    grown = torch.zeros_like(kept)
    for cascade, i, j, k in seen.nonzero().tolist():
        ranges = [slice(max(0, c - 1), c + 2) for c in (i, j, k)]
        grown[cascade, ranges[0], ranges[1], ranges[2]] = True
    assert torch.equal(kept, grown)
    x = points(field, 3000)
    cells, inside = field.occupancy.cell_index(field.to_grid(x))
    there = kept.view(-1)[cells] & inside
    density = observed.density(x)
    assert torch.equal(density[there], field.density(x)[there])
    assert (density[~there] == 0).all()
    with torch.no_grad():
        field.geometry_net[3].add_(1.0)
    assert (observed.density(x)[there] > density[there]).all()


def test_mark_seen_marks_the_cells_in_which_rays_end():
    field = random_field(full=True)
    with torch.no_grad():
        field.geometry_net[3].add_(4.0)  # opaque everywhere: rays end at once
    o = field.centre[None] + torch.tensor([[0.3, 0.1, -0.2]])
    field.sampler.mark_seen(o, directions(1))
    where = field.occupancy.seen.view(-1).nonzero()[:, 0]
    centre, _ = field.occupancy.cell_centres(where)
    assert 1 <= where.numel() <= 4
    assert ((centre - field.to_grid(o)).norm(dim=-1) < 0.6).all()


def test_bounds_enclose_the_outermost_cascade():
    field = random_field()
    lower, upper = field.bounds
    half = 2.5 * 4
    assert np.allclose(upper.numpy(), np.array([1.0, -2.0, 0.5]) + half)
    assert np.allclose(lower.numpy(), np.array([1.0, -2.0, 0.5]) - half)


def test_composited_colour_of_an_opaque_field_is_a_mean_of_sample_colours():
    field = random_field(full=True)
    with torch.no_grad():
        field.geometry_net[3].add_(6.0)
    o, d = points(field, 100, spread=0.2), directions(100)
    samples = field.march(o, d, *ends(100), stop=1e-5)
    weights, transmittance = compositing.render_weights(samples.sigma * samples.dt, samples.offsets)
    assert (transmittance < 1e-3).all()
    ray = samples.ray_index()
    colour = field.colour(o[ray] + samples.t[:, None] * d[ray], d, ray)
    seen = compositing.accumulate(weights, colour, samples.offsets)
    low = torch.full((100, 3), torch.inf).scatter_reduce(
        0, ray[:, None].expand(-1, 3), colour, "amin"
    )
    high = torch.zeros(100, 3).scatter_reduce(0, ray[:, None].expand(-1, 3), colour, "amax")
    assert (seen >= low * (1 - 1e-2)).all() and (seen <= high * (1 + 1e-5)).all()


def test_display_values_are_a_softplus_with_a_gradient_at_black():
    x = torch.linspace(-6, 3, 200, requires_grad=True)
    y = _Brightness.apply(x)
    plain = x.detach().clone().requires_grad_()
    softplus = torch.nn.functional.softplus(plain, beta=8.0)
    assert torch.equal(y, softplus)
    (down,) = torch.autograd.grad(y.sum(), x, retain_graph=True)
    (up,) = torch.autograd.grad(-y.sum(), x)
    (slope,) = torch.autograd.grad(softplus.sum(), plain)
    assert torch.allclose(down[x > -0.4], slope[x > -0.4]) and (down[x < -0.6] == 0).all()
    assert (up <= -0.9 * slope).all() and (up < 0).all()
    assert up.max() < -1e-3  # a brighter target always gives a gradient
