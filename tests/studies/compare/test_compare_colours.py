"""Colour transfer against closed forms, and the eight stand-ins on a known plane."""

from dataclasses import replace

import numpy as np
import pytest
from support.compared_frames import BLUE, WATER_X, eight_bit, make_material

from climatenerf.core.classes import BUILDING, ROAD, SKY, VEGETATION
from climatenerf.core.srgb import LUMA
from climatenerf.evaluation.baselines import depth_fog
from climatenerf.output.video import write_png
from climatenerf.studies.compare import colours
from climatenerf.studies.compare.stand_ins import SHOWN, STAND_INS, StandIn, fitted_frames


def cloud(seed, mean, scale):
    """A picture of correlated colours."""
    rng = np.random.default_rng(seed)
    mixing = rng.normal(0, 1, (3, 3))
    return (mean + scale * rng.normal(0, 1, (60, 50, 3)) @ mixing).astype(np.float64)


def test_transferred_colours_have_the_target_moments():
    source, target = cloud(0, [0.4, 0.5, 0.3], 0.1), cloud(1, [0.7, 0.2, 0.5], 0.2)
    s, t = colours.moments([source]), colours.moments([target])
    found = colours.moments([colours.transferred(source, s, t)])
    np.testing.assert_allclose(found.mean, t.mean, atol=1e-12)
    matrix = colours.transferred(s.mean + np.eye(3), s, t) - t.mean
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-9)
    assert np.linalg.eigvalsh(matrix).min() > 0
    # A (S + e) A = T + e: the small constant e on the diagonal is known.
    expected = t.covariance + colours.EPSILON * (np.eye(3) - matrix @ matrix)
    np.testing.assert_allclose(found.covariance, expected, atol=1e-9)


def test_the_map_of_uncorrelated_colours_is_a_gain_of_each_channel():
    """MK of diagonal covariances s and t: the gains sqrt(t / s)."""
    s, t = np.array([0.04, 0.01, 0.09]), np.array([0.01, 0.04, 0.09])
    source = colours.Moments(np.array([0.2, 0.5, 0.4]), np.diag(s))
    target = colours.Moments(np.array([0.6, 0.3, 0.4]), np.diag(t))
    picture = cloud(2, 0.5, 0.1)
    expected = target.mean + (picture - source.mean) * np.sqrt(
        (t + colours.EPSILON) / (s + colours.EPSILON)
    )
    np.testing.assert_allclose(colours.transferred(picture, source, target), expected, atol=1e-9)


def test_a_map_to_its_own_moments_changes_nothing_and_one_colour_gives_no_nan():
    picture = cloud(3, 0.5, 0.1)
    own = colours.moments([picture])
    np.testing.assert_allclose(colours.transferred(picture, own, own), picture, atol=1e-9)
    flat = np.full((4, 5, 3), 0.3)
    moved = colours.transferred(flat, colours.moments([flat]), own)
    np.testing.assert_allclose(moved, np.broadcast_to(own.mean, flat.shape), atol=1e-9)


def test_whitened_classes_reach_the_white_luma_and_others_stay():
    road, wall = np.array([0.1, 0.12, 0.08]), np.array([0.4, 0.2, 0.1])
    picture = np.stack([np.tile(road, (6, 1)), np.tile(wall, (6, 1))])
    label = np.stack([np.full(6, ROAD), np.full(6, BUILDING)]).astype(np.uint8)
    means = colours.class_means([picture], [label])
    np.testing.assert_allclose(means[0], road)
    assert (means[1:] == 0).all()
    found = colours.whitened(picture, label, means)
    s = colours.STRENGTH
    np.testing.assert_allclose(found[0, 0], (1 - s) * road + s * colours.WHITE_LUMA, atol=1e-9)
    np.testing.assert_array_equal(found[1], picture[1])
    dark = means.copy()
    dark[0] = 1e-4  # the gain has a bound
    bound = colours.MAX_BRIGHTNESS * (road @ np.array(LUMA))
    assert colours.whitened(picture, label, dark)[0, 0].max() < 2 * bound


def test_class_means_are_over_all_pictures():
    label = np.array([[SKY, VEGETATION]], np.uint8)
    dark, bright = np.full((1, 2, 3), 0.1), np.full((1, 2, 3), 0.5)
    means = colours.class_means([dark, bright], [label, label])
    np.testing.assert_allclose(means[2:], 0.3)


