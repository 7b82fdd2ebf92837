"""Scores against ground truth: known answers on analytic scenes."""

import dataclasses
import json
import math

import numpy as np
import pytest
import torch

from climatenerf.core.errors import UserError
from climatenerf.core.samples import Samples
from climatenerf.core.srgb import to_display
from climatenerf.evaluation import baselines, geometry, weather_scores
from climatenerf.evaluation.baseline_rendering import painted_snow
from climatenerf.evaluation.baselines import CleanView
from climatenerf.evaluation.consistency import Frame, bilinear, warp_error
from climatenerf.evaluation.evaluated_run import depth_spread
from climatenerf.evaluation.reference import Truth, read_reference, world_rays
from climatenerf.output.score_report import table_text
from climatenerf.scene import Camera

CAMERA = Camera(64, 48, 50.0, 50.0, 32.0, 24.0)
ROAD, TERRAIN, VEGETATION, SKY = 0, 9, 8, 10  # Cityscapes train ids


def pitched_pose(height=2.0, pitch=-25.0):
    a = np.deg2rad(pitch)
    forward = np.array([0.0, np.cos(a), np.sin(a)])
    right = np.array([1.0, 0.0, 0.0])
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2] = right, np.cross(forward, right), forward
    pose[:3, 3] = (0.0, 0.0, height)
    return pose


def sloped_ground(pose, rise=0.0, offset=0.0):
    """Return the ray lengths to the plane z = offset + rise y."""
    rays = world_rays(CAMERA, pose).astype(float)
    fall = rays[..., 2] - rise * rays[..., 1]
    with np.errstate(divide="ignore"):
        t = (offset + rise * pose[1, 3] - pose[2, 3]) / fall
    return np.where((fall < 0) & (t > 0), t, np.inf).astype(np.float32)


def truth_of(rise=0.0, label=ROAD):
    pose = pitched_pose()
    depth = sloped_ground(pose, rise)
    normal = np.array([0.0, -rise, 1.0]) / np.hypot(1, rise)
    sky = np.isinf(depth)
    return Truth(
        "t01.jpg",
        depth,
        np.where(sky[..., None], 0.0, normal @ pose[:3, :3]),
        np.where(sky, SKY, label).astype(np.uint8),
        np.ones(depth.shape),
        np.full((*depth.shape, 3), 0.5),
        world_rays(CAMERA, pose).astype(float),
        pose,
    )


class TwoLayers:
    """A field with equal weights at 1 m and 5 m on even rays, and low opacity on odd rays."""

    near = 0.1
    bounds = torch.zeros(2, 3)

    def march(self, rays_o, rays_d, near, far, step, pruning_threshold=None):
        n = rays_o.shape[0]
        sigma = torch.tensor([[math.log(2.0), 1e3], [0.1, 0.1]])[torch.arange(n) % 2]
        t = torch.tensor([1.0, 5.0]).repeat(n)
        return Samples(2 * torch.arange(n + 1), t, torch.ones_like(t), sigma.reshape(-1))


def test_depth_spread_is_the_relative_deviation_of_the_weights():
    found = depth_spread(TwoLayers(), CAMERA, np.eye(4)).numpy()
    assert np.allclose(found[::2], 2 / 3, atol=1e-4)  # mean 3 m, deviation 2 m
    assert np.isnan(found[1::2]).all()


def test_depth_scores_of_a_known_relative_error():
    truth = truth_of()
    found = geometry.depth_scores([1.1 * truth.depth], (truth,))
    assert found["depth_abs_rel"] == pytest.approx(0.1, rel=1e-4)
    near = truth.depth[truth.depth < geometry.MAX_DISTANCE].astype(float)
    assert found["depth_rmse_m"] == pytest.approx(0.1 * np.sqrt((near**2).mean()), rel=1e-4)
    nothing = np.full_like(truth.depth, np.inf)
    assert geometry.depth_scores([nothing], (truth,))["depth_abs_rel"] == pytest.approx(1.0)


