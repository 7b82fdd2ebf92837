import shutil
import struct

import numpy as np
import pytest
from support.scene_builders import PINHOLE, names_of, ring, write_colmap, write_images

from climatenerf.core.errors import UserError
from climatenerf.scene import read_scene
from climatenerf.scene.readers.colmap import camera_from_params, read_colmap

POINTS = [(0.5, 1.5, -2.5), (1.0, 2.0, 3.0)]


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("sub", ["sparse/0", "sparse", "sparse/3", "colmap/sparse/0"])
def test_poses_intrinsics_and_points(tmp_path, binary, sub):
    poses = ring(5)
    write_colmap(tmp_path / sub, poses, names_of(5), points=POINTS, binary=binary)
    write_images(tmp_path / "images", names_of(5))
    capture = read_colmap(tmp_path)
    for pose, view in zip(poses, capture.views, strict=True):
        np.testing.assert_allclose(view.c2w, pose, atol=1e-9)
        assert view.path.is_file()
    camera = capture.cameras[capture.views[0].camera]
    assert (camera.width, camera.height, camera.fx, camera.fy) == (32, 24, 30.0, 31.0)
    assert capture.points is not None
    np.testing.assert_allclose(capture.points, POINTS)


@pytest.mark.parametrize("binary", [True, False])
def test_views_have_the_rows_of_their_observed_points(tmp_path, binary):
    """One feature has point id 3 and one has none; ids differ from rows."""
    points = [(float(i), 0.0, 0.0) for i in range(6)]
    model = tmp_path / "sparse/0"
    write_colmap(model, ring(4), names_of(4), points=points, binary=binary)
    write_images(tmp_path / "images", names_of(4))
    views = read_colmap(tmp_path).views
    assert [list(v.seen) for v in views] == ([[3]] * 4 if binary else [[3], [], [3], []])
    write_colmap(model, ring(4), names_of(4), points=points[:3], binary=binary)
    assert not any(len(v.seen) for v in read_colmap(tmp_path).views), "point 3 does not exist"
    if not binary:
        lines = (model / "points3D.txt").read_text().splitlines()
        (model / "points3D.txt").write_text("\n".join([f"3 7 8 9 {lines[1][2:]}", *lines[2:]]))
        capture = read_colmap(tmp_path)
        assert [list(capture.points[v.seen]) for v in capture.views[:1]][0][0].tolist() == [7, 8, 9]


