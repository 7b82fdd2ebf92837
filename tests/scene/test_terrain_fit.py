"""The robust ground through heights: planes, outliers, kerbs, holes, slopes and its error."""

import numpy as np
import pytest

from climatenerf.scene.terrain_fit import GROWTH, MIN_ERROR, Heights, fit_heights

CELL = 0.1


def fit(x, error=0.02, width=12.0, depth=8.0, cell=CELL):
    """Fit heights at x (m) on a raster from the origin; returns heights and errors."""
    shape = round(depth / cell) + 1, round(width / cell) + 1
    given = Heights(x, np.broadcast_to(np.asarray(error, float), len(x)).copy())
    return fit_heights(given, (0.0, 0.0), cell, shape)


def nodes(shape, cell=CELL):
    """x and y of the nodes, m."""
    return np.meshgrid(cell * np.arange(shape[1]), cell * np.arange(shape[0]))


def measured(ground, count=4000, width=12.0, depth=8.0, noise=0.0, seed=0, where=None):
    """Positions with measured heights of ground(x, y)."""
    random = np.random.default_rng(seed)
    xy = random.uniform(0, 1, (count, 2)) * (width, depth)
    if where is not None:
        xy = xy[where(*xy.T)]
    z = ground(*xy.T) + noise * random.normal(size=len(xy))
    return np.c_[xy, z]


def sloped(x, y):
    return 0.1 * x - 0.05 * y + 30.0


def test_a_plane_is_kept():
    height, error = fit(measured(sloped))
    assert height.dtype == error.dtype == np.float32 and height.shape == (81, 121)
    # The membrane term flattens a slope at the borders, by millimetres.
    assert np.abs(height - sloped(*nodes(height.shape))).max() < 0.01
    assert error.min() >= MIN_ERROR and error.max() < 0.03


def test_level_ground_is_exact():
    height, _ = fit(measured(lambda x, y: 0 * x - 70.0))
    assert np.abs(height + 70).max() < 1e-4


@pytest.mark.parametrize("side", [1, -1])
def test_outliers_on_one_side_do_not_lift_the_ground(side):
    """15 % of heights are up to a metre off, all above or all below."""
    x = measured(sloped, noise=0.01)
    random = np.random.default_rng(1)
    wrong = random.random(len(x)) < 0.15
    x[wrong, 2] += side * random.uniform(0.2, 1.0, wrong.sum())
    height, _ = fit(x)
    off = np.abs(height - sloped(*nodes(height.shape)))
    assert np.median(off) < 0.01 and np.quantile(off, 0.99) < 0.03


def test_noise_is_averaged():
    height, _ = fit(measured(sloped, noise=0.05), error=0.05)
    off = height - sloped(*nodes(height.shape))
    assert np.sqrt(np.mean(off**2)) < 0.02


def kerb(x, y):
    return np.where(x > 6.0, 0.12, 0.0)


def test_a_kerb_is_kept():
    height, _ = fit(measured(kerb, 12000, noise=0.01))
    x, y = nodes(height.shape)
    away = np.abs(x - 6.0) > 0.3
    assert np.abs(height - kerb(x, y))[away].max() < 0.03
    assert np.abs(height - kerb(x, y))[np.abs(x - 6.0) > 1.0].max() < 0.02


def bank(x, y):
    return np.clip(np.tan(np.radians(30)) * (x - 4.0), 0.0, 2.0)


@pytest.mark.parametrize("gradient", [30.0, -30.0])
def test_a_slope_of_thirty_degrees_is_kept(gradient):
    def steep(x, y):
        return np.tan(np.radians(gradient)) * x

    height, _ = fit(measured(steep, noise=0.01))
    x, y = nodes(height.shape)
    assert np.abs(height - steep(x, y)).max() < 0.06
    assert np.median(np.abs(height - steep(x, y))) < 0.01


def test_a_bank_is_kept():
    height, _ = fit(measured(bank, 12000, noise=0.01))
    off = np.abs(height - bank(*nodes(height.shape)))
    assert np.quantile(off, 0.95) < 0.03 and off.max() < 0.12


def test_a_hole_is_continued_and_its_error_grows():
    """A hole of 8 m in ground with a slope and a slight curvature."""

    def ground(x, y):
        return 0.05 * x + 0.004 * (y - 8) ** 2

    def hole(x, y):
        return np.hypot(x - 8, y - 8) < 4.0

    x = measured(ground, 8000, 16.0, 16.0, 0.01, where=lambda x, y: ~hole(x, y))
    height, error = fit(x, width=16.0, depth=16.0, cell=0.2)
    u, v = nodes(height.shape, 0.2)
    off = np.abs(height - ground(u, v))
    assert off[hole(u, v)].max() < 0.08
    assert (off <= 2 * error)[hole(u, v)].mean() > 0.9
    middle = error[40, 40:60]  # from the hole's centre to its border
    assert middle[0] == pytest.approx(np.hypot(MIN_ERROR, 4 * GROWTH), rel=0.2)
    assert (np.diff(middle) <= 1e-6).all() and middle[-1] < 0.05