@pytest.mark.parametrize("rise", [0.0, 0.06])
def test_ground_scores_of_a_known_vertical_error(rise):
    truth = truth_of(rise=rise)
    for offset, within in ((0.04, (1, 1)), (-0.07, (1, 0)), (0.12, (0, 0))):
        found = geometry.ground_scores([sloped_ground(truth.c2w, rise, offset)], (truth,))
        assert (found["ground_within_10cm"], found["ground_within_5cm"]) == within, offset
    depth = truth.depth.copy()
    near = np.argwhere(truth.depth < geometry.MAX_DISTANCE)
    for row, column in near[: len(near) // 4]:
        depth[row, column] = np.inf
    found = geometry.ground_scores([depth], (truth,))
    assert found["ground_within_5cm"] == pytest.approx(0.75, abs=0.01)


def test_ground_scores_leave_out_steep_faces_and_other_classes():
    truth, kerb = truth_of(), truth_of(rise=1.5)
    nothing = np.full_like(truth.depth, np.inf)
    found = geometry.ground_scores([truth.depth, nothing], (truth, kerb))
    assert found["ground_within_5cm"] == 1
    found = geometry.ground_scores([truth.depth], (truth_of(label=VEGETATION),))
    assert np.isnan(found["ground_within_10cm"])


def test_ground_holes_of_a_known_number_of_pixels():
    truth, vegetation = truth_of(), truth_of(label=VEGETATION)
    ground = np.argwhere(truth.depth < geometry.MAX_DISTANCE)
    depth = 1.2 * truth.depth
    for row, column in ground[:30]:
        depth[row, column] = 1.6 * truth.depth[row, column]
    depth[tuple(ground[30])] = np.inf
    assert geometry.ground_holes([depth], (truth,)) == pytest.approx(31 / len(ground))
    lawn = truth_of(label=TERRAIN)
    assert geometry.ground_holes([depth], (lawn,)) == pytest.approx(31 / len(ground))
    # A second view without ground changes nothing.
    both = geometry.ground_holes([depth, depth], (truth, vegetation))
    assert both == pytest.approx(31 / len(ground))
    assert geometry.ground_holes([depth], (vegetation,)) == 0


def test_normal_scores_of_a_known_rotation():
    truth = truth_of()
    a = np.deg2rad(10.0)
    rotation = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    found = geometry.normal_scores([truth.normal @ rotation.T], (truth,))
    assert found["normal_median_deg"] == pytest.approx(10.0, abs=1e-3)
    assert found["normal_ground_roof_median_deg"] == pytest.approx(10.0, abs=1e-3)
    vegetation = truth_of(label=VEGETATION)
    found = geometry.normal_scores([vegetation.normal @ rotation.T], (vegetation,))
    assert np.isnan(found["normal_median_deg"]) and found["normal_all_median_deg"] > 9


def test_upward_facing_building_surfaces_are_roofs():
    roof, wall = truth_of(rise=0.5, label=2), truth_of(label=2)
    assert geometry.ground_or_roof(roof)[~roof.sky].all()
    wall.normal[:] = [0.0, 0.0, -1.0]
    assert not geometry.ground_or_roof(wall).any()
    assert not geometry.ground_or_roof(truth_of(label=VEGETATION)).any()


def test_floater_and_sky_scores_of_known_transmittances():
    truth = truth_of()
    absorbed = np.where(truth.sky, 0.9, 0.25)
    passed = np.where(truth.sky, 1.0, 0.0)
    passed[0, :8] = 0.5
    found = geometry.emptiness_scores([absorbed], [passed], (truth,))
    assert found["floater_mass"] == pytest.approx(0.25)
    assert found["floaters_road"] == pytest.approx(0.25) and "floaters_terrain" not in found
    grown = dataclasses.replace(truth, label=truth.label.copy())
    half = np.arange(truth.label.shape[1])[None, :] < 32
    grown.label[~truth.sky & half] = VEGETATION
    each = geometry.emptiness_scores(
        [np.where(half, 0.5, 0.125) + 0 * absorbed], [passed], (grown,)
    )
    assert each["floaters_vegetation"] == pytest.approx(0.5)
    assert each["floaters_road"] == pytest.approx(0.125)
    assert truth.sky[0, :8].all()
    assert found["sky_empty_fraction"] == pytest.approx(1 - 8 / truth.sky.sum())
    free = geometry.free_space(truth)
    assert (free[~truth.sky] < truth.depth[~truth.sky]).all() and np.isinf(free[truth.sky]).all()


def test_clear_sky_excludes_pixels_beside_other_classes():
    truth = truth_of()
    truth.depth[:10] = np.inf
    truth.depth[5, 5] = 3.0  # one pixel of vegetation
    passed = np.ones(truth.depth.shape)
    passed[4:7, 4:7] = passed[9] = 0.5  # its neighbours, and those of the ground
    found = geometry.emptiness_scores([1 - passed], [passed], (truth,))
    assert found["clear_sky_empty_fraction"] == 1 > found["sky_empty_fraction"] + 0.05
    passed[2, :8] = 0.5
    found = geometry.emptiness_scores([1 - passed], [passed], (truth,))
    clear = 9 * truth.depth.shape[1] - 9
    assert found["clear_sky_empty_fraction"] == pytest.approx(1 - 8 / clear)


def test_clear_floater_mass_excludes_depth_edges():
    truth = truth_of()
    truth.depth[:] = 10.0
    truth.depth[8:11, 8:11] = 4.0  # a nearer surface
    beside = np.zeros(truth.depth.shape, bool)
    beside[7:12, 7:12] = True
    beside[8:11, 8:11] = False
    assert np.array_equal(geometry.occluded_edges(truth), beside)
    absorbed = np.where(beside, 1.0, 0.125)
    found = geometry.emptiness_scores([absorbed], [1 - absorbed], (truth,))
    assert found["clear_floater_mass"] == pytest.approx(0.125)
    assert found["floater_mass"] == pytest.approx(0.125 + 0.875 * beside.mean())
    # Neither a receding surface nor a surface before the sky is an occluded edge.
    truth.depth[:] = np.linspace(5, 9, truth.depth.shape[0])[:, None]
    truth.depth[:4] = np.inf
    assert not geometry.occluded_edges(truth)[4:].any()


def waterline(depth, level, truth, mask):
    return weather_scores.waterline_scores(
        [depth], [mask], [truth.c2w], level, (truth,), 0.3, 1 / CAMERA.fx
    )


def test_waterline_scores_of_the_truth_and_of_a_known_displacement():
    truth = truth_of(rise=0.1)  # water at 0.3 m ends at y = 3
    from_eye = truth.points - truth.c2w[:3, 3]
    line, _ = weather_scores.crossings(from_eye, truth.points[..., 2] - 0.3)
    np.testing.assert_allclose(line[:, 1], 3.0, atol=0.02)
    wet = weather_scores.water_visible(truth, 0.3)
    assert wet.any() and (truth.points[wet][:, 2] < 0.3).all()
    right = waterline(truth.depth, 0.3, truth, wet)
    assert right["waterline_error_cm"] < 0.01 and right["waterline_error_px"] < 0.01
    assert right["waterline_height_error_cm"] < 2 and right["water_iou"] == 1.0
    # On a slope of one in ten, 2 cm of height move the line by 20 cm.
    high = waterline(truth.depth, 0.32, truth, weather_scores.water_visible(truth, 0.32))
    assert high["waterline_error_cm"] == pytest.approx(20.0, rel=0.05)
    assert high["waterline_height_error_cm"] == pytest.approx(2.0, abs=0.5)
    assert 0.9 < high["water_iou"] < 1
    # A missing line counts as 10 m.
    none = waterline(truth.depth, -5.0, truth, np.zeros(wet.shape))
    assert none["waterline_error_cm"] == pytest.approx(1000.0) and none["water_iou"] == 0.0


def test_a_false_shore_increases_the_waterline_error():
    """A false bump in the water adds a shore to the rendered line."""
    truth = truth_of(rise=0.1)
    hump = truth.depth.copy()
    hump[36:46, 10:54] *= 0.85
    found = waterline(hump, 0.3, truth, weather_scores.water_visible(truth, 0.3))
    assert found["waterline_error_cm"] > 1


def test_water_correlation_is_high_only_where_crests_lie_in_place():
    rng = np.random.default_rng(0)
    true = [rng.integers(0, 256, (30, 40, 3), np.uint8) for _ in range(2)]
    mask = [np.tile(np.arange(40) < 25, (30, 1)).astype(float)] * 2
    brighter = [(each // 2 + 90).astype(np.uint8) for each in true]
    moved = [np.roll(each, 3, axis=0) for each in true]
    assert weather_scores.water_correlation(brighter, true, mask) == pytest.approx(1, abs=1e-3)
    assert abs(weather_scores.water_correlation(moved, true, mask)) < 0.15
    assert math.isnan(weather_scores.water_correlation(true, true, [0 * m for m in mask]))


def test_snow_scores_of_a_known_thickness_error():
    truth = truth_of()
    snowy = sloped_ground(truth.c2w, offset=0.15)
    real = {"depth": snowy, "thickness": np.where(truth.sky, 0.0, 0.15)}
    thin = {
        "depth": sloped_ground(truth.c2w, offset=0.13),
        "snow_thickness": np.where(truth.sky, 0.0, 0.13),
        "mask_snow": (~truth.sky).astype(float),
    }
    found = weather_scores.snow_scores([thin], (truth,), [real], 1 / 50)
    assert found["thickness_error_cm"] == pytest.approx(2.0, abs=1e-6)
    assert found["snow_surface_error_cm"] == pytest.approx(2.0, rel=0.03)
    assert found["snow_iou"] == 1.0 and found["true_thickness_cm"] == pytest.approx(15.0)
    kinds = [name for name in weather_scores.SNOWY_CLASSES if not np.isnan(found[f"snowy_{name}"])]
    assert kinds and all(found[f"snowy_{k}"] == found[f"true_snowy_{k}"] > 0.9 for k in kinds)
    bare = thin | {"mask_snow": np.zeros(truth.depth.shape)}
    dusted = thin | {"snow_thickness": np.where(truth.sky, 0.0, 0.004)}  # as thin as bare truth
    for each in (bare, dusted):
        none = weather_scores.snow_scores([each], (truth,), [real], 1 / 50)
        assert none["snow_iou"] == 0.0
        assert all(none[f"snowy_{k}"] == 0 and none[f"true_snowy_{k}"] > 0.9 for k in kinds)


def test_radiance_of_snow_on_terrain_over_that_on_roads():
    truth = truth_of()
    truth.label[:, :32] = np.where(truth.label[:, :32] == SKY, SKY, TERRAIN)
    ours = np.full((*truth.depth.shape, 3), 0.5)
    ours[:, :32] *= 0.6
    true = np.rint(255 * to_display(np.where(np.arange(64)[:, None] < 32, 0.4, 0.5)))
    picture = np.broadcast_to(true, ours.shape).astype(np.uint8)
    scores = weather_scores.ground_scores([ours], [picture], (truth,))
    assert scores["terrain_over_road"] == pytest.approx(0.6)
    assert scores["true_terrain_over_road"] == pytest.approx(0.8, abs=0.01)
    alone = weather_scores.ground_scores([ours], [picture], (truth_of(),))
    assert np.isnan(list(alone.values())).all()


def test_unknown_classes_count_as_wrong():
    truth = truth_of()
    right = geometry.MERGED[truth.label]
    found = geometry.label_scores([right], (truth,))
    assert found["miou"] == 1.0 and set(found) == {"miou", "iou_road", "iou_sky"}
    half = right.copy()
    half[truth.sky] = 255
    assert geometry.label_scores([half], (truth,))["iou_sky"] == 0.0


def analytic_view(rise=0.0):
    truth = truth_of(rise)
    red = np.linspace(0.1, 0.6, 64) * np.ones((48, 1))
    linear = np.stack([red, 0.3 * np.ones_like(red), 0.2 * np.ones_like(red)], -1)
    linear[truth.sky] = (0.5, 0.6, 0.9)
    normal = truth.normal @ truth.c2w[:3, :3].T
    return CleanView(linear, truth.depth, normal, truth.rays_d, truth.c2w, CAMERA)


def test_tuning_recovers_the_constants_of_synthetic_truth():
    view, colour = analytic_view(), np.array([0.8, 0.7, 0.6])
    foggy = to_display(baselines.depth_fog(view, 0.1, colour))
    found = baselines.tuned_sigma([view], [np.round(255 * foggy).astype(np.uint8)], 0.05, colour)
    assert found == pytest.approx(0.1, rel=0.1)
    coverage = baselines.snow_coverage(view)
    assert (
        coverage[~np.isinf(view.depth)].min() > 0.99 and coverage[np.isinf(view.depth)].max() < 1e-6
    )
    painted = to_display(baselines.overlay(view.linear, coverage, colour))
    true = [np.round(255 * painted).astype(np.uint8)]
    white = baselines.tuned_colour([view.linear * (1 - coverage[..., None])], [coverage], true)
    np.testing.assert_allclose(white, colour, atol=0.01)


def test_painted_snow_keeps_what_the_mask_leaves_and_finds_the_paint():
    view, colour = analytic_view(), np.array([0.8, 0.7, 0.6])
    mask = 0.5 * baselines.snow_coverage(view)
    truth = to_display(baselines.overlay(view.linear, mask, colour))
    true = [np.round(255 * truth).astype(np.uint8)]
    (painted,) = painted_snow([view.linear], [mask], true)
    assert np.abs(painted.astype(int) - true[0]).max() <= 2
    free = mask < 1e-6
    assert free.any()
    np.testing.assert_array_equal(painted[free], true[0][free])


def test_screen_reflection_finds_visible_surfaces_and_the_sky():
    """A wall behind water: reflected rays towards the wall get its colour, others the sky."""
    pose = pitched_pose(1.5, 0.0)
    rays = world_rays(CAMERA, pose).astype(float)
    with np.errstate(divide="ignore"):
        ground = np.where(rays[..., 2] < 0, -1.5 / np.minimum(rays[..., 2], -1e-9), np.inf)
    wall = 8.0 / rays[..., 1]
    high = 1.5 + wall * rays[..., 2] > 2.5
    depth = np.where(high, np.inf, np.minimum(ground, wall))
    linear = np.where((wall < ground)[..., None], [0.7, 0.1, 0.1], [0.2, 0.2, 0.2])
    linear[high] = (0.1, 0.2, 0.9)
    view = CleanView(linear, depth, np.zeros_like(linear), rays, pose, CAMERA)
    wet, t = baselines.wet_pixels(view, 0.1)
    assert wet.any() and (t[wet] < depth[wet]).all()
    radiance, reflectance = baselines.screen_reflection(view, 0.1, 1.333, np.zeros((48, 64, 2)))
    column = 32
    rows = np.flatnonzero(wet[:, column])
    assert np.allclose(radiance[rows[0], column], [0.7, 0.1, 0.1]), "the wall"
    assert reflectance[rows[0], column] > reflectance[rows[-1], column], "grazing angles"
    sky = [r for r in rows if np.allclose(radiance[r, column], [0.1, 0.2, 0.9])]
    assert sky and min(sky) > rows[0], "the reflected sky is nearer to the camera"


def test_tuned_colour_minimises_the_error_of_display_values():
    """For dark and bright pixels the best single display colour is darker than the linear mean."""
    rng = np.random.default_rng(1)
    true = [np.where(rng.uniform(size=(20, 20, 1)) < 0.3, 250, 40).astype(np.uint8).repeat(3, -1)]
    base, coverage = [np.zeros((20, 20, 3))], [np.ones((20, 20))]
    found = baselines.tuned_colour(base, coverage, true)

    def error(colour):
        return ((to_display(colour) - true[0] / 255.0) ** 2).mean()

    mean = baselines.linear_of(true[0]).mean((0, 1))
    assert error(found) < 0.97 * error(mean)


def test_transmittance_error_is_the_mean_absolute_difference():
    passed = np.linspace(0, 1, 12).reshape(3, 4)
    assert weather_scores.transmittance_scores([passed], [passed])["transmittance_error"] == 0
    off = weather_scores.transmittance_scores([passed], [np.clip(passed + 0.1, 0, 2)])
    assert off["transmittance_error"] == pytest.approx(0.1)


def frames_of(pattern, step=0.5):
    """Return two frames of a textured plane from cameras `step` metres apart."""
    out = []
    for index in (0, 1):
        pose = pitched_pose(3.0, -50.0)
        pose[1, 3] = index * step
        depth = sloped_ground(pose)
        rays = world_rays(CAMERA, pose).astype(float)
        points = pose[:3, 3] + depth[..., None] * rays
        out.append(Frame(pattern(points, index), depth, np.zeros(depth.shape, bool), pose, CAMERA))
    return out


def smooth_pattern(points, _):
    x, y = points[..., 0], points[..., 1]
    return np.stack([0.5 + 0.4 * np.sin(x), 0.5 + 0.4 * np.cos(y), 0.5 + 0 * x], -1)


def test_warp_error_is_small_for_a_rigid_scene_and_large_for_frame_noise():
    first, second = frames_of(smooth_pattern)
    assert warp_error(first, second) < 0.02
    assert warp_error(first, first) < 1e-6
    noisy = frames_of(lambda x, i: baselines.frame_noise(smooth_pattern(x, i), i))
    assert warp_error(*noisy) > 5 * warp_error(first, second)
    excluded = Frame(
        second.picture, second.depth, np.ones(second.depth.shape, bool), second.c2w, CAMERA
    )
    assert np.isnan(warp_error(first, excluded)), "all pixels are water"


def test_warp_error_ignores_hidden_points():
    first, second = frames_of(smooth_pattern)
    blocked = Frame(
        np.zeros_like(second.picture), 0.5 * second.depth, second.excluded, second.c2w, CAMERA
    )
    assert np.isnan(warp_error(first, blocked))


def test_bilinear_interpolation_is_exact_at_pixel_centres():
    picture = np.random.default_rng(0).uniform(size=(5, 7, 3))
    found = bilinear(picture, np.array([[2.5, 1.5], [3.0, 1.5]]))
    np.testing.assert_allclose(found[0], picture[1, 2])
    np.testing.assert_allclose(found[1], 0.5 * (picture[1, 2] + picture[1, 3]))


def test_other_folders_are_refused_as_reference_sets(tmp_path):
    with pytest.raises(UserError, match="no reference set"):
        read_reference(tmp_path)
    (tmp_path / "reference.json").write_text(json.dumps({"schema_version": 1}))
    with pytest.raises(UserError, match="damaged"):
        read_reference(tmp_path)


def test_open_ground_has_no_surface_above_it():
    """All level ground is open, unless another view shows a surface above it."""
    ground = truth_of()
    found = geometry.open_ground((ground,))
    assert len(found) > 10
    middle = found.mean(0)
    raised = dataclasses.replace(ground, c2w=ground.c2w + np.outer([0, 0, 3.0, 0], [0, 0, 0, 1]))
    # The same ground 3 m higher covers all of the lower ground, and is open itself.
    both = geometry.open_ground((ground, raised))
    assert len(both) and both[:, 2].min() > middle[2] + 1.5


def test_a_report_without_weather_has_no_table_of_baselines():
    table = {
        "clean": {"psnr": 25.0, "ssim": 0.8},
        "frame": {"scale": 1.0}, "geometry": {"ground_within_5cm": 0.5}, "labels": {"miou": 0.9},
        "completeness": {"mirror_psnr": math.nan}, "weather": {}, "baselines": {},
        "consistency": {"clean": {"next": 0.02, "far": 0.1}, "baselines": {}},
    }  # fmt: skip
    text = table_text(table)
    assert "ground within 5cm 0.5" in text and "0.020 / 0.100" in text
    assert "PSNR dB / SSIM" not in text
