import numpy as np
import pytest

from climatenerf.core.morphology import connected_to, depth_inside, dilated, eroded


@pytest.fixture
def mask():
    return np.random.default_rng(3).random((23, 31)) < 0.7


def neighbourhood(mask, pixels):
    """Stack the mask shifted by up to `pixels` rows and columns; False beyond the border."""
    padded = np.pad(mask, pixels)
    h, w = mask.shape
    size = 2 * pixels + 1
    return np.stack([padded[y : y + h, x : x + w] for y in range(size) for x in range(size)])


@pytest.mark.parametrize("pixels", [0, 1, 3])
def test_dilation_covers_a_square(mask, pixels):
    sparse = ~mask
    assert (dilated(sparse, pixels) == neighbourhood(sparse, pixels).any(0)).all()


def test_erosion_keeps_pixels_with_all_neighbours(mask):
    assert (eroded(mask) == neighbourhood(mask, 1).all(0)).all()


def test_depth_inside_counts_erosions():
    mask = dilated(np.random.default_rng(4).random((40, 50)) < 0.01, 5)
    counted, rest = np.zeros(mask.shape, int), mask
    while rest.any():
        counted, rest = counted + rest, eroded(rest)
    assert counted.max() > 3 and (depth_inside(mask) == counted).all()


def test_connectivity_is_along_rows_and_columns_only():
    allowed = np.array([[1, 1, 0, 0], [0, 1, 0, 1], [0, 0, 1, 1]], bool)
    seeds = np.zeros_like(allowed)
    seeds[0, 0] = seeds[0, 2] = True  # the second seed is not allowed
    expected = np.array([[1, 1, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0]], bool)
    assert (connected_to(seeds, allowed) == expected).all()
    assert not connected_to(np.zeros_like(allowed), allowed).any()