@pytest.mark.parametrize("bias", [0.0, 0.1])
def test_data_on_one_side_do_not_tilt_what_lies_beyond(bias):
    """Noise in a strip of 3 m must not become metres at 9 m from it."""
    x = measured(lambda x, y: bias * x, 3000, noise=0.05, where=lambda x, y: x < 3.0)
    height, error = fit(x, error=0.05)
    u, v = nodes(height.shape)
    off = np.abs(height - bias * u)
    assert off[:, -1].max() < 0.1 + bias * 9, "never steeper than the data, nor the other way"
    assert (off <= 2 * error).mean() > 0.9
    assert error[:, -1].min() > 0.3


@pytest.mark.parametrize("seed", range(4))
def test_the_noise_of_a_narrow_strip_does_not_tilt_the_raster(seed):
    x = measured(lambda x, y: 0 * x, 150, width=0.3, noise=0.05, seed=seed)
    height, _ = fit(x, error=0.05)
    assert np.abs(height).max() < 0.35, "bending alone continues to 1.3 m"


def test_one_height_gives_level_ground():
    height, error = fit(np.array([[3.0, 2.0, 1.5]]))
    assert np.abs(height - 1.5).max() < 1e-3
    assert error.max() == pytest.approx(GROWTH * np.hypot(9.0, 6.0), rel=0.01)


@pytest.mark.parametrize("ground", [sloped, kerb, bank], ids=lambda f: f.__name__)
@pytest.mark.parametrize("noise", [0.01, 0.04])
def test_the_error_covers_the_truth(ground, noise):
    x = measured(ground, 2500, noise=noise, where=lambda x, y: (x < 5) | (y > 4))
    height, error = fit(x, error=noise)
    off = np.abs(height - ground(*nodes(height.shape)))
    assert (off <= 2 * error).mean() > 0.9
    assert np.median(error) < 0.1 + 2 * noise, "and is no excuse"


@pytest.mark.parametrize("degrees", [10.0, 30.0])
def test_the_error_covers_a_slope_that_goes_on(degrees):
    """Tension lets the slope fade; the error says so."""

    def steep(x, y):
        return np.tan(np.radians(degrees)) * x

    x = measured(steep, noise=0.02, where=lambda x, y: x < 4)
    height, error = fit(x)
    u, v = nodes(height.shape)
    off = np.abs(height - steep(u, v))
    assert off[u > 10].min() > 0.14, "it fades"
    assert (off <= 2 * error)[u > 4.5].mean() > 0.9
    assert np.median((off / error)[u > 6]) > 0.4, "and is no excuse"


def test_heights_of_a_small_error_count_more():
    exact = measured(lambda x, y: 0 * x, 2000)
    rough = measured(lambda x, y: 0 * x + 0.3, 2000, seed=1)
    error = np.r_[np.full(2000, 0.01), np.full(2000, 0.3)]
    height, _ = fit(np.r_[exact, rough], error)
    assert np.median(np.abs(height)) < 0.03


def test_heights_beyond_the_raster_are_left_out():
    x = measured(sloped, noise=0.01)
    far = np.c_[np.full((50, 2), -40.0), np.full(50, 9e3)]
    assert np.array_equal(fit(np.r_[x, far])[0], fit(x)[0])


def test_a_fit_is_deterministic_and_does_not_depend_on_the_order():
    x = measured(sloped, noise=0.02)
    first = fit(x)
    shuffled = x[np.random.default_rng(2).permutation(len(x))]
    for again in (fit(x), fit(shuffled)):
        assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))


@pytest.mark.parametrize("shape", [(2, 2), (2, 90), (3, 40), (90, 2)])
def test_narrow_rasters_are_fitted(shape):
    depth, width = ((n - 1) * CELL for n in shape)
    x = np.array([[0.0, 0.0, 2.0], [width, depth, 2.0]])
    height, error = fit_heights(Heights(x, np.full(2, 0.02)), (0.0, 0.0), CELL, shape)
    assert height.shape == error.shape == shape
    assert np.allclose(height, 2.0, atol=1e-3) and np.isfinite(error).all()


def test_ground_far_from_the_origin_keeps_its_millimetres():
    x = measured(sloped, 1500)
    moved = Heights(x + (5e5, 4e6, 2e3), np.full(len(x), 0.02))
    height, _ = fit_heights(moved, (5e5, 4e6), CELL, (81, 121))
    assert np.abs(height - fit(x)[0] - 2e3).max() < 2e-3
