import json
from pathlib import Path

import numpy as np
import pytest

from climatenerf.core.errors import UserError
from climatenerf.paths.camera_path import camera_path, fitted_camera, orbit, still
from climatenerf.paths.camera_path import smoothed_training_path as training_path
from climatenerf.paths.tour import longest_segment, looking_at
from climatenerf.scene import Camera, Scene, View

CAMERA = Camera(640, 360, 500.0, 500.0, 320.0, 180.0)


def scene_of(c2w, camera=CAMERA, names=None, points=None):
    names = names or [f"{i:04}.jpg" for i in range(len(c2w))]
    views = [View(n, Path("/none") / n, 0, m) for n, m in zip(names, c2w, strict=True)]
    views.sort(key=lambda view: view.name)
    return Scene(Path("/none"), "colmap", (camera,), tuple(views), points)


def ring(count, arc=2 * np.pi, radius=5.0):
    a = np.linspace(0, arc, count, endpoint=False)
    position = np.stack([radius * np.cos(a), radius * np.sin(a), np.full(count, 2.0)], axis=1)
    return looking_at(position + [10.0, 0, 0], np.array([10.0, 0.0, 1.0]))


def drive(count, side=False):
    rng = np.random.default_rng(0)
    position = np.stack([np.arange(count) * 1.0, np.zeros(count), np.full(count, 1.6)], axis=1)
    position += 0.02 * rng.normal(size=position.shape)
    target = np.array([0.0, 1e6, 0.0]) if side else np.array([1e6, 0.0, 0.0])
    return looking_at(position, target)


def rolled(c2w, degrees):
    a = np.radians(degrees)
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]
    return c2w @ turn


def check_valid(path, frames):
    assert len(path) == frames and path.c2w.shape == (frames, 4, 4)
    r = path.c2w[:, :3, :3]
    assert np.allclose(r @ r.transpose(0, 2, 1), np.eye(3), atol=1e-9)
    assert np.allclose(np.linalg.det(r), 1.0)


def distance_to(path, c2w):
    gap = path.c2w[:, None, :3, 3] - c2w[None, :, :3, 3]
    return np.linalg.norm(gap, axis=-1).min(axis=1)


def test_training_path_has_no_roll_even_spacing_and_stays_near_the_photographs():
    rng = np.random.default_rng(1)
    poses = np.stack([rolled(m, a) for m, a in zip(drive(40), rng.normal(0, 4, 40), strict=True)])
    path = training_path(scene_of(poses), 25, (480, 270))
    check_valid(path, 25)
    step = np.linalg.norm(np.diff(path.c2w[:, :3, 3], axis=0), axis=1)
    assert step.max() < 1.02 * step.min()
    assert step.sum() == pytest.approx(39, rel=0.02), "from the first photograph to the last"
    assert distance_to(path, poses).max() < 0.55, "half a step, plus the jitter"
    assert np.abs(path.c2w[:, 2, 0]).max() < 1e-9, "x axis horizontal: no roll"
    assert (path.c2w[:, 2, 1] < -0.9).all(), "y axis down"
    assert (path.c2w[:, 0, 2] > 0.99).all(), "still looks along the drive"
    assert path.notes == ()


def test_smoothing_removes_jitter():
    poses = ring(60)
    shaken = poses.copy()
    shaken[:, :3, 3] += 0.1 * np.random.default_rng(2).normal(size=(60, 3))
    path = training_path(scene_of(shaken), 200)
    radius = np.linalg.norm(path.c2w[:, :2, 3] - [10, 0], axis=1)
    inner = slice(20, -20)
    assert np.abs(radius[inner] - 5).std() < 0.05
    # A shaking camera changes direction at every step; a circle turns evenly.
    heading = np.diff(path.c2w[inner, :3, 3], axis=0)
    turn = np.sum(heading[1:] * heading[:-1], axis=1)
    turn /= np.linalg.norm(heading[1:], axis=1) * np.linalg.norm(heading[:-1], axis=1)
    assert np.degrees(np.arccos(np.clip(turn, -1, 1))).max() < 8


def test_names_without_spatial_order_give_a_tour_by_distance():
    poses = ring(40, arc=1.6 * np.pi)
    order = np.random.default_rng(4).permutation(40)
    path = training_path(scene_of(poses[order]), 60)
    assert "no spatial order" in path.notes[0]
    length = np.linalg.norm(np.diff(path.c2w[:, :3, 3], axis=0), axis=1).sum()
    assert length == pytest.approx(5 * 1.6 * np.pi, rel=0.1)
    assert distance_to(path, poses).max() < 0.6


def test_a_path_follows_the_longest_segment_between_jumps():
    first, second = drive(30), drive(12)
    second[:, 1, 3] += 40.0
    path = training_path(scene_of(np.concatenate([first, second])), 30)
    assert "30 of 42" in path.notes[0]
    assert np.abs(path.c2w[:, 1, 3]).max() < 0.5


