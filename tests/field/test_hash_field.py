import numpy as np
import torch
from support.random_field import directions, points, random_field

from climatenerf.field.activations import _Brightness
from climatenerf.ops import compositing, reference


def ends(n, t_max=1e9):
    return torch.zeros(n), torch.full((n,), t_max)


def test_density_is_zero_where_unoccupied_and_the_networks_elsewhere():
    field = random_field()
    x = points(field, 4000)
    occupied = field.occupancy.occupied_at(field.to_grid(x)).bool()
    density = field.density(x)
    assert 0.1 < occupied.float().mean() < 0.5
    assert (density[~occupied] == 0).all()
    expected = field.grid_density(field.to_grid(x[occupied])) / field.unit
    # Other neighbours in a vector may be rounded in another order.
    assert torch.allclose(density[occupied], expected, rtol=1e-5) and (density[occupied] > 0).all()
    lower, upper = field.bounds
    outside = torch.stack([upper + 0.01, lower - 0.01, field.centre + torch.tensor([0, 0, 11.0])])
    field.occupancy.occupied.fill_(1)
    assert (field.density(outside) == 0).all()
    assert (field.density(torch.stack([upper - 0.01, lower + 0.01])) > 0).all()


def test_density_with_gradient_is_the_density_that_marching_sees():
    field = random_field()
    q = field.to_grid(points(field, 3000, spread=4.0))
    with_gradient = field.density_with_gradient(reference.contract(q))
    assert torch.allclose(with_gradient, field.grid_density(q), rtol=5e-3)


def test_density_has_gradients_to_geometry_alone():
    field = random_field().requires_grad_(True)
    field.density_with_gradient(torch.rand(100, 3)).sum().backward()
    moved = {n for n, p in field.named_parameters() if p.grad is not None and p.grad.any()}
    assert moved == {"geometry_grid", *(f"geometry_net.{i}" for i in range(4))}


def dense(field):
    """The field with 150 times the density: marching leaves out samples thinner than 1e-3."""
    field.geometry_net[3].add_(5.0)
    return field


def test_marching_gives_the_density_along_the_ray():
    field = dense(random_field())
    n = 300
    o, d = points(field, n, spread=0.5), directions(n)
    samples = field.march(o, d, *ends(n), stop=1e-38)
    ray = samples.ray_index()
    assert samples.t.numel() > 3000
    x = o[ray] + samples.t[:, None] * d[ray]
    same = torch.isclose(samples.sigma, field.density(x), rtol=5e-3)
    # On a cell's very face rounding may take either side.
    assert same.float().mean() > 0.999
    inside = samples.offsets[1:] > samples.offsets[:-1]
    assert inside.any()
    first = samples.offsets[:-1][inside]
    falls = samples.t.diff() <= 0
    falls[(first[1:] - 1).clamp_min(0)] = False
    assert not falls.any(), "front to back"
    assert (samples.dt > 0).all()


def test_marching_integrates_the_density():
    """Optical depth along rays against a plain sum over many small steps."""
    field = dense(random_field())
    n, reach, count = 50, 6.0, 6000
    o, d = points(field, n, spread=0.3), directions(n)
    samples = field.march(o, d, *ends(n, reach), step_scale=0.25, stop=1e-38)
    depth = torch.zeros(n).index_add(0, samples.ray_index(), samples.sigma * samples.dt)
    t = (torch.arange(count) + 0.5) / count * reach
    x = o[:, None] + t[:, None] * d[:, None]
    plain = field.density(x.view(-1, 3)).view(n, count).sum(1) * reach / count
    # The step that reaches past a cell's face makes up to a step of difference each time.
    assert torch.allclose(depth, plain, rtol=0.05, atol=0.05 * float(plain.mean()))


def test_marching_keeps_to_the_lengths_asked_for():
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


def test_rays_do_not_depend_on_their_company():
    field = random_field()
    o, d = points(field, 500, spread=0.5), directions(500)
    all_of_them = field.march(o, d, *ends(500))
    for r in (0, 77, 499):
        one = field.march(o[r : r + 1], d[r : r + 1], *ends(1))
        part = slice(int(all_of_them.offsets[r]), int(all_of_them.offsets[r + 1]))
        for name in ("t", "dt", "sigma"):
            assert torch.equal(getattr(one, name), getattr(all_of_them, name)[part])


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


def test_marching_leaves_out_what_is_thin_and_nothing_else():
    field = dense(random_field(full=True))
    n = 200
    o, d = points(field, n, spread=0.5), directions(n)
    everything = field.march(o, d, *ends(n), stop=1e-38)
    tau = everything.sigma * everything.dt
    field.pruning_threshold = float(tau.median())
    some = field.march(o, d, *ends(n), stop=1e-38)
    least, most = (
        int((tau > factor * field.pruning_threshold).sum()) for factor in (1 + 1e-5, 1 - 1e-5)
    )
    assert 0.3 * len(tau) < least <= some.t.numel() <= most
    assert (some.sigma * some.dt).min() > (1 - 1e-5) * field.pruning_threshold


