from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from support.scene_builders import look_at, posts_picture, ring

from climatenerf.scene import Camera, Scene, View
from climatenerf.scene.alignment.ground_plane import find_ground, ground_plane
from climatenerf.scene.alignment.up import UpEstimate, combine, up_from_cameras
from climatenerf.scene.alignment.vanishing_point import (
    find_vanishing_point,
    segment_normals,
    upright_segments,
    vanishing_point_from_normals,
    vanishing_point_with_split_error,
)
from climatenerf.scene.alignment.world_frame import align_scene

CAMERA = Camera(320, 240, 260.0, 260.0, 160.0, 120.0)
UP = np.array([0.0, 0.0, 1.0])


def degrees(a, b):
    return np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1)))


def random_rotation(seed):
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


def tilted(pose, roll, pitch):
    """The camera turned about its own axes, degrees."""
    r, p = np.radians([roll, pitch])
    about_z = np.array([[np.cos(r), -np.sin(r), 0], [np.sin(r), np.cos(r), 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, np.cos(p), -np.sin(p)], [0, np.sin(p), np.cos(p)]])
    out = pose.copy()
    out[:3, :3] = pose[:3, :3] @ about_x @ about_z
    return out


def street(seed=0):
    """Ground z = 0 with clutter up to 1 m, and upright posts, all in metres."""
    random = np.random.default_rng(seed)
    ground = np.c_[random.uniform(-8, 8, (3000, 2)), random.normal(0, 0.02, 3000)]
    clutter = np.c_[random.uniform(-8, 8, (600, 2)), random.uniform(0, 1, 600)]
    stray = np.c_[random.uniform(-8, 8, (15, 2)), random.uniform(-6, -1, 15)]
    turns = random.uniform(0, 2 * np.pi, 14)
    feet = np.stack([6 * np.cos(turns), 6 * np.sin(turns), 0 * turns], axis=-1)
    posts = np.stack([feet, feet + (0, 0, 3.0)], axis=1)
    return np.concatenate([ground, clutter, stray]), posts


def scene_from(tmp_path, poses, points, posts, seed=0, scale=1.0, exif=None):
    """The street seen by cameras, in an arbitrarily turned, scaled and moved input frame."""
    rotation, shift = random_rotation(seed), np.array([3.0, -5.0, 7.0])
    views = []
    for i, pose in enumerate(poses):
        path = tmp_path / f"{i:03}.png"
        posts_picture(CAMERA, pose, posts).save(path, **({"exif": exif} if exif else {}))
        turned = np.eye(4)
        turned[:3, :3] = rotation @ pose[:3, :3]
        turned[:3, 3] = scale * rotation @ pose[:3, 3] + shift
        views.append(View(path.name, path, 0, turned))
    points = None if points is None else scale * points @ rotation.T + shift
    return Scene(tmp_path, "test", (CAMERA,), tuple(views), points), rotation @ UP


def used_up(scene):
    return scene.world_from_input[2, :3] / scene.scale


def test_everything_within_a_degree_and_a_few_percent(tmp_path):
    points, posts = street()
    random = np.random.default_rng(5)
    poses = [tilted(p, *random.normal(0, 3, 2)) for p in ring(12)]
    scene, up = scene_from(tmp_path, poses, points, posts, seed=4, scale=0.37)
    out = align_scene(scene)
    assert degrees(used_up(out), up) < 1
    assert set(out.up_report) == {"used", "cameras", "ground", "lines"}
    assert out.scale == pytest.approx(1 / 0.37, rel=0.03)
    assert out.scale_source == "camera-height-assumed" and out.scale_error == 0.3
    assert any("scale is assumed" in w for w in out.warnings)
    positions = np.array([out.c2w_world(v)[:3, 3] for v in out.views])
    np.testing.assert_allclose(positions.mean(axis=0)[:2], 0, atol=1e-9)
    assert np.median(positions[:, 2]) == pytest.approx(1.6, abs=0.05)
    assert out.ground_z == 0 and -0.2 < out.lowest_ground_z <= 0


