"""KITTI-360: official layout and PanopticNeRF's package."""

import shutil

import numpy as np
import pytest
from PIL import Image
from support.scene_builders import look_at, pinhole, pixel_of, write_images

from climatenerf.core.errors import UserError
from climatenerf.scene import load_image, read_scene, save_scene
from climatenerf.scene.images import load_labels
from climatenerf.scene.readers.kitti360 import MAX_IMAGES, parse_frames, read_kitti360

DRIVE = "2013_05_28_drive_0000_sync"
OTHER = "2013_05_28_drive_0002_sync"
FRAMES = range(1538, 1544)
SIZE = (48, 20)
K = {
    "00": np.array([[40.0, 0, 20, 0], [0, 40.5, 9, 0], [0, 0, 1, 0]]),
    "01": np.array([[41.0, 0, 22, -24.0], [0, 41.5, 10, 0], [0, 0, 1, 0]]),
}
BASELINE = 0.6


def rotated(axis, degrees):
    a = np.radians(degrees)
    pose = np.eye(4)
    i, j = [k for k in range(3) if k != axis]
    pose[i, i] = pose[j, j] = np.cos(a)
    pose[i, j], pose[j, i] = -np.sin(a), np.sin(a)
    return pose


# Camera-to-IMU poses and rectifying rotations, without any symmetry.
CAMERA_TO_IMU = {
    "00": rotated(0, 80) @ rotated(1, 12) @ rotated(2, 5),
    "01": rotated(0, 70) @ rotated(2, -8) @ rotated(1, 33),
}
CAMERA_TO_IMU["00"][:3, 3], CAMERA_TO_IMU["01"][:3, 3] = (0.8, 0.3, -0.5), (0.7, -0.4, -0.45)
RECTIFICATION = {"00": rotated(0, 1) @ rotated(2, -2), "01": rotated(1, 3) @ rotated(0, -1)}


def true_pose(camera, frame):
    """Pose of a rectified camera that drives north east; camera 1 is to the right of camera 0."""
    position = np.array([1040.0 + frame - 1538, 3738.0 + 0.5 * (frame - 1538), 115.0])
    pose = look_at(position, position + (2.0, 1.0, 0.0))
    pose[:3, 3] += BASELINE * (camera == "01") * pose[:3, 0]
    return pose


def line(values):
    return " ".join(f"{v:.12g}" for v in np.ravel(values))


def make(root, frames=FRAMES, drive=DRIVE, package=False, cameras=("00", "01"), unposed=()):
    pictures = root / drive if package else root / "data_2d_raw" / drive
    for camera in cameras:
        names = [f"image_{camera}/data_rect/{f:010}.png" for f in frames]
        write_images(pictures, names, SIZE)
    (root / "calibration").mkdir(parents=True, exist_ok=True)
    text = "calib_time: 13-Aug-2019 20:34:32\ncorner_dist: 0.1\n"
    for c in ("00", "01"):
        text += f"S_{c}: 50 30\nK_{c}: 1 2 3\n"
        text += f"R_rect_{c}: {line(RECTIFICATION[c][:3, :3])}\nP_rect_{c}: {line(K[c])}\n"
        text += f"S_rect_{c}: {SIZE[0]:.6e} {SIZE[1]:.6e}\n"
    (root / "calibration/perspective.txt").write_text(text)
    extrinsics = "".join(f"image_{c}: {line(m[:3])}\n" for c, m in CAMERA_TO_IMU.items())
    (root / "calibration/calib_cam_to_pose.txt").write_text(extrinsics)
    poses = root / "data_poses" / drive
    poses.mkdir(parents=True)
    first, imu = "", ""
    for f in frames:
        if f not in unposed:
            first += f"{f} {line(true_pose('00', f))} \n"
            # The inverse of the reader's product.
            car = true_pose("01", f) @ RECTIFICATION["01"] @ np.linalg.inv(CAMERA_TO_IMU["01"])
            imu += f"{f} {line(car[:3])}\n"
    (poses / "cam0_to_world.txt").write_text(first)
    (poses / "poses.txt").write_text(imu)
    return pictures


@pytest.mark.parametrize("package", [False, True])
def test_points_project_to_their_true_pixels(tmp_path, package):
    make(tmp_path, package=package)
    scene = read_scene(tmp_path)
    assert scene.source == "kitti360" and len(scene.views) == 2 * len(FRAMES)
    assert [v.name for v in scene.views][::6] == [f"image_0{c}/0000001538.png" for c in "01"]
    for view in scene.views:
        camera, frame = view.name[6:8], int(view.path.stem)
        ahead = true_pose(camera, frame) @ np.array([0.7, -0.3, 9.0, 1.0])
        # Pixel (0, 0) of the data set is the centre of the first pixel; ours is its corner.
        expected = pinhole(K[camera], true_pose(camera, frame), ahead[:3]) + 0.5
        np.testing.assert_allclose(pixel_of(scene, view, ahead[:3]), expected, atol=1e-4)
        np.testing.assert_allclose(view.c2w, true_pose(camera, frame), atol=1e-8)


