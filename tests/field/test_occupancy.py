import pytest
import torch
from support.random_field import random_field

from climatenerf.field.occupancy import MAX_THRESHOLD, Occupancy


def ball(q, radius=0.5, density=200.0):
    return density * (q.norm(dim=-1) < radius).float()


def updated(times=1, fraction=1.0, density_at=ball, occupancy=None):
    generator = torch.Generator().manual_seed(0)
    occupancy = occupancy or Occupancy(cascades=2, side=16)
    for _ in range(times):
        occupancy.update(density_at, fraction, 0.95, generator)
    return occupancy


def inside_ball(occupancy, radius):
    """Cells entirely inside the ball of `radius`, and cells entirely outside."""
    cells = torch.arange(occupancy.density.numel())
    centre, size = occupancy.cell_centres(cells)
    half = size * 3**0.5 / 2
    distance = centre.norm(dim=-1)
    return distance + half < radius, distance - half > radius


def test_cell_centres_invert_cell_indices():
    field = random_field()
    occupancy = field.occupancy
    cells = torch.arange(occupancy.density.numel())
    centre, size = occupancy.cell_centres(cells)
    cascade = cells // occupancy.side**3
    # The middle of a cascade belongs to the next finer cascade.
    own = (centre.abs().amax(-1) > 2.0 ** (cascade - 1)) | (cascade == 0)
    offset = (torch.rand(centre.shape) - 0.5) * 0.99 * size[:, None]
    for q in (centre, centre + offset):
        found, inside = field.occupancy.cell_index(q)
        assert inside.all()
        assert torch.equal(found[own], cells[own])
        assert (found[~own] // occupancy.side**3 < cascade[~own]).all()
    _, inside = field.occupancy.cell_index(
        torch.tensor([[4.01, 0.0, 0.0], [0.0, -9.0, 0.0], [0.0, 0.0, 3.99]])
    )
    assert inside.tolist() == [False, False, True]


def test_marching_gives_samples_in_occupied_cells_only():
    field = random_field()
    with torch.no_grad():
        field.geometry_net[3].add_(6.0)  # samples below 1e-3 are pruned
    occupancy = field.occupancy
    cells = torch.arange(occupancy.density.numel())
    centre, size = occupancy.cell_centres(cells)
    cascade = cells // occupancy.side**3
    own = (centre.abs().amax(-1) > 2.0 ** (cascade - 1)) | (cascade == 0)
    selected = cells[own][torch.randperm(int(own.sum()))[:40]]
    for cell in selected.tolist():
        occupancy.occupied.zero_().view(-1)[cell] = 1
        middle = field.centre + field.unit * centre[cell]
        d = torch.nn.functional.normalize(torch.randn(1, 3), dim=-1)
        far = torch.full((1,), 20.0)
        samples = field.march(middle - 10 * d, d, torch.zeros(1), far, step_scale=0.2, stop=1e-9)
        assert samples.t.numel() > 0
        q = field.to_grid(middle - 10 * d + samples.t[:, None] * d)
        assert ((q - centre[cell]).abs() < 0.5 * size[cell] + 1e-5).all()


def test_a_full_update_occupies_matter_and_clears_empty_space():
    occupancy = updated()
    within, beyond = inside_ball(occupancy, 0.5)
    assert within.any() and beyond.any()
    occupied = occupancy.occupied.view(-1).bool()
    assert occupied[within].all() and not occupied[beyond].any()


def test_partial_updates_keep_matter_occupied():
    occupancy = updated(times=60, fraction=0.06, occupancy=updated())
    within, beyond = inside_ball(occupancy, 0.5)
    occupied = occupancy.occupied.view(-1).bool()
    assert occupied[within].all() and not occupied[beyond].any()


def test_updates_follow_a_changed_density():
    occupancy = updated()
    occupancy = updated(300, 0.2, lambda q: ball(q - 0.5, 0.3), occupancy)
    cells = torch.arange(occupancy.density.numel())
    centre, _ = occupancy.cell_centres(cells)
    occupied = occupancy.occupied.view(-1).bool()
    assert occupied[((centre - 0.5).norm(dim=-1) < 0.2) & (cells < 16**3)].all()
    assert not occupied[(centre + 0.3).norm(dim=-1) < 0.2].any()


def test_the_threshold_is_an_optical_depth_across_a_cell():
    size = 2.0 / 16
    for depth, expected in ((MAX_THRESHOLD * 0.9, 0), (MAX_THRESHOLD * 1.1, 1)):
        # One dense corner in each cascade lifts the mean above the fixed threshold.
        def density(q, depth=depth):
            cascade = (q.abs().amax(-1) > 1).float()
            return torch.where((q > 0).all(-1), 1e4, depth / (size * 2**cascade))

        occupancy = updated(density_at=density)
        centre, _ = occupancy.cell_centres(torch.arange(16**3))
        thin = (centre < 0).any(-1)
        assert (occupancy.occupied.view(-1)[: 16**3][thin] == expected).all()


def test_a_field_of_low_density_does_not_become_empty():
    occupancy = updated(density_at=lambda q: torch.rand(q.shape[0]) * 1e-3)
    assert 0.3 < occupancy.occupied.float().mean() < 0.7


@pytest.mark.parametrize("density", [200.0, 0.02])
def test_refining_halves_the_cells_and_keeps_their_state(density):
    occupancy = updated(density_at=lambda q: ball(q, 0.6, density))
    before = occupancy.occupied.clone()
    cells, densities = before.bool(), occupancy.density.clone()
    occupancy.refine()
    assert occupancy.side == 32 and occupancy.seen.shape == occupancy.occupied.shape
    for corner in range(8):
        x, y, z = corner & 1, corner >> 1 & 1, corner >> 2
        child = occupancy.occupied[:, x::2, y::2, z::2].bool()
        assert torch.equal(child, cells)
        assert torch.equal(occupancy.density[:, x::2, y::2, z::2], densities)


def test_neighbours_are_adjacent_cells_of_the_same_cascade():
    occupancy = Occupancy(cascades=3, side=8)
    cells = torch.arange(occupancy.density.numel())
    found = occupancy._neighbours(cells, torch.Generator().manual_seed(0))
    assert torch.equal(found // 512, cells // 512)
    (a, size), (b, _) = occupancy.cell_centres(cells), occupancy.cell_centres(found)
    steps = ((a - b) / size[:, None]).round()
    assert torch.allclose((a - b) / size[:, None], steps, atol=1e-5)
    assert steps.abs().max() == 1 and (steps != 0).any(-1).float().mean() > 0.8


def test_partial_updates_prefer_cells_beside_matter():
    """Partial updates find missing cells of a slab faster than uniform sampling."""

    def slab(q):
        return 500.0 * (q[:, 2].abs() < 0.125)

    closed = []
    for seed in range(4):
        generator = torch.Generator().manual_seed(seed)
        holed = Occupancy(cascades=2, side=32)
        holed.update(slab, 1.0, 0.95, generator)
        centre, _ = holed.cell_centres(torch.arange(holed.density.numel()))
        hole = (centre.norm(dim=-1) < 0.4) & (holed.occupied.view(-1) > 0)
        holed.density.view(-1)[hole] = 0.0
        holed.occupied.view(-1)[hole] = 0
        for _ in range(25):
            holed.update(slab, 0.02, 0.95, generator)
        closed.append(holed.occupied.view(-1)[hole].float().mean())
    # 25 uniform updates of half of 2 % of all cells would find 22 % of them.
    assert torch.stack(closed).mean() > 0.26, closed


def test_densities_of_ray_samples_are_recorded():
    field = random_field(full=True)
    with torch.no_grad():
        field.geometry_net[3].add_(6.0)
    field.occupancy.density.zero_()
    o = field.centre.expand(200, 3).contiguous()
    d = torch.nn.functional.normalize(torch.randn(200, 3), dim=-1)
    samples = field.march(o, d, torch.zeros(200), torch.full((200,), 1e9))
    selected = samples.t > 1.0
    field.sampler.record_density(o, d, samples, selected.nonzero()[:, 0])
    ray = samples.ray_index()
    cells, _ = field.occupancy.cell_index(field.to_grid(o[ray] + samples.t[:, None] * d[ray]))
    recorded = field.occupancy.density.view(-1)
    assert (recorded[cells[selected]] >= samples.sigma[selected] * field.unit * 0.999).all()
    untouched = torch.ones(recorded.shape[0], dtype=torch.bool)
    untouched[cells[selected]] = False
    assert (recorded[untouched] == 0).all()


@pytest.mark.parametrize("fraction", [0.02, 0.5])
def test_a_fixed_number_of_occupied_cells_is_selected_from_all_cascades(fraction):
    occupancy = Occupancy(2, 16)
    generator = torch.Generator().manual_seed(0)
    occupancy.occupied = (torch.rand(2, 16, 16, 16, generator=generator) < fraction).to(torch.uint8)
    drawn = occupancy._stratified(4000, generator)
    found = occupancy._occupied_of_static(drawn, 1000)
    exact = occupancy._occupied_of(drawn, 1000)
    occupied = occupancy.occupied.view(-1)
    assert found.shape == (1000,) and torch.isin(found, drawn).all()
    assert (occupied[found] > 0).float().mean() > (0.99 if fraction == 0.5 else 0.05)
    if fraction == 0.5:  # omitted cells are not only those at the end
        assert abs(found.float().mean() / exact.float().mean() - 1) < 0.1
    else:
        assert set(exact.tolist()) <= set(found.tolist())