def test_camera_height_sets_the_scale(tmp_path):
    points, posts = street()
    scene, _ = scene_from(tmp_path, ring(9), points, posts, scale=2.5)
    out = align_scene(scene, camera_height=3.2)
    assert out.scale == pytest.approx(2 / 2.5, rel=0.03)
    assert out.scale_source == "camera-height" and out.scale_error < 0.2
    assert not any("assumed" in w for w in out.warnings)


def test_common_pitch_is_found_by_lines_and_reported(tmp_path):
    # All cameras look the same way and 7 degrees down: only the posts know where up is.
    _, posts = street()
    posts = posts + (0.0, 9.0, 0.0)
    poses = [
        look_at((x, 0, 1.6), (x, 10.0, 1.6 - 10 * np.tan(np.radians(7)))) for x in range(-4, 5)
    ]
    scene, up = scene_from(tmp_path, poses, None, posts, seed=1)
    out = align_scene(scene)
    assert degrees(used_up(out), up) < 1
    assert out.up_report["cameras"] > 5 and "lines" in out.up_report["used"]
    assert any("Up is uncertain: cameras" in w for w in out.warnings)


def felt(scene, up, tilt=0.0):
    """What accelerometers tell of cameras, alternately tilted by some degrees."""
    down = {}
    for i, view in enumerate(scene.views):
        local = view.c2w[:3, :3].T @ -up
        a = np.radians(tilt if i % 2 else -tilt)
        turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
        down[view.name] = tuple(turn @ local)
    return down


def test_gravity_leads_where_pictures_cannot_tell(tmp_path):
    # From a drone: all cameras look straight down, so that their own axes say nothing of up.
    poses = [look_at((x, 0, 20.0), (x, 0.001, 0.0)) for x in range(-4, 5)]
    scene, up = scene_from(tmp_path, poses, None, street()[1], seed=2)
    assert degrees(used_up(align_scene(scene)), up) > 45
    out = align_scene(scene, gravity=felt(scene, up, tilt=2.0))
    assert degrees(used_up(out), up) < 1 and out.up_report["used"].startswith("gravity")
    assert out.up_report["cameras"] > 45
    assert any("Up is uncertain: cameras" in w for w in out.warnings)


def test_gravity_that_contradicts_itself_or_is_rare_is_left_out(tmp_path):
    points, posts = street()
    scene, up = scene_from(tmp_path, ring(9), points, posts)
    wild = felt(scene, up)
    rng = np.random.default_rng(0)
    for name in wild:
        v = rng.normal(size=3)
        wild[name] = tuple(v / np.linalg.norm(v))
    rare = dict(list(felt(scene, up).items())[:2])
    for gravity in (wild, rare):
        out = align_scene(scene, gravity=gravity)
        assert "gravity" not in out.up_report and degrees(used_up(out), up) < 1
    one_wrong = felt(scene, up) | {scene.views[0].name: (0.0, 0.0, 1.0)}
    assert align_scene(scene, gravity=one_wrong).up_report["gravity"] < 1


def test_metric_input_is_kept_exactly(tmp_path):
    points, posts = street()
    points = points + (0, 0, 42.0)
    posts = posts + (0, 0, 42.0)
    poses = [p.copy() for p in ring(9)]
    for p in poses:
        p[2, 3] += 42
    views = scene_from(tmp_path, poses, None, posts)[0].views
    views = tuple(replace(v, c2w=p) for v, p in zip(views, poses, strict=True))
    out = align_scene(Scene(tmp_path, "test", (CAMERA,), views, points), metric_input=True)
    np.testing.assert_array_equal(out.world_from_input, np.eye(4))
    assert out.ground_z == pytest.approx(42, abs=0.05)
    assert out.scale_source == "metric-input" and out.scale_error == 0
    assert max(v for k, v in out.up_report.items() if k != "used") < 4


