"""Edge similarity and flicker have known values for known edits."""

import numpy as np
import pytest

from climatenerf.core.srgb import LUMA
from climatenerf.evaluation.edit_scores import LEVELS, MIN_PIXELS, edge_ssim, flicker


def blobs(seed, height=40, width=56):
    """A picture of smooth blobs in [0.2, 0.8]."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:height, :width]
    phase = rng.uniform(0, 6, (3, 4))
    waves = [np.sin(u / (4 + a)) * np.cos(v / (3 + b)) for a, b, _, _ in phase]
    return 0.5 + 0.3 * np.stack(waves, axis=-1)


def squares(colours, side):
    """One square of `side` pixels of each colour, side by side."""
    return np.concatenate([np.full((side, side, 3), colour) for colour in colours], axis=1)


def test_edges_of_one_picture_agree_and_contrast_does_not_count():
    clean = blobs(0)
    assert edge_ssim(clean, clean) == pytest.approx(1.0)
    assert edge_ssim(0.3 + 0.4 * clean, clean) == pytest.approx(1.0, abs=1e-9)


def test_edges_of_another_picture_or_of_noise_do_not_agree():
    clean = blobs(0)
    noisy = np.clip(clean + np.random.default_rng(0).normal(0, 0.2, clean.shape), 0, 1)
    assert edge_ssim(blobs(3), clean) < 0.5
    assert edge_ssim(noisy, clean) < 0.6
    assert np.isfinite(edge_ssim(np.full_like(clean, 0.5), clean))


def test_edges_are_sobel_magnitudes_over_their_percentile():
    """One vertical step of height a: only two columns have the magnitude 4 a of the filter."""
    from climatenerf.evaluation import edit_scores

    step = np.zeros((20, 20, 3))
    step[:, 10:] = 0.4
    edges = edit_scores._edges(step)[..., 0]
    assert (edges[:, 9:11] == 1).all() and np.count_nonzero(edges) == 40
    step[:, 15:] = 0.5  # a weaker edge of a quarter of the height
    assert edit_scores._edges(step)[5, 14, 0] == pytest.approx(0.25)


def test_one_function_of_colour_does_not_flicker():
    """Colours change their place and area; each keeps its new colour."""
    colours = np.array([[0.1, 0.1, 0.1], [0.6, 0.3, 0.2], [0.2, 0.8, 0.4]])
    side = 12
    clean = squares(colours, side), squares(colours[[2, 0, 1]], side)
    edited = squares(colours**2, side), squares(colours[[2, 0, 1]] ** 2, side)
    assert flicker(edited, clean) == pytest.approx(0.0, abs=1e-12)
    assert flicker(clean, clean) == 0.0


def test_a_jump_of_one_colour_counts_by_its_area():
    colours = np.array([[0.1, 0.1, 0.1], [0.6, 0.3, 0.2], [0.2, 0.8, 0.4]])
    clean = squares(colours, 12)
    changed = squares(colours + [[0.0], [0.03], [-0.06]], 12)
    assert flicker((clean, changed), (clean, clean)) == pytest.approx((0.03 + 0.06) / 3)
    tinted = squares(colours + [[0, 0.1, 0]], 12)
    expected = 0.1 * LUMA[1]
    assert flicker((clean, tinted), (clean, clean)) == pytest.approx(expected)


def test_the_camera_movement_alone_is_no_flicker():
    """A smooth ramp moves: the means of its groups change, edited and clean alike."""
    ramp = np.repeat(np.linspace(0.1, 0.9, 80)[None, :, None], 40, axis=0).repeat(3, axis=2)
    moved = np.roll(ramp, 3, axis=1)
    shifted = ramp + 0.02, moved + 0.02
    assert flicker(shifted, (ramp, moved)) == pytest.approx(0.0, abs=1e-9)


def test_rare_colours_and_pictures_without_common_ones_have_no_flicker():
    dark, bright = np.full((8, 8, 3), 0.01), np.full((8, 8, 3), 0.99)
    assert np.isnan(flicker((dark, bright), (dark, bright)))
    small = int(MIN_PIXELS**0.5)
    assert small**2 < MIN_PIXELS
    few = np.full((small, small, 3), 0.5)
    assert np.isnan(flicker((few, few), (few, few)))
    assert LEVELS > 1
