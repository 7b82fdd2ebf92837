import json
import math
import re

import numpy as np
import pytest
from PIL import Image
from support.scene_builders import names_of, ring, write_images, write_transforms

from climatenerf.core.errors import UserError
from climatenerf.scene import load_scene, read_scene, save_scene
from climatenerf.scene.images import load_depth, read_depth
from climatenerf.scene.readers.ply import write_points
from climatenerf.scene.readers.transforms_json import read_transforms

NERFSTUDIO = {"fl_x": 30.0, "fl_y": 31.0, "cx": 15.0, "cy": 12.5, "w": 32, "h": 24}


def images_of(count):
    return [f"images/{n}" for n in names_of(count)]


def test_nerfstudio_intrinsics_and_poses(tmp_path):
    poses = ring(5)
    write_images(tmp_path, images_of(5))
    lens = {"k1": 0.1, "k2": 0.2, "k3": 0.01, "p1": 0.3, "p2": 0.4, "camera_model": "OPENCV"}
    write_transforms(tmp_path / "transforms.json", poses, images_of(5), **NERFSTUDIO, **lens)
    capture = read_transforms(tmp_path)
    for pose, view, name in zip(poses, capture.views, names_of(5), strict=True):
        np.testing.assert_allclose(view.c2w, pose, atol=1e-9)
        assert view.name == name
    camera = capture.cameras[0]
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (30.0, 31.0, 15.0, 12.5)
    assert (camera.k1, camera.k2, camera.k3, camera.p1, camera.p2) == (0.1, 0.2, 0.01, 0.3, 0.4)
    assert not capture.predefined_split


def test_opengl_axes_are_converted_to_opencv(tmp_path):
    write_images(tmp_path, images_of(3))
    write_transforms(tmp_path / "transforms.json", ring(3), images_of(3), **NERFSTUDIO)
    data = json.loads((tmp_path / "transforms.json").read_text())
    data["frames"][0]["transform_matrix"] = np.eye(4).tolist()
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    view = read_transforms(tmp_path).views[0]
    np.testing.assert_allclose(view.c2w[:3, 2], [0, 0, -1], atol=1e-12)  # forward
    np.testing.assert_allclose(view.c2w[:3, 1], [0, -1, 0], atol=1e-12)  # down


def test_blender_angle_of_view_and_missing_extension(tmp_path):
    names = [f"./train/r_{i}" for i in range(3)]
    write_images(tmp_path, [f"{n}.png" for n in names])
    write_transforms(tmp_path / "transforms.json", ring(3), names, camera_angle_x=0.7)
    capture = read_transforms(tmp_path)
    assert capture.views[1].name == "train/r_1.png" and capture.views[1].path.is_file()
    camera = capture.cameras[0]
    assert camera.fx == camera.fy == pytest.approx(16 / math.tan(0.35))
    assert (camera.width, camera.height, camera.cx, camera.cy) == (32, 24, 16.0, 12.0)


def test_instant_ngp_angles_of_view(tmp_path):
    write_images(tmp_path, images_of(3))
    top = {"camera_angle_x": 0.7, "camera_angle_y": 0.6, "aabb_scale": 4, "w": 32, "h": 24}
    write_transforms(tmp_path / "transforms.json", ring(3), images_of(3), **top)
    camera = read_transforms(tmp_path).cameras[0]
    assert camera.fy == pytest.approx(12 / math.tan(0.3))


def test_blender_split_files(tmp_path):
    for i, split in enumerate(("train", "val", "test")):
        names = [f"{split}/r_{j}" for j in range(3 + i)]
        write_images(tmp_path, [f"{n}.png" for n in names])
        write_transforms(
            tmp_path / f"transforms_{split}.json", ring(3 + i), names, camera_angle_x=0.7
        )
    scene = read_scene(tmp_path)
    assert {v.name.split("/")[0] for v in scene.of_split("train")} == {"train"}
    assert len(scene.of_split("heldout")) == 5
    assert {v.name.split("/")[0] for v in scene.of_split("heldout")} == {"test"}
    assert len(read_scene(tmp_path / "transforms_train.json").views) == 8