def test_frames_for_fitting_are_spread():
    assert fitted_frames(1) == [0] and fitted_frames(2) == [0, 1] and fitted_frames(9) == [0, 4, 8]


@pytest.fixture(scope="module")
def materials(tmp_path_factory):
    folder = tmp_path_factory.mktemp("frames")
    return {effect: make_material(folder / effect, effect) for effect in ("smog", "flood", "snow")}


def edited(material, name, tmp_path):
    method = StandIn(name)
    assert method.shows(material)
    return list(method.pictures(material, range(len(material)), tmp_path))


def test_each_stand_in_shows_its_effects_and_changes_the_picture(materials, tmp_path):
    for effect, material in materials.items():
        shown = [method.name for method in STAND_INS if method.shows(material)]
        assert shown == [name for name, effects in SHOWN.items() if effect in effects]
        for name in shown:
            pictures = edited(material, name, tmp_path)
            assert len(pictures) == len(material)
            assert all(p.shape == (48, 64, 3) and p.dtype == np.uint8 for p in pictures)
            assert not np.array_equal(pictures[0], material.clean.picture(0)), name
    assert {method.kind for method in STAND_INS} == {"stand-in"}


def test_recolouring_by_class_needs_labels(tmp_path):
    material = make_material(tmp_path, "snow", frames=1, labels=False)
    assert not StandIn("class-recolour").shows(material)
    assert StandIn("white-paint").shows(material)


def test_the_flat_plane_gets_the_colour_of_our_water(materials, tmp_path):
    """Our water is `BLUE` beyond x = 6 m; the plane at 0.5 m hides all ground."""
    material = materials["flood"]
    blue = replace(material, true=tuple([np.full((48, 64, 3), eight_bit(BLUE))] * 3))
    picture = edited(blue, "flat-plane", tmp_path)[0]
    ground = np.isfinite(material.view(0).depth)
    assert np.abs(picture[ground].astype(int) - eight_bit(BLUE)).max() <= 6
    np.testing.assert_array_equal(picture[~ground], material.clean.picture(0)[~ground])
    assert WATER_X > 0


def test_the_fog_finds_the_colour_and_the_extinction_of_its_target(tmp_path):
    """The target is such a fog, of half the nominal extinction and of a blue colour."""
    material = make_material(tmp_path, "smog")
    nominal = -np.log(0.05) / 30.0  # of the visibility of 30 m
    views = [material.view(i) for i in range(3)]
    true = tuple(eight_bit(depth_fog(view, nominal / 2, BLUE)) for view in views)
    pictures = edited(replace(material, true=true), "depth-fog", tmp_path)
    for picture, wanted in zip(pictures, true, strict=True):
        assert np.abs(picture.astype(int) - wanted).mean() < 3
    plain = edited(material, "depth-fog", tmp_path)
    assert np.abs(plain[0].astype(int) - true[0]).mean() > 10


def test_white_paint_covers_level_ground_in_one_colour(materials, tmp_path):
    picture = edited(materials["snow"], "white-paint", tmp_path)[1]
    ground = np.isfinite(materials["snow"].view(1).depth)
    assert np.ptp(picture[ground].reshape(-1, 3), axis=0).max() <= 1


def test_noise_differs_from_frame_to_frame_and_one_map_does_not(tmp_path):
    """A camera that stands still: only what is drawn anew or fitted anew changes."""
    material = make_material(tmp_path, "snow", frames=2)
    path = material.clean.job.path
    path.c2w[1] = path.c2w[0]
    for rendered in (material.clean, material.ours):
        for name in ("frames", *rendered.job.layers):
            for file in (rendered.folder / name).glob("0000.*"):
                file.with_stem("0001").write_bytes(file.read_bytes())
    for name, effects in SHOWN.items():
        if "snow" in effects:
            first, second = edited(material, name, tmp_path)
            assert np.array_equal(first, second) == (name != "frame-noise"), name


def test_statistics_of_each_picture_make_a_fixed_colour_change(tmp_path):
    """The second frame is the first with a white upper half, as if the camera had turned up."""
    material = make_material(tmp_path, "smog", frames=2)
    turned = material.clean.picture(0).copy()
    turned[:24] = 240
    write_png(material.clean.folder / "frames" / "0001.png", turned, "test")
    change = {}
    for name in ("global-mk", "picture-statistics"):
        first, second = edited(material, name, tmp_path)
        change[name] = np.abs(first[24:].astype(int) - second[24:]).mean()
    assert change["global-mk"] == 0 and change["picture-statistics"] > 5
