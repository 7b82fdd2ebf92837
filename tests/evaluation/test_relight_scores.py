"""Scores of a relit place: closed cases on a made-up ground with a shadow's edge, and a wall."""

import numpy as np
import pytest

from climatenerf.evaluation.reference import Truth
from climatenerf.evaluation.relight_scores import relight_scores

ROAD, BUILDING = 0, 2


def view(clean):
    """Ground in the lower half, a wall in the upper one, 10 m away."""
    height, width = clean.shape[:2]
    label = np.full((height, width), ROAD, np.uint8)
    label[: height // 2] = BUILDING
    normal = np.zeros((height, width, 3))
    normal[..., 2] = label == ROAD
    normal[..., 0] = label == BUILDING
    depth = np.full((height, width), 10.0, np.float32)
    return Truth("t", depth, normal, label, np.ones((height, width)), clean, normal, np.eye(4))


@pytest.fixture
def pair():
    """The same ground and wall under an even sky, and with a sun whose shadow has an edge."""
    albedo = np.random.default_rng(0).uniform(0.2, 0.4, (40, 60, 3))
    sun = np.ones((40, 60, 1))
    sun[20:, 30:] = 5.0
    return view(albedo), view(albedo * sun)


def test_the_truth_itself_has_no_error_at_any_exposure(pair):
    even, sunny = pair
    for gain in (1.0, 0.3):
        scores = relight_scores([gain * even.clean], [even], [sunny])
        assert scores["ground"]["median_error"] == pytest.approx(0, abs=1e-9)
        assert scores["walls"]["median_error"] == pytest.approx(0, abs=1e-9)
        assert scores["shadow_edge"] == pytest.approx(0, abs=1e-9)


def test_the_photo_itself_keeps_its_shadow(pair):
    even, sunny = pair
    assert relight_scores([sunny.clean], [even], [sunny])["shadow_edge"] == pytest.approx(1)
    half = [np.sqrt(even.clean * sunny.clean)]
    assert relight_scores(half, [even], [sunny])["shadow_edge"] == pytest.approx(0.5, abs=1e-6)


def test_errors_are_relative_to_the_exposure_of_both_surfaces(pair):
    even, sunny = pair
    picture = even.clean.copy()
    picture[:20] *= 1.2  # as many pixels of wall as of ground: the gain is in the middle
    scores = relight_scores([picture], [even], [sunny])
    assert scores["walls"]["median_error"] == pytest.approx(np.sqrt(1.2) - 1, abs=1e-3)
    assert scores["ground"]["median_error"] == pytest.approx(1 - 1 / np.sqrt(1.2), abs=1e-3)
