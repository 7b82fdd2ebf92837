"""The metaball kernels against their slow twin."""

import math

import numpy as np
import pytest
import torch

from climatenerf.ops.cpu import metaballs
from climatenerf.ops.cpu.metaballs import BRICK, HEIGHT_UNIT, RADIUS, STORED, SUPPORT, Lattice
from climatenerf.ops.metaballs_reference import metaball_kernel, metaball_sums

SPACING = 0.05


def dense_lattice(fill: np.ndarray, height: np.ndarray, shade: np.ndarray) -> Lattice:
    """A lattice of one cascade with dense arrays of vertices; their sides are multiples of 8."""
    bricks = np.array(fill.shape) // BRICK
    padded = [np.pad(a, ((1, 2), (1, 2), (1, 2))) for a in (fill, height, shade)]
    parts = [[], [], []]
    for i, j, m in np.ndindex(*bricks):
        window = tuple(slice(c * BRICK, c * BRICK + STORED) for c in (i, j, m))
        for part, array in zip(parts, padded, strict=True):
            part.append(array[window])
    band, near = metaballs.occupied_cells(np.stack(parts[0]))
    return Lattice(
        lower=np.array([[-0.3, 0.2, 0.1]]),
        spacing=np.array([SPACING]),
        bricks=bricks[None].astype(np.int64),
        start=np.zeros(1, np.int64),
        index=np.arange(bricks.prod(), dtype=np.int32),
        fill=np.stack(parts[0]),
        height=np.stack(parts[1]),
        shade=np.stack(parts[2]),
        band=band,
        near=near,
        burial=np.array([1e9]),
    )


@pytest.fixture(scope="module")
def random_lattice():
    rng = np.random.default_rng(0)
    size = (3 * BRICK, 4 * BRICK, 2 * BRICK)
    fill = (rng.integers(0, 256, size) * (rng.random(size) < 0.5)).astype(np.uint8)
    height = rng.integers(-2000, 2000, size).astype(np.int16)
    shade = rng.integers(0, 256, size).astype(np.uint8)
    # Points over several bricks (one brick of margin in x and y, the radius of the balls in z).
    points = rng.uniform([8, 8, 3], [15.9, 23.9, 12], (300, 3)) * SPACING + [-0.3, 0.2, 0.1]
    return fill, height, shade, points.astype(np.float32)


def test_the_kernel_has_known_values():
    r = torch.tensor([0.0, 0.5, 1.0, 1.5, 1.6], dtype=torch.float64) * 0.2
    constant = 315 / (64 * math.pi * 1.5**7)
    expected = [constant * 2.25**3, constant * 8.0, constant * 1.25**3, 0.0, 0.0]
    assert metaball_kernel(r, 0.2).tolist() == pytest.approx(expected, abs=1e-12)
    assert expected[0] == pytest.approx(1.044, abs=1e-3)