def test_principal_point_is_the_centre_of_its_pixel(tmp_path):
    pictures = make(tmp_path)
    path = pictures / "image_00/data_rect/0000001540.png"
    dot = np.zeros((*SIZE[::-1], 3), np.uint8)
    dot[9, 20] = 255  # row cy, column cx: on the optical axis
    Image.fromarray(dot).save(path)
    scene = read_scene(tmp_path)
    view = next(v for v in scene.views if v.path == path)
    x, y = pixel_of(scene, view, view.c2w[:3, 3] + 5 * view.c2w[:3, 2]).astype(int)
    assert load_image(view, scene)[y, x].tolist() == [255, 255, 255]


def test_world_frame_is_the_metric_input_frame(tmp_path):
    make(tmp_path)
    scene = read_scene(tmp_path)
    np.testing.assert_array_equal(scene.world_from_input, np.eye(4))
    assert (scene.scale_source, scene.scale_error) == ("metric-input", 0.0)
    left, right = (scene.c2w_world(v)[:3, 3] for v in (scene.views[0], scene.views[6]))
    assert np.linalg.norm(right - left) == pytest.approx(BASELINE)
    taller = read_scene(tmp_path, camera_height=3.1)
    assert taller.scale_source == "camera-height"


def test_frames_without_a_pose_are_left_out(tmp_path):
    make(tmp_path, unposed=(1539, 1541))
    scene = read_scene(tmp_path)
    assert [int(v.path.stem) for v in scene.views] == [1538, 1540, 1542, 1543] * 2
    notes = map(str, scene.findings)
    assert any(note.startswith("4 images of") and "no pose" in note for note in notes)


@pytest.mark.parametrize("frames", ["1539:1541", (1539, 1541), " 1539 : 1541 "])
def test_frames_are_selected(tmp_path, frames):
    make(tmp_path)
    scene = read_scene(tmp_path, frames=frames)
    assert [int(v.path.stem) for v in scene.views] == [1539, 1540, 1541] * 2


def test_camera_0_does_not_need_the_imu_poses(tmp_path):
    make(tmp_path, cameras=("00",))
    (tmp_path / "data_poses" / DRIVE / "poses.txt").unlink()
    assert {v.name[:8] for v in read_scene(tmp_path).views} == {"image_00"}


def test_several_drives_need_the_folder_of_one(tmp_path):
    make(tmp_path)
    pictures = make(tmp_path, range(5, 9), OTHER)
    with pytest.raises(UserError, match=f"several drives .*{DRIVE}, {OTHER}.*give the folder of"):
        read_scene(tmp_path)
    assert {int(v.path.stem) for v in read_scene(pictures).views} == {5, 6, 7, 8}
    shutil.rmtree(tmp_path / "data_2d_raw" / DRIVE)
    assert {int(v.path.stem) for v in read_scene(tmp_path).views} == {5, 6, 7, 8}


def test_too_many_images_require_a_selection_of_frames(tmp_path):
    frames = range(10, 11 + MAX_IMAGES)
    make(tmp_path, frames, cameras=("00",))
    with pytest.raises(UserError, match=r"has 401 images .* --frames 1538:1601"):
        read_kitti360(tmp_path)
    assert len(read_kitti360(tmp_path, (10, 409)).views) == 400
    assert len(read_kitti360(tmp_path, (10, 410)).views) == 401, "a selection has no limit"


def test_official_labels_are_cityscapes_ids(tmp_path):
    make(tmp_path)
    folder = tmp_path / "data_2d_semantics/train" / DRIVE / "image_00/semantic"
    folder.mkdir(parents=True)
    ids = np.full(SIZE[::-1], 7, np.uint8)
    ids[:9], ids[9:12], ids[0, 0] = 23, 37, 39
    Image.fromarray(ids).save(folder / "0000001540.png")
    scene = read_scene(tmp_path)
    assert scene.label_space == "cityscapes-ids"
    labelled = [v for v in scene.views if v.label_path]
    assert [v.name for v in labelled] == ["image_00/0000001540.png"]
    found = load_labels(labelled[0], scene)
    assert found is not None
    assert [int(found[i, 0]) for i in (0, 1, 9, 19)] == [255, 10, 5, 0]