def test_pose_is_inverted_and_quaternion_is_w_first(tmp_path):
    # 90 degrees about z: q = (cos 45, 0, 0, sin 45); R x = y. Centre = -R^T t.
    write_images(tmp_path / "images", names_of(3))
    model = tmp_path / "sparse" / "0"
    write_colmap(model, ring(3), names_of(3), binary=False)
    half = repr(float(np.sqrt(0.5)))
    lines = [f"{i} {half} 0 0 {half} 1 2 3 1 {n}\n" for i, n in enumerate(names_of(3))]
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    pose = read_colmap(tmp_path).views[0].c2w
    np.testing.assert_allclose(pose[:3, :3], [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(pose[:3, 3], [-2, 1, -3], atol=1e-12)


def test_binary_model_is_preferred_over_text(tmp_path):
    write_images(tmp_path / "images", names_of(4))
    write_colmap(tmp_path / "sparse/0", ring(4), names_of(4), binary=True)
    write_colmap(tmp_path / "sparse/0", ring(3), names_of(3), binary=False)
    assert len(read_colmap(tmp_path).views) == 4


def test_largest_submodel_is_read(tmp_path):
    write_images(tmp_path / "images", names_of(10))
    write_colmap(tmp_path / "sparse/0", ring(3), names_of(3))
    write_colmap(tmp_path / "sparse/1", ring(7), names_of(10)[3:])
    write_colmap(tmp_path / "sparse/10", ring(4), names_of(4))
    capture = read_colmap(tmp_path)
    assert len(capture.views) == 7
    assert "0: 3, 1: 7, 10: 4" in str(capture.findings[0])


def test_images_are_found_from_the_model_folder(tmp_path):
    write_images(tmp_path / "images", names_of(3))
    write_colmap(tmp_path / "sparse/0", ring(3), names_of(3))
    scene = read_scene(tmp_path / "sparse/0")
    assert scene.root == tmp_path and len(scene.views) == 3


def test_intrinsics_are_scaled_to_the_images(tmp_path):
    write_images(tmp_path / "images_2", names_of(3), size=(16, 12))
    write_colmap(tmp_path / "sparse/0", ring(3), names_of(3))
    scene = read_scene(tmp_path)
    camera = scene.cameras[0]
    assert (camera.width, camera.fx, camera.cy) == (16, 15.0, 6.0)
    assert any("intrinsics are scaled" in str(each) for each in scene.findings)


@pytest.mark.parametrize(
    ("model", "params", "expected"),
    [
        ("SIMPLE_PINHOLE", [9, 4, 3], {"fx": 9, "fy": 9, "cx": 4, "cy": 3}),
        ("SIMPLE_RADIAL", [9, 4, 3, 0.1], {"fy": 9, "k1": 0.1, "fisheye": False}),
        ("RADIAL", [9, 4, 3, 0.1, 0.2], {"k1": 0.1, "k2": 0.2}),
        ("OPENCV", [9, 8, 4, 3, 0.1, 0.2, 0.3, 0.4], {"fy": 8, "k2": 0.2, "p1": 0.3, "p2": 0.4}),
        ("OPENCV_FISHEYE", [9, 8, 4, 3, 0.1, 0.2, 0.3, 0.4], {"k4": 0.4, "fisheye": True, "p1": 0}),
        ("FULL_OPENCV", [9, 8, 4, 3, 0.1, 0.2, 0.3, 0.4, 0.5, 0, 0, 0], {"k3": 0.5, "p2": 0.4}),
    ],
)
def test_camera_models(model, params, expected):
    camera = camera_from_params(model, 8, 6, params, "here")
    assert {k: getattr(camera, k) for k in expected} == expected


@pytest.mark.parametrize("model", ["FOV", "THIN_PRISM_FISHEYE", "EUCM", "FULL_OPENCV"])
def test_error_names_the_unsupported_model(model):
    params = [1.0] * {"FOV": 5, "EUCM": 6}.get(model, 12)
    with pytest.raises(UserError, match=f"{model}.*undistort"):
        camera_from_params(model, 8, 6, params, "here")


def test_error_names_the_unknown_model_id(tmp_path):
    write_images(tmp_path / "images", names_of(3))
    eucm = (1, "EUCM", 32, 24, (30.0, 30.0, 16.0, 12.0, 0.5, 1.0))
    write_colmap(tmp_path / "sparse/0", ring(3), names_of(3), cameras=(eucm,))
    with pytest.raises(UserError, match=r"id 16 .*undistort"):
        read_scene(tmp_path)


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin"])
@pytest.mark.parametrize("keep", [0, 3, 0.5, 0.95])
def test_error_names_the_truncated_file(tmp_path, file, keep):
    write_images(tmp_path / "images", names_of(4))
    write_colmap(tmp_path / "sparse/0", ring(4), names_of(4), points=POINTS)
    path = tmp_path / "sparse/0" / file
    data = path.read_bytes()
    path.write_bytes(data[: keep if isinstance(keep, int) else int(keep * len(data))])
    with pytest.raises(UserError, match=file):
        read_scene(tmp_path)


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin"])
def test_error_names_the_corrupt_file(tmp_path, file):
    write_images(tmp_path / "images", names_of(4))
    write_colmap(tmp_path / "sparse/0", ring(4), names_of(4), points=POINTS)
    path = tmp_path / "sparse/0" / file
    path.write_bytes(np.random.default_rng(3).bytes(len(path.read_bytes())))
    with pytest.raises(UserError, match=file):
        read_scene(tmp_path)


def test_truncation_at_any_offset_raises(tmp_path):
    write_images(tmp_path / "images", names_of(3))
    write_colmap(tmp_path / "complete", ring(3), names_of(3), points=POINTS)
    for file in ("cameras.bin", "images.bin"):
        data = (tmp_path / "complete" / file).read_bytes()
        for length in range(0, len(data), 11):
            shutil.copytree(tmp_path / "complete", tmp_path / "sparse", dirs_exist_ok=True)
            (tmp_path / "sparse" / file).write_bytes(data[:length])
            with pytest.raises(UserError):
                read_colmap(tmp_path)


def test_corrupt_text_file_raises(tmp_path):
    write_images(tmp_path / "images", names_of(3))
    write_colmap(tmp_path / "sparse", ring(3), names_of(3), binary=False)
    (tmp_path / "sparse/images.txt").write_text("1 0.5 what 0 0\n\n")
    with pytest.raises(UserError, match=r"images\.txt"):
        read_scene(tmp_path)


def test_empty_model_raises(tmp_path):
    write_images(tmp_path / "images", names_of(3))
    write_colmap(tmp_path / "sparse/0", [], [])
    with pytest.raises(UserError, match="no image with a pose"):
        read_scene(tmp_path)


@pytest.mark.parametrize("focal", [0.0, float("nan")])
def test_invalid_focal_length_raises(tmp_path, focal):
    write_images(tmp_path / "images", names_of(3))
    camera = (1, "PINHOLE", 32, 24, (focal, 30.0, 16.0, 12.0))
    write_colmap(tmp_path / "sparse/0", ring(3), names_of(3), cameras=(camera,))
    with pytest.raises(UserError, match="focal length|not finite"):
        read_scene(tmp_path)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_non_finite_pose_raises(tmp_path, bad):
    write_images(tmp_path / "images", names_of(3))
    write_colmap(tmp_path / "sparse/0", ring(3), names_of(3))
    path = tmp_path / "sparse/0/images.bin"
    data = bytearray(path.read_bytes())
    struct.pack_into("<d", data, 8 + 4 + 5 * 8, bad)
    path.write_bytes(bytes(data))
    with pytest.raises(UserError, match=r"000\.png .* not finite"):
        read_scene(tmp_path)


def test_zero_quaternion_raises(tmp_path):
    write_images(tmp_path / "images", names_of(3))
    write_colmap(tmp_path / "sparse/0", ring(3), names_of(3))
    path = tmp_path / "sparse/0/images.bin"
    data = bytearray(path.read_bytes())
    struct.pack_into("<4d", data, 8 + 4, 0, 0, 0, 0)
    path.write_bytes(bytes(data))
    with pytest.raises(UserError, match="zero quaternion"):
        read_scene(tmp_path)


def test_image_with_unlisted_camera_raises(tmp_path):
    write_images(tmp_path / "images", names_of(3))
    write_colmap(tmp_path / "sparse", ring(3), names_of(3), binary=False)
    text = (tmp_path / "sparse/cameras.txt").read_text().replace("1 PINHOLE", "7 PINHOLE")
    (tmp_path / "sparse/cameras.txt").write_text(text)
    with pytest.raises(UserError, match="camera 1, which"):
        read_scene(tmp_path)


def test_views_refer_to_their_cameras(tmp_path):
    write_images(tmp_path / "images", names_of(3))
    other = (5, "SIMPLE_PINHOLE", 32, 24, (44.0, 16.0, 12.0))
    write_colmap(tmp_path / "sparse", ring(3), names_of(3), (PINHOLE, other), binary=False)
    text = (tmp_path / "sparse/images.txt").read_text().replace("1 001.png", "5 001.png")
    (tmp_path / "sparse/images.txt").write_text(text)
    scene = read_scene(tmp_path)
    assert [scene.cameras[v.camera].fx for v in scene.views] == [30.0, 44.0, 30.0]


# --- text models as people edit and export them -------------------------------------------------


def edited_model(tmp_path, change, points=()):
    """A text model of four images, with `images.txt` changed by a function of its lines."""
    write_images(tmp_path / "images", names_of(4))
    model = tmp_path / "sparse/0"
    write_colmap(model, ring(4), names_of(4), points=points, binary=False)
    path = model / "images.txt"
    path.write_bytes(change(path.read_text().split("\n")))
    return tmp_path


def joined(lines, end="\n"):
    return end.join(lines).encode()


EDITS = {
    "as written": joined,
    "carriage returns": lambda lines: joined(lines, "\r\n"),
    "byte order mark": lambda lines: b"\xef\xbb\xbf" + joined(lines),
    "no comments": lambda lines: joined(lines[2:]),
    "empty line after the comments": lambda lines: joined([*lines[:2], "", "", *lines[2:]]),
    "empty line after each image": lambda lines: joined(
        [line for i in range(2, 10, 2) for line in (*lines[i : i + 2], "", "")]
    ),
    "no last line": lambda lines: joined(lines[:9]),
    "no features": lambda lines: joined(lines[2:10:2]),
    "no features, empty lines": lambda lines: joined(
        [word for line in lines[2:10:2] for word in (line, "", "")]
    ),
    "features of the first image alone": lambda lines: joined([*lines[2:4], *lines[4:10:2]]),
}  # fmt: skip


@pytest.mark.parametrize("edit", EDITS)
def test_every_image_of_an_edited_text_model_is_read(tmp_path, edit):
    root = edited_model(tmp_path, EDITS[edit], points=[(0.0, 0.0, 1.0)] * 9)
    capture = read_colmap(root)
    assert [view.name for view in capture.views] == names_of(4)
    for view, pose in zip(capture.views, ring(4), strict=True):
        np.testing.assert_allclose(view.c2w, pose, atol=1e-9)
    reported = any(each.code == "model-lines" for each in capture.findings)
    assert reported == ("no features" in edit or "alone" in edit)


def test_a_line_that_is_neither_image_nor_features_is_named(tmp_path):
    edit = lambda lines: joined([*lines[:3], "1.0 2.0 3 4.0", *lines[4:]])  # noqa: E731
    with pytest.raises(UserError, match=r"after the image '000\.png' a line that is neither"):
        read_colmap(edited_model(tmp_path, edit))


@pytest.mark.parametrize(
    "name", ["Screenshot 10.01\u202fAM.png", "a\u00a0b.png", "日本.png", "a #1 (2).png"]
)
@pytest.mark.parametrize("binary", [True, False])
def test_unusual_names_are_read(tmp_path, name, binary):
    names = [name, "001.png", "002.png"]
    write_images(tmp_path / "images", names)
    write_colmap(tmp_path / "sparse/0", ring(3), names, binary=binary)
    assert sorted(view.name for view in read_scene(tmp_path).views) == sorted(names)


def test_a_name_in_another_encoding_is_reported(tmp_path):
    write_images(tmp_path / "images", names_of(3))
    write_colmap(tmp_path / "sparse/0", ring(3), names_of(3))
    path = tmp_path / "sparse/0/images.bin"
    path.write_bytes(path.read_bytes().replace(b"001.png", b"\xfc01.png"))
    with pytest.raises(UserError, match="encoding other than UTF-8"):
        read_scene(tmp_path)


@pytest.mark.parametrize("absent", [False, True])
def test_a_cut_off_file_of_points_is_told(tmp_path, absent):
    """Every second image of the text model shows point 3."""
    points = [(float(i), 0.0, 0.0) for i in range(6)]
    model = tmp_path / "sparse/0"
    write_colmap(model, ring(4), names_of(4), points=points, binary=False)
    write_images(tmp_path / "images", names_of(4))
    assert "points-missing" not in [each.code for each in read_colmap(tmp_path).findings]
    path = model / "points3D.txt"
    path.write_text("\n".join(path.read_text().splitlines()[:2]))
    if absent:
        path.unlink()
    (finding,) = (f for f in read_colmap(tmp_path).findings if f.code == "points-missing")
    assert "1 of the 1 points" in finding.message
    assert ("no points3D file" in finding.message) == absent
