"""Movie scores and time strips on a plane whose frames are known."""

from dataclasses import replace

import numpy as np
import pytest
from support.compared_frames import make_material

from climatenerf.evaluation import baselines
from climatenerf.studies.compare.scores import movie_scores, truth_scores
from climatenerf.studies.compare.strips import column_strip, lines_with_most, row_strip


@pytest.fixture(scope="module")
def flood(tmp_path_factory):
    return make_material(tmp_path_factory.mktemp("flood"), "flood", frames=10)


def test_unedited_frames_of_a_matt_plane_have_perfect_scores(flood):
    scores = movie_scores(flood, flood.clean.picture, own_depth=False)
    assert scores.warp_next < 0.03 and scores.warp_far < 0.06
    assert scores.water_warp_next < 0.1
    assert scores.edge_ssim == pytest.approx(1.0) and scores.flicker == 0.0


def test_noise_of_each_frame_is_seen_by_every_score(flood):
    def noisy(index):
        rng = np.random.default_rng(index)
        change = rng.integers(-40, 41, (48, 64, 1)) + 20 * (index % 2)
        return np.clip(flood.clean.picture(index) + change, 0, 255).astype(np.uint8)

    clean = movie_scores(flood, flood.clean.picture, own_depth=False)
    scores = movie_scores(flood, noisy, own_depth=False)
    assert scores.warp_next > 5 * clean.warp_next and scores.warp_far > 5 * clean.warp_far
    # Noise of 23.4 levels rms in one frame, less in the interpolated one; 20 more at odd frames.
    assert 0.1 < scores.water_warp_far < np.sqrt(2) * 23.4 / 255 + 0.01
    assert scores.water_warp_far < scores.water_warp_next < 0.16
    assert scores.edge_ssim < 0.7
    assert scores.flicker * 255 == pytest.approx(20, abs=4)


def test_noise_in_the_water_alone_is_seen_in_the_water_alone(flood):
    def noisy(index):
        rng = np.random.default_rng(index)
        picture = flood.clean.picture(index).astype(int)
        picture += (rng.integers(-60, 61, (48, 64, 1)) * flood.mask(index)[..., None]).astype(int)
        return np.clip(picture, 0, 255).astype(np.uint8)

    clean = movie_scores(flood, flood.clean.picture, own_depth=False)
    scores = movie_scores(flood, noisy, own_depth=False)
    assert scores.warp_next == pytest.approx(clean.warp_next, abs=1e-6)
    assert scores.water_warp_next > 3 * clean.water_warp_next


def test_only_a_flood_has_scores_of_water_and_few_frames_have_no_far_ones(tmp_path):
    material = make_material(tmp_path, "smog", frames=3)
    scores = movie_scores(material, material.clean.picture, own_depth=False)
    assert np.isnan(scores.water_warp_next) and np.isnan(scores.warp_far)
    assert np.isfinite(scores.warp_next)


def test_our_snow_is_compared_at_its_own_depth(tmp_path):
    """Frames of a plane 1 m higher agree at that depth only."""
    material = make_material(tmp_path, "snow", frames=3)
    for index in range(3):
        file = material.ours.folder / "depth" / f"{index:04d}.npz"
        depth = np.load(file)["depth"]
        np.savez_compressed(file, depth=depth / 2)
    picture = material.clean.picture
    wrong = movie_scores(material, picture, own_depth=True)
    right = movie_scores(material, picture, own_depth=False)
    assert wrong.warp_next > 3 * right.warp_next


def test_truth_scores_are_means_over_the_views(tmp_path):
    material = make_material(tmp_path, "smog", frames=2)
    true = [material.clean.picture(i).astype(int) for i in range(2)]
    true = tuple(np.clip(each, 0, 245).astype(np.uint8) for each in true)
    material = replace(material, true=true)
    offsets = 1, 10
    scores = truth_scores(material, lambda i: material.true[i] + np.uint8(offsets[i]))
    expected = np.mean([20 * np.log10(255 / offset) for offset in offsets])
    assert scores["psnr"] == pytest.approx(expected)
    assert 0.9 < scores["ssim"] < 1.0


def test_strips_hold_one_line_over_time():
    rng = np.random.default_rng(0)
    pictures = list(rng.integers(0, 256, (100, 7, 9, 3), dtype=np.uint8))
    column, row = column_strip(pictures, 4), row_strip(pictures, 2)
    assert column.shape == (7, 200, 3) and row.shape == (200, 9, 3)
    for t in (0, 31, 99):
        for copy in range(2):
            np.testing.assert_array_equal(column[:, 2 * t + copy], pictures[t][:, 4])
            np.testing.assert_array_equal(row[2 * t + copy], pictures[t][2])
    assert column_strip(pictures * 3, 0).shape[1] == 300


def test_strips_are_taken_where_most_of_the_effect_is():
    mask = np.zeros((6, 8))
    mask[4, 5] = mask[4, 6] = mask[1, 6] = 0.5
    assert lines_with_most([mask, mask]) == (4, 6)
    assert lines_with_most([np.zeros((7, 9))]) == (3, 4)
    assert lines_with_most([np.ones((7, 9))]) == (3, 4)


def test_the_view_of_a_stand_in_is_the_clean_frame(flood):
    view = flood.view(2)
    np.testing.assert_allclose(view.linear, baselines.linear_of(flood.clean.picture(2)))
    np.testing.assert_allclose(np.linalg.norm(view.rays_d, axis=-1), 1)
    ground = np.isfinite(view.depth)
    heights = view.c2w[2, 3] + view.depth[ground] * view.rays_d[ground][:, 2]
    np.testing.assert_allclose(heights, 0.0, atol=1e-5)
