"""The low-frequency gain from a clean to a stylised picture."""

import numpy as np
import pytest

from climatenerf.styling.paper.gain import BRIGHTNESS, DARK, HUE, low_frequency_gain

SIZE = (40, 260)  # the blur is 2 pixels


def picture(seed=0, low=0.05, high=0.6):
    return np.random.default_rng(seed).uniform(low, high, (*SIZE, 3))


def full():
    return np.ones(SIZE)


def test_equal_pictures_have_gain_one():
    c = picture()
    assert np.allclose(low_frequency_gain(c, c, full()), 1.0, atol=1e-9)


def test_gain_of_constant_pictures_is_their_ratio():
    c, y = np.full((*SIZE, 3), 0.2), np.full((*SIZE, 3), 0.05)
    expected = (0.05 + DARK) / (0.2 + DARK)
    assert np.allclose(low_frequency_gain(c, y, full()), expected, rtol=1e-4)


def test_gains_are_bounded_without_a_change_of_hue():
    c = np.full((*SIZE, 3), 0.1)
    assert np.allclose(low_frequency_gain(0 * c, 1 + 0 * c, full()), BRIGHTNESS[1])
    assert np.allclose(low_frequency_gain(1 + 0 * c, 0 * c, full()), BRIGHTNESS[0])
    # Olive leaves under white snow: brighter by the bound, and white.
    olive, snow = c * [0.8, 0.7, 0.1], 0 * c + 0.9
    white = (olive + DARK) * low_frequency_gain(olive, snow, full())
    assert np.ptp(white, axis=-1).max() < 1e-4
    # Red walls seen as pure blue: the hue has bounds, too.
    gain = low_frequency_gain(c * [5, 0, 0], c * [0, 0, 5], full())
    assert gain.max() <= BRIGHTNESS[1] * HUE[1]


def test_texture_of_the_teacher_is_not_learned():
    c = np.full((*SIZE, 3), 0.3)
    stripes = c + 0.25 * (-1.0) ** np.arange(SIZE[1])[None, :, None]
    inside = low_frequency_gain(c, stripes, full())[:, 10:-10]  # borders see half a stripe more
    assert np.abs(inside - 1).max() < 0.01
    # An edge of colour is learned within three deviations of the blur.
    y = c.copy()
    y[:, 130:] *= 0.5
    gain = low_frequency_gain(c, y, full())
    assert np.abs(gain[:, :123] - 1).max() < 0.01
    assert np.allclose(gain[:, 137:], (0.15 + DARK) / (0.3 + DARK), atol=0.01)


def test_the_sky_does_not_bleed_into_matter():
    c = np.full((*SIZE, 3), 0.2)
    opacity = full()
    opacity[:, 130:] = 0
    y = c.copy()
    y[:, 130:] = 5.0  # a sky that the teacher has brightened
    assert np.abs(low_frequency_gain(c, y, opacity)[:, :130] - 1).max() < 1e-6


def test_black_pictures_and_empty_views_are_finite():
    c = np.zeros((*SIZE, 3))
    assert np.isfinite(low_frequency_gain(c, c, full())).all()
    assert np.isfinite(low_frequency_gain(c, c + 1, 0 * full())).all()


@pytest.mark.parametrize("exposure", [0.5, 2.0])
def test_gain_ignores_a_common_exposure_of_bright_pictures(exposure):
    c, y = picture(0, 0.4, 0.6), picture(1, 0.2, 0.3)
    one = low_frequency_gain(c, y, full())
    assert np.allclose(low_frequency_gain(exposure * c, exposure * y, full()), one, rtol=0.03)