@pytest.mark.parametrize("lens", [{"camera_model": "OPENCV_FISHEYE"}, {"is_fisheye": True}])
def test_fisheye(tmp_path, lens):
    write_images(tmp_path, images_of(3))
    top = {**NERFSTUDIO, **lens, "k1": 0.1, "k4": 0.01}
    write_transforms(tmp_path / "transforms.json", ring(3), images_of(3), **top)
    camera = read_transforms(tmp_path).cameras[0]
    assert camera.fisheye and camera.k4 == 0.01


def test_per_frame_intrinsics_and_masks(tmp_path):
    write_images(tmp_path, images_of(4))
    write_images(tmp_path, ["m/1.png"])
    write_transforms(tmp_path / "transforms.json", ring(4), images_of(4), **NERFSTUDIO)
    data = json.loads((tmp_path / "transforms.json").read_text())
    data["frames"][1] |= {"fl_x": 40.0, "mask_path": "m/1.png"}
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    scene = read_scene(tmp_path)
    assert len(scene.cameras) == 2
    assert scene.cameras[scene.views[1].camera].fx == 40.0
    assert scene.views[1].mask_path == tmp_path / "m/1.png"


def test_predefined_split_is_kept_unless_holdout_is_given(tmp_path):
    names = images_of(6)
    write_images(tmp_path, names)
    split = {"train_filenames": names[:3], "val_filenames": names[3:4], "test_filenames": names[4:]}
    write_transforms(tmp_path / "transforms.json", ring(6), names, **NERFSTUDIO, **split)
    scene = read_scene(tmp_path)
    assert [v.split for v in scene.views] == ["train"] * 3 + ["heldout"] * 3
    assert len(read_scene(tmp_path, holdout="0").of_split("heldout")) == 0


def test_unlisted_images_are_left_out_with_a_warning(tmp_path):
    names = images_of(6)
    write_images(tmp_path, names)
    split = {"train_filenames": names[:3], "test_filenames": names[4:]}
    write_transforms(tmp_path / "transforms.json", ring(6), names, **NERFSTUDIO, **split)
    scene = read_scene(tmp_path)
    assert [v.name for v in scene.views] == [n for n in names_of(6) if n != "003.png"]
    assert any(w.startswith("1 images are in none") for w in scene.warnings)


def test_applied_transform_is_not_undone(tmp_path):
    poses = ring(3)
    write_images(tmp_path, images_of(3))
    write_points(tmp_path / "p.ply", np.array([[1.0, 2.0, 3.0]]))
    top = {"applied_transform": [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]}
    top |= {"ply_file_path": "p.ply"}
    write_transforms(tmp_path / "transforms.json", poses, images_of(3), **NERFSTUDIO, **top)
    capture = read_transforms(tmp_path)
    np.testing.assert_allclose(capture.views[0].c2w, poses[0], atol=1e-9)
    np.testing.assert_allclose(capture.points, [[1, 2, 3]])


def test_file_of_any_name_is_read(tmp_path):
    write_images(tmp_path, images_of(3))
    write_transforms(tmp_path / "mine.json", ring(3), images_of(3), **NERFSTUDIO)
    assert len(read_scene(tmp_path / "mine.json").views) == 3


def error_after(tmp_path, change):
    """Message of the error that a change of the file causes."""
    write_images(tmp_path, images_of(4))
    write_transforms(tmp_path / "transforms.json", ring(4), images_of(4), **NERFSTUDIO)
    data = json.loads((tmp_path / "transforms.json").read_text())
    change(data)
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    with pytest.raises(UserError) as caught:
        read_scene(tmp_path)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_non_finite_pose_raises(tmp_path):
    def change(data):
        data["frames"][2]["transform_matrix"][0][3] = float("nan")

    assert "002.png" in error_after(tmp_path, change)


@pytest.mark.parametrize(
    "matrix",
    [
        np.zeros((4, 4)),
        np.diag([1.0, 1, -1, 1]),
        np.diag([1.0, 2, 1, 1]),
        np.eye(4) + np.eye(4, k=1) * 0.3,
    ],
    ids=["zero", "mirrored", "stretched", "sheared"],
)
def test_pose_without_rotation_raises(tmp_path, matrix):
    def change(data):
        data["frames"][1]["transform_matrix"] = matrix.tolist()

    assert "001.png" in (message := error_after(tmp_path, change)) and "no rotation" in message