def test_rays_of_snow_and_sun_meet_what_cameras_do():
    """Beside matter steps are short, and each of them is thin."""
    field = random_field(full=True)
    with torch.no_grad():
        field.geometry_net[2].zero_()
        field.geometry_net[3].fill_(2.3)  # 10 a grid unit
    field.pruning_threshold = 0.1
    o, d = field.centre[None], torch.tensor([[0.0, 0.0, 1.0]])
    left = {}
    for name, own, start in (
        ("camera", field, 5 * field.unit),  # from five units away
        ("beside", field, 0.0),
        ("snow", field.observed_only(), 0.0),
    ):
        begin = torch.full((1,), start)
        samples = own.march(o - start * d, d, begin, begin + field.unit)
        weights, rest = compositing.render_weights(samples.sigma * samples.dt, samples.offsets)
        left[name] = float(rest)
    assert left["camera"] < 1e-3 and left["snow"] < 1e-3 and left["beside"] == 1
    assert field.pruning_threshold == 0.1, "the field itself is as it was"


def test_trusted_shares_parameters_and_drops_only_what_was_not_seen():
    field = random_field(full=True)
    with torch.no_grad():
        field.geometry_net[3].add_(4.0)  # dense enough for rays to end within the core
    o, d = points(field, 400, spread=0.2), directions(400)
    towards = d * torch.tensor([1.0, 1.0, 0.2])
    field.sampler.mark_seen(o, torch.nn.functional.normalize(towards, dim=-1))
    trusted = field.observed_only()
    for (name, mine), (_, shared) in zip(
        field.named_parameters(), trusted.named_parameters(), strict=True
    ):
        assert mine is shared, name
    assert field.occupancy.occupied.all(), "the field itself is as it was"
    seen = field.occupancy.seen.bool()
    kept = trusted.occupancy.occupied.bool()
    assert seen.any() and kept[seen].all()
    assert 0 < kept.sum() < kept.numel()
    # Everything kept is seen or touches what is seen.
    grown = torch.zeros_like(kept)
    for cascade, i, j, k in seen.nonzero().tolist():
        ranges = [slice(max(0, c - 1), c + 2) for c in (i, j, k)]
        grown[cascade, ranges[0], ranges[1], ranges[2]] = True
    assert torch.equal(kept, grown)
    x = points(field, 3000)
    cells, inside = field.occupancy.cell_index(field.to_grid(x))
    there = kept.view(-1)[cells] & inside
    density = trusted.density(x)
    assert torch.equal(density[there], field.density(x)[there])
    assert (density[~there] == 0).all()
    with torch.no_grad():
        field.geometry_net[3].add_(1.0)
    assert (trusted.density(x)[there] > density[there]).all()


def test_a_seen_cell_is_one_that_a_ray_ends_in():
    field = random_field(full=True)
    with torch.no_grad():
        field.geometry_net[3].add_(4.0)  # opaque everywhere: rays end at once
    o = field.centre[None] + torch.tensor([[0.3, 0.1, -0.2]])
    field.sampler.mark_seen(o, directions(1))
    where = field.occupancy.seen.view(-1).nonzero()[:, 0]
    centre, _ = field.occupancy.cell_centres(where)
    assert 1 <= where.numel() <= 4
    assert ((centre - field.to_grid(o)).norm(dim=-1) < 0.6).all()


def test_bounds_hold_the_outermost_cascade():
    field = random_field()
    lower, upper = field.bounds
    half = 2.5 * 4
    assert np.allclose(upper.numpy(), np.array([1.0, -2.0, 0.5]) + half)
    assert np.allclose(lower.numpy(), np.array([1.0, -2.0, 0.5]) - half)


def test_accumulated_colour_of_an_opaque_field_is_a_mean_of_its_colours():
    field = random_field(full=True)
    with torch.no_grad():
        field.geometry_net[3].add_(6.0)
    o, d = points(field, 100, spread=0.2), directions(100)
    samples = field.march(o, d, *ends(100), stop=1e-5)
    weights, left = compositing.render_weights(samples.sigma * samples.dt, samples.offsets)
    assert (left < 1e-3).all()
    ray = samples.ray_index()
    colour = field.colour(o[ray] + samples.t[:, None] * d[ray], d, ray)
    seen = compositing.accumulate(weights, colour, samples.offsets)
    low = torch.full((100, 3), torch.inf).scatter_reduce(
        0, ray[:, None].expand(-1, 3), colour, "amin"
    )
    high = torch.zeros(100, 3).scatter_reduce(0, ray[:, None].expand(-1, 3), colour, "amax")
    assert (seen >= low * (1 - 1e-2)).all() and (seen <= high * (1 + 1e-5)).all()


def test_a_display_value_is_a_softplus_and_black_is_no_trap():
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
    assert up.max() < -1e-3  # brighter is always in reach
