"""Conversion of HLG and PQ signals: values of BT.2100, BT.2408 and BT.2087, and tone mapping."""

import numpy as np
import pytest
from support.hdr_signals import CHART, hlg_signal, pq_signal

from climatenerf.core.hdr import (
    KNEE,
    PEAK,
    REFERENCE_WHITE,
    cube_lut,
    hlg_inverse_oetf,
    image_to_sdr,
    linear_light,
    pq_eotf,
    to_bt709,
    to_sdr,
    tone_map,
)
from climatenerf.core.srgb import to_display, to_linear


def grey(value):
    return np.full((1, 3), float(value))


def test_hlg_inverse_oetf_at_its_defined_points():
    """BT.2100-2, table 5: signal 0.5 is E = 1/12, where both branches meet, and 1 is 1."""
    found = hlg_inverse_oetf(np.array([0.0, 0.5, 0.5 + 1e-9, 1.0]))
    np.testing.assert_allclose(found, [0, 1 / 12, 1 / 12, 1], atol=1e-6)


def test_pq_eotf_at_published_points():
    """SMPTE ST 2084 and BT.2408, table 1: 10 bit code values over 1023 in full range."""
    signal = np.array([0.0, 0.508078, 0.580689, 0.751827, 1.0])
    np.testing.assert_allclose(pq_eotf(signal), [0, 100, 203, 1000, 10000], rtol=1e-3)


def test_reference_levels_of_both_signals():
    """BT.2408, table 1: white is 75 % of HLG and 58 % of PQ; a grey card of 18 % is 38 % of HLG."""
    np.testing.assert_allclose(linear_light(grey(0.75), "HLG"), 1, rtol=1e-6)
    np.testing.assert_allclose(linear_light(grey(0.58), "PQ"), 1, rtol=0.01)
    np.testing.assert_allclose(linear_light(grey(0.38), "HLG"), 0.18, rtol=0.02)
    np.testing.assert_allclose(linear_light(grey(1), "HLG"), 1 / 0.26496, rtol=1e-3)
    np.testing.assert_allclose(linear_light(grey(0.751827), "PQ"), PEAK, rtol=1e-3)


def test_hlg_white_is_203_on_the_nominal_display():
    """BT.2100-2: the OOTF of 1000 cd/m2, gamma 1.2, links the reference white of HLG to PQ's."""
    shown = 1000 * hlg_inverse_oetf(np.array(0.75)) ** 1.2
    assert shown == pytest.approx(REFERENCE_WHITE, rel=0.005)


def test_primaries_are_converted_by_the_published_matrix():
    """BT.2087-0, annex: linear BT.2020 to BT.709."""
    published = [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]]
    np.testing.assert_allclose(to_bt709("bt2020"), published, atol=2e-4)
    np.testing.assert_allclose(to_bt709("p3").sum(axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(to_bt709("bt709"), np.eye(3), atol=1e-12)


def test_tone_curve_is_smooth_at_the_knee_and_ends_at_the_peak():
    x = np.linspace(0, PEAK, 5001)
    y = tone_map(np.repeat(x[:, None], 3, axis=1))[:, 0]
    np.testing.assert_array_equal(y[x <= KNEE], x[x <= KNEE])
    slope = np.diff(y) / np.diff(x)
    assert slope.min() > 0 and slope.max() < 1 + 1e-9 and np.abs(np.diff(slope)).max() < 0.01
    assert y[-1] == pytest.approx(1) and tone_map(grey(40)).max() == 1
    assert 0.90 < to_display(tone_map(grey(1)))[0, 0] < 0.96, "paper stays below white"


def test_highlights_keep_their_hue():
    light = np.array([[3.0, 1.5, 0.6], [0.2, 0.5, 4.0]])
    found = tone_map(light)
    expected = light / light.max(1, keepdims=True)
    np.testing.assert_allclose(found / found.max(1, keepdims=True), expected)


def test_colours_outside_of_the_gamut_keep_their_luminance():
    green = np.array([[0.0, 0.4, 0.0]]) @ to_bt709("bt2020").T
    found = tone_map(green)
    assert green.min() < 0 <= found.min() and found.argmax() == 1
    luminance = np.array([0.2126, 0.7152, 0.0722])
    assert found @ luminance == pytest.approx(green @ luminance, rel=1e-3)


@pytest.mark.parametrize(("transfer", "encode"), [("HLG", hlg_signal), ("PQ", pq_signal)])
def test_chart_returns_from_its_closed_form_signal(transfer, encode):
    linear = to_linear(CHART / 255)
    below = linear.max(axis=-1) <= KNEE
    assert below.sum() >= 20
    found = to_sdr(encode(linear), transfer) * 255
    np.testing.assert_allclose(found[below], CHART[below], atol=0.05)
    bits = np.rint(encode(linear) * 1023).astype(np.uint16)[None]
    codes = image_to_sdr(bits, 1023, transfer)[0].astype(int)
    assert np.abs(codes - CHART)[below].max() <= 2


@pytest.mark.parametrize("transfer", ["HLG", "PQ"])
def test_lookup_table_agrees_with_the_equations(transfer):
    size = 65
    lines = cube_lut(transfer, size=size).splitlines()
    assert lines[0] == f"LUT_3D_SIZE {size}" and len(lines) == 1 + size**3
    table = np.array([line.split() for line in lines[1:]], float).reshape(size, size, size, 3)
    signal = np.array([[10, 20, 30], [40, 40, 40], [50, 3, 1]]) / (size - 1)
    found = [table[b, g, r] for r, g, b in np.rint(signal * (size - 1)).astype(int)]
    np.testing.assert_allclose(found, to_sdr(signal, transfer), atol=1e-6)