@pytest.mark.parametrize("matrix", [None, [[1, 2], [3, 4]], "x", [[1, 0, 0], [0, 1]]])
def test_malformed_matrix_raises(tmp_path, matrix):
    def change(data):
        data["frames"][1]["transform_matrix"] = matrix

    assert "not a 4x4 matrix" in error_after(tmp_path, change)


def test_scaled_and_rounded_rotations_are_orthonormalised(tmp_path):
    poses = ring(3)
    write_images(tmp_path, images_of(3))
    write_transforms(tmp_path / "transforms.json", poses, images_of(3), **NERFSTUDIO)
    data = json.loads((tmp_path / "transforms.json").read_text())
    for frame in data["frames"]:
        matrix = np.array(frame["transform_matrix"])
        matrix[:3, :3] = (matrix[:3, :3] * 3).round(2)
        frame["transform_matrix"] = matrix.tolist()
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    for pose, view in zip(poses, read_transforms(tmp_path).views, strict=True):
        np.testing.assert_allclose(view.c2w[:3, :3] @ view.c2w[:3, :3].T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(view.c2w, pose, atol=0.01)


@pytest.mark.parametrize(
    ("top", "message"),
    [
        ({"fl_x": 0}, "focal length 0"),
        ({"fl_x": "wide"}, "fl_x .* is not a number"),
        ({"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR .*undistort"),
        ({"k4": 0.1}, "k4 without a fisheye"),
        ({"fl_x": None, "fl_y": None, "camera_angle_x": 0}, "angle 0 .*focal length would be 0"),
        ({"fl_x": None, "fl_y": None}, "neither fl_x nor camera_angle_x"),
        ({"w": 0}, "size 0x24"),
        ({"frames": []}, "no list of frames"),
        ({"frames": [{"transform_matrix": []}]}, "Frame 0 .*no file_path"),
    ],
)
def test_invalid_values_raise(tmp_path, top, message):
    assert re.search(message, error_after(tmp_path, lambda data: data.update(top)))


def test_invalid_json_raises(tmp_path):
    (tmp_path / "transforms.json").write_text('{"frames": [')
    with pytest.raises(UserError, match=r"transforms\.json is not valid JSON"):
        read_scene(tmp_path)


def write_depths(folder, scale, suffix=".png"):
    """Depth files of 7.5 m."""
    (folder / "depths").mkdir()
    for name in names_of(4):
        values = np.full((24, 32), 7.5 / scale)
        Image.fromarray(values.astype(np.uint16)).save(folder / "depths" / name)


@pytest.mark.parametrize("key", ["depth_path", "depth_file_path"])
@pytest.mark.parametrize(
    ("scale", "top"),
    [
        (0.001, {}),
        (0.001, {"integer_depth_scale": 0.001}),
        (0.0005, {"integer_depth_scale": 0.0005}),
        (0.01, {"depth_unit_scale_factor": 0.01}),
    ],
)
def test_named_depth_files_are_read_in_their_unit(tmp_path, key, scale, top):
    write_images(tmp_path, names_of(4))
    write_depths(tmp_path, scale)
    write_transforms(tmp_path / "transforms.json", ring(4), names_of(4), fl_x=30.0, **top)
    data = json.loads((tmp_path / "transforms.json").read_text())
    for frame in data["frames"]:
        frame[key] = f"depths/{frame['file_path']}"
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    save_scene(read_scene(tmp_path), tmp_path / "run")
    scene = load_scene(tmp_path / "run")
    assert all(view.depth_path is not None for view in scene.views)
    np.testing.assert_allclose(load_depth(scene.views[0], scene), 7.5, rtol=1e-3)


@pytest.mark.parametrize("scale", ["wide", 0, -1, 1e9, True])
def test_a_wrong_depth_scale_raises(tmp_path, scale):
    write_images(tmp_path, names_of(4))
    top = {"fl_x": 30.0, "integer_depth_scale": scale}
    write_transforms(tmp_path / "transforms.json", ring(4), names_of(4), **top)
    with pytest.raises(UserError, match="integer_depth_scale"):
        read_scene(tmp_path)


def test_floats_in_four_channels_are_depths(tmp_path):
    """As NeRFCapture writes them."""
    depth = np.random.default_rng(0).uniform(0, 5, (6, 8)).astype("<f4")
    Image.fromarray(depth.view(np.uint8).reshape(6, 8, 4), "RGBA").save(tmp_path / "d.png")
    np.testing.assert_array_equal(read_depth(tmp_path / "d.png"), depth)
    Image.new("RGBA", (8, 6), (200, 10, 20, 255)).save(tmp_path / "colour.png")
    with pytest.raises(UserError, match="no depths in metres"):
        read_depth(tmp_path / "colour.png")


@pytest.mark.parametrize(
    "named", ["../photos/{}", "/elsewhere/project/photos/{}", "{root}/photos/{}"]
)
def test_photos_outside_the_folder_have_names_below_one(tmp_path, named):
    inside = named.startswith("/elsewhere")
    photos = tmp_path / ("nerf/photos" if inside else "photos")
    write_images(photos, names_of(4))
    names = [named.format(name, root=tmp_path) for name in names_of(4)]
    write_transforms(tmp_path / "nerf/transforms.json", ring(4), names, fl_x=30.0)
    scene = read_scene(tmp_path / "nerf")
    assert [view.path.resolve() for view in scene.views] == [photos / name for name in names_of(4)]
    assert [view.name for view in scene.views] == names_of(4)


def test_lists_of_a_split_match_other_spellings_unless_a_frame_has_the_name(tmp_path):
    names = ["images/A.png", "images/a.png", "images/b.png", "images/c.png"]
    write_images(tmp_path, names)
    split = {"train_filenames": [*names[:1], "images/B.PNG"], "test_filenames": names[1:2]}
    split["train_filenames"].append("images/c.png")
    write_transforms(tmp_path / "transforms.json", ring(4), names, **NERFSTUDIO, **split)
    found = {view.name: view.split for view in read_transforms(tmp_path).views}
    assert found == {"A.png": "train", "a.png": "heldout", "b.png": "train", "c.png": "train"}


@pytest.mark.parametrize(
    ("table", "key", "value"), [("frame", "mask_path", 5), ("file", "ply_file_path", ["a.ply"])]
)
def test_paths_that_are_no_text_are_told(tmp_path, table, key, value):
    write_images(tmp_path, images_of(3))
    write_transforms(tmp_path / "transforms.json", ring(3), images_of(3), **NERFSTUDIO)
    data = json.loads((tmp_path / "transforms.json").read_text())
    (data["frames"][0] if table == "frame" else data)[key] = value
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    (finding,) = read_transforms(tmp_path).findings
    assert finding.code == "file-unread" and f"{key} that is no text" in finding.message


def test_a_truth_value_is_no_number(tmp_path):
    write_images(tmp_path, images_of(3))
    intrinsics = {**NERFSTUDIO, "fl_x": True}
    write_transforms(tmp_path / "transforms.json", ring(3), images_of(3), **intrinsics)
    with pytest.raises(UserError, match="fl_x in .* is not a number"):
        read_transforms(tmp_path)


@pytest.mark.parametrize(
    ("of_file", "of_frames", "told"),
    [
        ({"depth_unit_scale_factor": 0.001, "integer_depth_scale": 0.001}, {}, None),
        ({"depth_unit_scale_factor": 0.001, "integer_depth_scale": 0.01}, {}, "contradicts"),
        ({}, {"depth_unit_scale_factor": 0.01}, "of single frames (3 times)"),
        ({"depth_unit_scale_factor": 0.01}, {"depth_unit_scale_factor": 0.01}, None),
    ],
)
def test_units_of_depth_that_are_not_used_are_told(tmp_path, of_file, of_frames, told):
    write_images(tmp_path, images_of(3))
    write_transforms(tmp_path / "transforms.json", ring(3), images_of(3), **NERFSTUDIO, **of_file)
    data = json.loads((tmp_path / "transforms.json").read_text())
    data["frames"] = [{**frame, **of_frames} for frame in data["frames"]]
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    found = read_transforms(tmp_path).findings
    assert [told in each.message for each in found] == ([] if told is None else [True])