def test_rotation_at_one_position_and_few_views():
    turn = looking_at(np.zeros((8, 3)) + [0, 0, 1.6], np.array([5.0, 0, 1.6]))
    for i, angle in enumerate(np.linspace(0, 1.5, 8)):
        c, s = np.cos(angle), np.sin(angle)
        turn[i, :3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ turn[i, :3, :3]
    path = training_path(scene_of(turn), 10)
    check_valid(path, 10)
    assert np.allclose(path.c2w[:, :3, 3], [0, 0, 1.6])
    assert path.c2w[0, 0, 2] > 0.9 > 0.3 > path.c2w[-1, 0, 2]
    for count in (1, 2, 3):
        for make in (training_path, orbit):
            check_valid(make(scene_of(drive(count)), 5), 5)
    check_valid(training_path(scene_of(drive(9)), 1), 1)
    with pytest.raises(UserError, match="--frames 1 or more"):
        training_path(scene_of(drive(9)), 0)


def test_a_camera_looking_down_stays_finite():
    position = np.stack([np.arange(12.0), np.zeros(12), np.full(12, 30.0)], axis=1)
    nadir = np.repeat(np.eye(4)[None], 12, axis=0)
    nadir[:, :3, :3] = np.diag([1.0, -1.0, -1.0])
    nadir[:, :3, 3] = position
    path = training_path(scene_of(nadir), 9)
    check_valid(path, 9)
    assert np.allclose(path.c2w[:, :3, 0], [1, 0, 0], atol=1e-6), "the photographs' own x axis"


def test_orbit_of_a_ring_is_the_same_ring():
    poses = ring(24)
    path = orbit(scene_of(poses), 36, (320, 180))
    check_valid(path, 36)
    assert path.name == "orbit" and path.size == (320, 180)
    centre = path.c2w[:, :3, 3] - [10, 0, 0]
    assert np.allclose(np.hypot(centre[:, 0], centre[:, 1]), 5.0)
    assert np.allclose(centre[:, 2], 2.0)
    to_target = np.array([10.0, 0, 1.0]) - path.c2w[:, :3, 3]
    to_target /= np.linalg.norm(to_target, axis=1, keepdims=True)
    assert np.allclose(to_target, path.c2w[:, :3, 2], atol=1e-9)
    step = np.linalg.norm(np.diff(centre, axis=0, append=centre[:1]), axis=1)
    assert np.ptp(step) < 1e-9, "closed"


def test_orbit_of_an_arc_stays_on_the_arc():
    poses = ring(30, arc=np.radians(120))
    path = orbit(scene_of(poses), 40)
    assert path.name == "orbit"
    assert distance_to(path, poses).max() < 0.25


@pytest.mark.parametrize("side", [False, True])
def test_orbit_without_a_centre_is_a_small_ellipse(side):
    poses = drive(54, side)
    path = orbit(scene_of(poses), 30)
    check_valid(path, 30)
    assert path.name == "sway" and "do not surround a point" in path.notes[0]
    assert distance_to(path, poses).max() < 0.6
    assert np.ptp(path.c2w[:, 0, 3]) > 1.0, "it moves"
    ahead = path.c2w[:, :3, 2] @ poses[27, :3, 2]
    assert ahead.min() > 0.9, "and looks where the photographs look"


def test_still_has_the_pose_of_the_photograph():
    poses = np.stack([rolled(m, 7) for m in drive(5)])
    scene = scene_of(poses, Camera(640, 360, 500, 500, 310, 190, k1=-0.1))
    for name in ("0003.jpg", "0003", 3, "3"):
        path = still(scene, name, 4)
        assert np.array_equal(path.c2w, np.repeat(poses[3][None], 4, axis=0))
        assert path.cameras[0] == scene.cameras[0]
    assert still(scene, None, 1).name == "still:0002.jpg"
    sized = still(scene, 3, 1, (320, 180)).cameras[0]
    assert sized.width == 320 and not sized.distorted
    with pytest.raises(UserError, match="no view '0009x'.*such as '000"):
        still(scene, "0009x", 1)
    with pytest.raises(UserError, match="no view '77'"):
        camera_path("still:77", scene, 1)


def test_fitted_camera_keeps_the_field_of_view():
    scene = scene_of(drive(3))
    same = fitted_camera(scene, (320, 180))
    assert same.fx == same.fy == pytest.approx(250) and (same.cx, same.cy) == (160, 90)
    assert fitted_camera(scene).fx == pytest.approx(500)
    wide = fitted_camera(scene, (480, 180))
    assert 480 / wide.fx > 640 / 500 and 180 / wide.fx < 360 / 500, "wider and lower"
    assert 480 / wide.fx <= 1.5 * 640 / 500 + 1e-9
    # A phone on its side: its long side stands upright in a level movie.
    on_side = scene_of(np.stack([rolled(m, 90) for m in drive(3)]))
    upright = fitted_camera(on_side, (180, 320))
    assert upright.fx == pytest.approx(250)
    fish = Camera(640, 640, 200, 200, 320, 320, fisheye=True)
    assert 1.4 < fitted_camera(scene_of(drive(3), fish), (480, 480)).width / 2 / 168 < 1.5
    with pytest.raises(UserError, match="0x180"):
        fitted_camera(scene, (0, 180))


def nerfstudio_file(folder, poses, **changes):
    entries = [{"camera_to_world": list(np.ravel(m)), "fov": 60.0, "aspect": 1.7} for m in poses]
    data = {"camera_type": "perspective", "render_height": 270, "render_width": 480, "fps": 30}
    data |= {"camera_path": entries} | changes
    path = folder / "path.json"
    path.write_text(json.dumps(data))
    return path


def test_nerfstudio_poses_are_transformed_back_through_every_frame(tmp_path):
    rng = np.random.default_rng(5)
    truth = ring(6)  # in world metres
    q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    q *= np.sign(np.linalg.det(q))
    world_from_input = np.eye(4)
    world_from_input[:3, :3], world_from_input[:3, 3] = 2.5 * q, [1, 2, 3]
    input_from_world = np.linalg.inv(world_from_input)
    applied = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    centred = np.eye(4)
    centred[:3, :3], centred[:3, 3] = rotation, [0.3, -0.2, 0.1]

    def in_model(c2w):
        pose = centred @ input_from_world @ c2w
        pose[:3, :3] *= 2.5  # back to a rotation
        pose[:3, 3] *= 0.4
        return pose @ np.diag([1, -1, -1, 1.0])

    (tmp_path / "transforms.json").write_text(json.dumps({"applied_transform": applied.tolist()}))
    (tmp_path / "dataparser_transforms.json").write_text(
        json.dumps({"transform": (centred @ applied)[:3].tolist(), "scale": 0.4})
    )
    path = nerfstudio_file(tmp_path, [in_model(m) for m in truth])
    scene = Scene(tmp_path, "transforms", (CAMERA,), scene_of(truth).views, None, world_from_input)
    back = camera_path(str(path), scene, 99)
    assert np.allclose(back.c2w, truth, atol=1e-9)
    assert back.size == (480, 270) and back.fps == 30 and "dataparser" in back.notes[0]
    assert back.cameras[0].fy == pytest.approx(135 / np.tan(np.radians(30)))
    half = camera_path(str(path), scene, 99, (240, 135))
    assert half.cameras[0].fy == pytest.approx(back.cameras[0].fy / 2)


def test_nerfstudio_path_without_dataparser_is_in_the_input_frame(tmp_path):
    truth = ring(3)
    path = nerfstudio_file(tmp_path, truth @ np.diag([1, -1, -1, 1.0]))
    back = camera_path(str(path), scene_of(truth), 1)
    assert np.allclose(back.c2w, truth) and "capture's frame" in back.notes[0]


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"camera_type": "fisheye"}, "only perspective"),
        ({"camera_path": []}, "no frames"),
        ({"camera_path": [{"camera_to_world": [1, 2], "fov": 60}]}, "frame 0.*16 numbers"),
        ({"camera_path": [{"camera_to_world": [0] * 16, "fov": 60}]}, "rotation"),
        ({"camera_path": [{"camera_to_world": [float("nan")] * 16, "fov": 60}]}, "finite"),
        ({"camera_path": [{"camera_to_world": list(np.eye(4).ravel())}]}, "fov"),
        ({"camera_path": [{"camera_to_world": list(np.eye(4).ravel()), "fov": 180}]}, "180"),
        ({"render_width": "wide"}, "0x270"),
    ],
)
def test_damaged_nerfstudio_paths_are_refused(tmp_path, changes, message):
    path = nerfstudio_file(tmp_path, [np.eye(4)], **changes)
    with pytest.raises(UserError, match=message):
        camera_path(str(path), scene_of(ring(3)), 1)


def test_unknown_paths_are_refused():
    with pytest.raises(UserError, match="training, orbit, still"):
        camera_path("spiral", scene_of(ring(3)), 1)
    with pytest.raises(UserError, match="does not exist"):
        camera_path("absent.json", scene_of(ring(3)), 1)


@pytest.mark.parametrize("name", ["ditch", "stone_sign", "kitti_drive", "fox"])
def test_real_captures(captures, name):
    from climatenerf.scene import read_scene

    scene = read_scene(captures / name)
    poses = np.stack([scene.c2w_world(view) for view in scene.of_split("train")])
    step = np.linalg.norm(np.diff(longest_segment(poses)[:, :3, 3], axis=0), axis=1)
    path = camera_path("training", scene, 48, (480, 270))
    check_valid(path, 48)
    # Half the widest gap between two photographs, and a hand's shaking smoothed away.
    assert distance_to(path, poses).max() < 0.5 * step.max() + np.median(step)
    around = camera_path("orbit", scene, 48, (480, 270))
    check_valid(around, 48)
    assert around.name == ("sway" if name in ("ditch", "kitti_drive") else "orbit")