def test_map_coordinates_come_near_the_origin_and_keep_their_metres(tmp_path):
    points, posts = street()
    away = np.array([500_250.0, 4_999_800.0, 12.0])
    poses = [p.copy() for p in ring(9)]
    for p in poses:
        p[:3, 3] += away
    views = scene_from(tmp_path, ring(9), None, posts)[0].views
    views = tuple(replace(v, c2w=p) for v, p in zip(views, poses, strict=True))
    out = align_scene(Scene(tmp_path, "test", (CAMERA,), views, points + away), metric_input=True)
    centre = np.mean([out.c2w_world(v)[:3, 3] for v in out.views], axis=0)
    assert np.abs(centre[:2]).max() < 1001 and centre[2] > 10
    np.testing.assert_array_equal(out.world_from_input[:3, :3], np.eye(3))
    assert (out.world_from_input[:2, 3] % 1000 == 0).all()
    assert any("far from their origin" in w for w in out.warnings)


def test_metric_input_with_another_up_is_reported(tmp_path):
    points, posts = street()
    scene, _ = scene_from(tmp_path, ring(9), points, posts, seed=2)
    out = align_scene(scene, metric_input=True)
    assert any("the input's z axis disagree" in w for w in out.warnings)


def test_no_points_puts_the_ground_below_all_cameras(tmp_path):
    poses = [*ring(6), look_at((4, 0, 0.4), (0, 0, 1.2)), look_at((0, 4, 3), (0, 0, 1.2))]
    scene, _ = scene_from(tmp_path, poses, None, [])
    out = align_scene(scene)
    heights = [out.c2w_world(v)[2, 3] for v in out.views]
    assert min(heights) > 0 and np.median(heights) == pytest.approx(1.6)
    assert out.scale_error == 0.5 and any("No ground" in w for w in out.warnings)


def test_photos_taken_on_edge_but_stored_lying(tmp_path):
    points, posts = street()
    # Turned by 90 degrees so that the stored picture's left side is the shown top (EXIF 6).
    poses = [tilted(p, 90, 0) for p in ring(12)]
    tags = Image.Exif()
    tags[0x0112] = 6
    scene, up = scene_from(tmp_path, poses, points, posts, exif=tags)
    c2w = scene.views[0].c2w[:3, :3]
    assert degrees(-c2w[:, 0], up) < 20  # the builder does what its comment says
    assert degrees(used_up(align_scene(scene)), up) < 1


def test_up_from_cameras_ignores_pitch_when_headings_spread():
    poses = np.stack([tilted(p, 0, -15) for p in ring(16)])
    axes = np.stack([poses[:, :3, 0], -poses[:, :3, 1]], axis=-1)
    estimate = up_from_cameras(axes)
    assert degrees(estimate.direction, UP) < 0.01 and estimate.sigma < 5


def test_combine_rejects_a_lone_outlier_and_follows_a_majority():
    def estimate(tilt, sigma, method):
        t = np.radians(tilt)
        return UpEstimate(np.array([np.sin(t), 0, np.cos(t)]), sigma, method)

    up, used = combine([estimate(0, 5, "cameras"), estimate(18, 0.6, "lines")])
    assert used == "cameras" and degrees(up, UP) < 1e-6
    up, used = combine(
        [estimate(0, 8, "cameras"), estimate(17, 2.5, "ground"), estimate(18, 0.6, "lines")]
    )
    assert used == "lines+ground" and 17.8 < degrees(up, UP) < 18
    up, used = combine(
        [estimate(0, 3, "cameras"), estimate(1, 2.5, "ground"), estimate(18, 0.6, "lines")]
    )
    assert used == "ground+cameras" and degrees(up, UP) < 1


def test_ground_under_a_path_over_a_ditch():
    # Street at 0 where the cameras walk, channel 3 m deep beside them, hedge above the street.
    random = np.random.default_rng(2)
    x, y = random.uniform(-10, 10, 6000), random.uniform(-3, 12, 6000)
    z = np.where(y > 4, -3.0, 0.0) + random.normal(0, 0.03, 6000)
    hedge = np.c_[
        random.uniform(-10, 10, 3000), random.uniform(-3, -2, 3000), random.uniform(0, 3, 3000)
    ]
    cameras = np.c_[np.linspace(-8, 8, 20), np.zeros(20), np.full(20, 1.7)]
    ground = find_ground(np.concatenate([np.c_[x, y, z], hedge]), cameras)
    assert ground is not None
    assert ground.under_path == pytest.approx(0, abs=0.1)
    assert ground.camera_height == pytest.approx(1.7, abs=0.1)
    assert ground.lowest == pytest.approx(-3, abs=0.1)