def test_gradients_of_the_twin_pass_gradcheck():
    torch.manual_seed(0)
    fractions = torch.rand(6, 6, 6, dtype=torch.float64)
    values = torch.rand(6, 6, 6, 2, dtype=torch.float64)
    origin = torch.zeros(3, dtype=torch.float64)
    points = (1 + 0.5 * torch.rand(4, 3, dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda x: metaball_sums(x, fractions, values, origin, 0.5, 0.5 * RADIUS), points
    )


def slope_bias(gradient):
    """How far the mean height of filled vertices lies below that of a position, in spacings.

    From the gradient of the sum per spacing.
    """
    length = np.linalg.norm(gradient, axis=1)
    up = -gradient[:, 2] / np.maximum(length, 1e-9)
    slope = np.arccos(np.clip(up, 0.5, 1))
    fade = np.clip((up - 0.4) / 0.1, 0, 1) * np.clip((length - 0.3) / 0.15, 0, 1)
    return fade * 0.545 * np.sin(slope) * np.tan(slope)


def test_sums_and_gradients_equal_the_twin(random_lattice):
    fill, height, shade, points = random_lattice
    sums, gradients, rest = metaballs.evaluate(points, dense_lattice(fill, height, shade))
    x = torch.from_numpy(points.astype(np.float64)).requires_grad_()
    z = 0.1 + SPACING * np.arange(fill.shape[2])
    ground = z - height * HEIGHT_UNIT * SPACING
    values = torch.from_numpy(np.stack([ground, shade / 255], -1))
    expected, means = metaball_sums(
        x,
        torch.from_numpy(fill / 255),
        values,
        torch.tensor([-0.3, 0.2, 0.1], dtype=torch.float64),
        SPACING,
        RADIUS * SPACING,
    )
    expected.sum().backward()
    assert sums == pytest.approx(expected.detach().numpy(), abs=2e-5)
    assert gradients == pytest.approx(x.grad.numpy(), abs=2e-3)  # of about 10 per metre
    bias = SPACING * slope_bias(SPACING * x.grad.numpy())
    height = points[:, 2] - means[:, 0].detach().numpy() + bias
    assert rest[:, 0] == pytest.approx(height, abs=2e-4)
    assert rest[:, 1] == pytest.approx(means[:, 1].detach().numpy(), abs=1e-4)


def test_sums_are_smooth_across_cells_and_bricks(random_lattice):
    fill, height, shade, _ = random_lattice
    lattice = dense_lattice(fill, height, shade)
    steps, step = 4000, 1e-4  # a line of 0.4 m through eight cells and two bricks
    direction = np.array([0.55, 0.8, 0.24])
    line = np.array([0.11, 0.63, 0.32]) + np.arange(steps)[:, None] * step * direction
    sums, gradients, _ = metaballs.evaluate(line.astype(np.float32), lattice)
    along = gradients @ direction
    # C0: no step exceeds the slope times the distance. C1: steps of the slope are small, and it is
    # the derivative of the sum.
    assert np.abs(along).max() > 1.0
    assert np.abs(np.diff(sums)).max() < 1.1 * np.abs(along).max() * step + 1e-5
    assert np.abs(np.diff(along)).max() < 0.02 * np.abs(along).max()
    lag = 20
    slope = (sums[lag:] - sums[:-lag]) / (lag * step)
    assert slope == pytest.approx(along[lag // 2 : -lag // 2], abs=0.05)


def test_slopes_stay_below_the_bound_of_the_march():
    rng = np.random.default_rng(1)
    size = (3 * BRICK, 3 * BRICK, 3 * BRICK)
    blank = np.zeros(size, np.int16)
    points = (rng.uniform(8.1, 15.9, (20000, 3)) * SPACING + [-0.3, 0.2, 0.1]).astype(np.float32)
    lines = rng.normal(size=points.shape)
    lines /= np.linalg.norm(lines, axis=1, keepdims=True)
    aside = 0.02  # spacings
    beside = [(points + s * aside * SPACING * lines).astype(np.float32) for s in (1, -1)]
    steepest, most_curved = 0.0, 0.0
    for normal in ((1, 0, 0), (1, 1, 0), (1, 1, 1), (3, 2, 1), None):
        if normal is None:
            fill = rng.random(size) < 0.5
        else:
            vertex = np.stack(np.meshgrid(*[np.arange(n) - 11.3 for n in size], indexing="ij"), -1)
            fill = vertex @ np.array(normal) > 0
        lattice = dense_lattice(255 * fill.astype(np.uint8), blank, blank.astype(np.uint8))
        gradients = metaballs.evaluate(points, lattice)[1]
        steepest = max(steepest, float(np.linalg.norm(gradients, axis=1).max()) * SPACING)
        ahead, behind = (metaballs.evaluate(each, lattice)[1] for each in beside)
        second = ((ahead - behind) * lines).sum(1) * SPACING / (2 * aside)
        most_curved = max(most_curved, float(second.max()))
    assert 0.5 < steepest < metaballs._SLOPE_BOUND
    assert 0.7 < most_curved < metaballs._CURVATURE_BOUND


def test_a_step_towards_the_snow_is_never_too_long():
    """Rays that graze a wavy surface meet it where a march in small steps does."""
    rng = np.random.default_rng(3)
    size = (4 * BRICK, 4 * BRICK, 3 * BRICK)
    x, y, z = np.meshgrid(*[np.arange(n) for n in size], indexing="ij")
    fill = np.clip(12 + 1.5 * np.sin(0.7 * x) * np.cos(0.5 * y) - z + 0.5, 0, 1)
    lattice = dense_lattice(
        np.round(255 * fill).astype(np.uint8), np.zeros(size, np.int16), np.ones(size, np.uint8)
    )
    n = 400
    start = np.stack([np.full(n, 8.3), rng.uniform(9, 23, n), rng.uniform(11, 16, n)], 1)
    towards = np.stack([np.ones(n), rng.uniform(-0.2, 0.2, n), rng.uniform(-0.2, 0.1, n)], 1)
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    corner = np.array([-0.3, 0.2, 0.1])
    origins = (start * SPACING + corner).astype(np.float32)
    offsets, t, dt, _ = march(lattice, origins, towards, t_max=15 * SPACING)
    lengths = np.linspace(0, 15, 3000) * SPACING
    met = 0
    for r in range(n):
        line = origins[r] + lengths[:, None] * towards[r]
        inside = metaballs.evaluate(line.astype(np.float32), lattice)[0] > 0.47
        samples = slice(offsets[r], offsets[r + 1])
        if not inside.any():
            continue
        met += 1
        first = lengths[inside.argmax()]
        assert (t[samples] - dt[samples] / 2).min() < first + 0.05 * SPACING
    assert met > 100


def half_space(level: float) -> Lattice:
    """A lattice filled below `level` (in spacings above the corner), prefiltered with a ramp."""
    size = (4 * BRICK, 4 * BRICK, 3 * BRICK)
    z = np.broadcast_to(np.arange(size[2]), size)
    fill = np.round(255 * np.clip(level - z + 0.5, 0, 1)).astype(np.uint8)
    return dense_lattice(fill, np.zeros(size, np.int16), fill)


def march(lattice, origins, directions, t_min=0.0, t_max=np.inf):
    n = len(origins)
    limits = (np.full(n, limit, np.float32) for limit in (t_min, t_max))
    return metaballs.march(
        np.asarray(origins, np.float32), np.asarray(directions, np.float32), *limits, lattice
    )


def test_march_finds_the_surface():
    lattice = half_space(12.0)
    surface = 0.1 + 12 * SPACING
    rng = np.random.default_rng(2)
    origins = np.append(
        rng.uniform([0.45, 0.95], [0.55, 1.05], (200, 2)), np.full((200, 1), 2.0), 1
    )
    directions = np.append(rng.uniform(-0.2, 0.2, (200, 2)), np.full((200, 1), -1.0), 1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    offsets, t, dt, sigma = march(lattice, origins, directions)
    for r in range(200):
        part = slice(offsets[r], offsets[r + 1])
        depth = np.concatenate([[0], np.cumsum(sigma[part] * dt[part])])
        assert 6.9 < depth[-1] < 12  # opaque, and ends soon after
        assert np.all(np.diff(t[part]) > 0)
        weights = np.exp(-depth[:-1]) - np.exp(-depth[1:])
        where = np.sum(weights * t[part]) / weights.sum()
        height = origins[r, 2] + where * directions[r, 2]
        assert height == pytest.approx(surface, abs=0.03 * SPACING)
    assert np.diff(offsets).max() <= 16


def test_march_respects_its_limits_and_skips_empty_space():
    lattice = half_space(12.0)
    down = [[0.0, 0.0, -1.0]]
    origin = [[0.4, 0.9, 2.0]]
    surface = 2.0 - 0.1 - 12 * SPACING
    assert march(lattice, origin, down, t_max=surface - 0.5 * SPACING)[0][-1] == 0
    offsets, t, dt, sigma = march(lattice, origin, down, t_min=surface + 2 * SPACING)
    assert t[0] - dt[0] / 2 >= surface + 2 * SPACING - 1e-6  # begins inside, opaque at once
    assert np.sum(sigma * dt) > 6.9
    for direction in ([0, 0, 1.0], [1.0, 0, 0], [0, 1.0, 0]):
        assert march(lattice, origin, [direction])[0][-1] == 0
    assert march(lattice, [[50.0, 50.0, 2.0]], down)[0][-1] == 0


def test_the_support_is_one_and_a_half_radii():
    assert abs(SUPPORT - 1.5 * RADIUS) < 1e-12


def test_cells_without_snow_have_low_sums():
    """The bits of cells that can contain snow are correct on every axis."""
    rng = np.random.default_rng(3)
    size = (3 * BRICK, 4 * BRICK, 2 * BRICK)
    blobs = rng.random((6, 8, 4)) < 0.1
    fill = (255 * blobs.repeat(4, 0).repeat(4, 1).repeat(4, 2)).astype(np.uint8)
    lattice = dense_lattice(fill, np.zeros(size, np.int16), np.zeros(size, np.uint8))
    cell = rng.integers([8, 8, 1], [16, 24, 14], (4000, 3))
    points = (cell + rng.random((4000, 3))) * SPACING + [-0.3, 0.2, 0.1]
    sums, _, _ = metaballs.evaluate(points.astype(np.float32), lattice)
    at = cell // BRICK
    brick = lattice.index[(at[:, 0] * 4 + at[:, 1]) * 2 + at[:, 2]]
    x, y, m = (cell % BRICK).T
    near = (lattice.near[brick, x, y] >> m & 1).astype(bool)
    assert (sums[~near] < metaballs.LOW).all() and sums[near].max() > 0.9
    # Compare with the vertices.
    around = np.pad(fill >= metaballs.LOW * 255, 2)
    for i in range(200):
        a, b, c = cell[i] + 1  # one vertex below the cell, in the padded array
        assert near[i] == around[a : a + 4, b : b + 4, c : c + 4].any()
    assert 100 < (~near).sum() < 3900


def test_the_spacing_is_that_of_the_cascade_that_holds_a_point():
    lattice = half_space(0.5)
    side = lattice.bricks[0] * BRICK * SPACING
    centre = lattice.lower[0] + side / 2
    # A second cascade of twice the spacing around the same centre.
    nested = lattice._replace(
        lower=np.stack([lattice.lower[0], centre - side]),
        spacing=np.array([SPACING, 2 * SPACING]),
        bricks=np.repeat(lattice.bricks, 2, 0),
    )
    margin = BRICK * SPACING
    points = np.repeat(centre[None], 4, 0)
    points[1:, 0] += side[0] / 2 - margin + np.array([-0.01, 0.01, 1e3])
    found = metaballs.spacing_at(points.astype(np.float32), nested)
    assert found == pytest.approx(SPACING * np.array([1, 1, 2, 2]))