def test_package_labels_and_visible_frames_are_read(tmp_path):
    make(tmp_path, package=True)
    folder = tmp_path / "pspnet" / DRIVE / "seq0_1538-1601"
    folder.mkdir(parents=True)
    for frame in FRAMES:
        Image.fromarray(np.full(SIZE[::-1], 21, np.uint8)).save(folder / f"0000_{frame:010}.png")
    listed = tmp_path / "visible_id" / DRIVE
    listed.mkdir(parents=True)
    for frame in (1538, 1540, 1543):
        (listed / f"{frame:010}.txt").write_text("1\n")
    scene = read_scene(tmp_path / DRIVE)
    assert [int(v.path.stem) for v in scene.views] == [1538, 1540, 1543] * 2
    labels = [load_labels(v, scene) for v in scene.views]
    assert [None if one is None else int(one[5, 5]) for one in labels] == [
        8,
        8,
        8,
        None,
        None,
        None,
    ]


def test_labels_of_the_user_are_train_ids(tmp_path):
    make(tmp_path)
    (tmp_path / "labels/image_01").mkdir(parents=True)
    Image.fromarray(np.full(SIZE[::-1], 13, np.uint8)).save(
        tmp_path / "labels/image_01/0000001540.png"
    )
    scene = read_scene(tmp_path)
    found = [load_labels(v, scene) for v in scene.views if v.label_path]
    assert len(found) == 1 and found[0] is not None and (found[0] == 13).all()


def replaced(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda r: (r / "calibration/perspective.txt").unlink(), r"perspective\.txt is missing"),
        (lambda r: (r / "calibration/calib_cam_to_pose.txt").unlink(), "pose.txt is missing"),
        (
            lambda r: replaced(r / "calibration/perspective.txt", "P_rect_00", "P_00"),
            "has no P_rect_00; download",
        ),
        (
            lambda r: replaced(r / "calibration/perspective.txt", "R_rect_01: ", "R_rect_01: 7 "),
            "R_rect_01 in .* is not 9 finite numbers",
        ),
        (
            lambda r: replaced(r / "calibration/perspective.txt", "R_rect_01: ", "R_rect_01: 4"),
            "is no rotation",
        ),
        (
            lambda r: replaced(r / "calibration/perspective.txt", "P_rect_01: 41", "P_rect_01: x"),
            "contains more than numbers",
        ),
        (
            lambda r: replaced(r / f"data_poses/{DRIVE}/poses.txt", "1539 ", "1539 8 "),
            "line of 14 numbers instead of a frame and 12",
        ),
        (
            lambda r: replaced(r / f"data_poses/{DRIVE}/cam0_to_world.txt", "1539 ", "1539 nan "),
            "line of 18 numbers",
        ),
        (
            lambda r: (r / f"data_poses/{DRIVE}/cam0_to_world.txt").write_text(
                "\n".join(f"{f} {line(np.full((4, 4), np.nan))}" for f in FRAMES)
            ),
            "not finite",
        ),
        (
            lambda r: (r / f"data_poses/{DRIVE}/cam0_to_world.txt").write_text(
                "\n".join(f"{f} {line(np.diag([1, 1, -1, 1]))}" for f in FRAMES)
            ),
            "contains no rotation matrix",
        ),
        (
            lambda r: write_images(
                r / f"data_2d_raw/{DRIVE}/image_00/data_rect", ["0000001540.png"], (30, 30)
            ),
            "another shape",
        ),
        (lambda r: shutil.rmtree(r / "data_2d_raw"), "no images of them"),
    ],
)
def test_damage_raises_one_sentence(tmp_path, damage, message):
    make(tmp_path)
    damage(tmp_path)
    with pytest.raises(UserError, match=message) as caught:
        read_scene(tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ("1538", "give two frames, such as 1538:1601"),
        ("a:b", "give two frames"),
        ("1540:1538", "ends before it begins"),
        ((5, 6), "no image with a pose in frames 5:6"),
    ],
)
def test_invalid_frames_raise(tmp_path, frames, message):
    make(tmp_path)
    with pytest.raises(UserError, match=message):
        read_scene(tmp_path, frames=frames)


def test_saved_scene_rejects_a_selection_of_frames(tmp_path):
    make(tmp_path)
    save_scene(read_scene(tmp_path, frames="1538:1541"), tmp_path / "run")
    assert len(read_scene(tmp_path / "run").views) == 8
    with pytest.raises(UserError, match="selects frames of a KITTI-360 drive"):
        read_scene(tmp_path / "run", frames="1538:1540")


def test_single_frame_is_a_valid_range():
    assert parse_frames("7:7") == (7, 7)