def test_ground_plane_of_a_slope_and_none_of_noise():
    random = np.random.default_rng(3)
    xy = random.uniform(-8, 8, (4000, 2))
    slope = np.tan(np.radians(6))
    points = np.c_[xy, xy[:, 0] * slope + random.normal(0, 0.02, 4000)]
    cameras = np.c_[np.linspace(-3, 3, 9), np.zeros(9), np.linspace(-3, 3, 9) * slope + 1.6]
    ground = find_ground(points, cameras)
    assert ground is not None and (plane := ground_plane(ground)) is not None
    assert degrees(plane[0], np.array([-slope, 0, 1])) < 0.5 and plane[1] > 0.9
    noise = find_ground(random.uniform(-8, 0, (4000, 3)) * (1, 1, 1), cameras)
    assert noise is None or ground_plane(noise) is None


def test_ground_ignores_points_at_infinity():
    points, _ = street()
    far = np.array([[1e200, 0, -1e200], [3e15, 1e15, -1e15]])
    cameras = np.array([p[:3, 3] for p in ring(9)])
    ground = find_ground(np.concatenate([points, far]), cameras)
    assert ground is not None and ground.camera_height == pytest.approx(1.6, abs=0.06)


def test_no_ground_without_points_below():
    cameras = np.zeros((5, 3))
    assert find_ground(np.random.default_rng(0).uniform(1, 2, (100, 3)), cameras) is None
    assert find_ground(np.zeros((0, 3)), cameras) is None


def test_segments_lie_on_the_posts():
    posts = np.array([[[-1.0, 6, 0], [-1, 6, 3]], [[1.5, 7, 0.5], [1.5, 7, 3]]])
    pose = look_at((0, 0, 1.6), (0, 6, 1.4))
    grey = np.asarray(posts_picture(CAMERA, pose, posts).convert("L"), dtype=np.float64)
    ends, lengths = upright_segments(grey, CAMERA, pose[:3, :3].T @ UP)
    assert 4 <= len(ends) <= 8  # both sides of both posts, perhaps in pieces
    normals = segment_normals(ends, CAMERA, pose[:3, :3])
    assert np.degrees(np.arcsin(np.abs(normals @ UP))).max() < 0.3
    assert lengths.sum() > 300


def test_vanishing_point_survives_wrong_lines():
    random = np.random.default_rng(0)
    guess = random_rotation(1)[0]
    up = guess + 0.1 * random.normal(size=3)
    up /= np.linalg.norm(up)
    good = np.cross(up, random.normal(size=(60, 3))) + 0.004 * random.normal(size=(60, 3))
    bad = np.cross(guess + 0.4 * random.normal(size=(60, 3)), random.normal(size=(60, 3)))
    normals = np.concatenate([good, bad])
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    found = vanishing_point_from_normals(normals, np.ones(120), np.arange(120) % 10, guess)
    assert found is not None and degrees(found.up, up) < 0.5
    assert found.images == 10 and 0.4 < found.fraction < 0.7
    # Chance agreement is unmasked by halves of the pictures; true uprights pass.
    image = np.arange(120) % 16
    real = vanishing_point_with_split_error(normals, np.ones(120), image, guess)
    chance = vanishing_point_with_split_error(normals[60:], np.ones(60), image[60:], guess)
    assert real is not None and real.sigma < 1
    assert chance is None or chance.sigma > 1.5
    assert vanishing_point_from_normals(normals[:3], np.ones(3), np.arange(3), guess) is None


def test_blank_pictures_have_no_lines(tmp_path):
    scene, up = scene_from(tmp_path, ring(4), None, [])
    assert find_vanishing_point(scene, up) is None
