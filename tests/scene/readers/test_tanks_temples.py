"""The NSVF layout: `rgb/`, `pose/*.txt`, `intrinsics.txt`."""

import numpy as np
import pytest
from support.scene_builders import pinhole, ring, seen_at, write_images

from climatenerf.core.errors import UserError
from climatenerf.scene import read_scene

K = np.array([[30.0, 0, 15.0, 0], [0, 31.0, 13.0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
POINT = np.array([0.3, -0.2, 1.4])
STEMS = [f"{'1' if i % 3 == 0 else '0'}_{i:05}" for i in range(9)]


def text(matrix):
    return "\n".join(" ".join(repr(float(v)) for v in row) for row in matrix)


def make(root, stems=STEMS, folder="rgb", poses=None, intrinsics=None):
    poses = ring(len(stems)) if poses is None else poses
    write_images(root / folder, [f"{s}.png" for s in stems])
    (root / "pose").mkdir()
    for stem, pose in zip(stems, poses, strict=True):
        (root / "pose" / f"{stem}.txt").write_text(text(pose))
    (root / "intrinsics.txt").write_text(text(K) if intrinsics is None else intrinsics)
    (root / "bbox.txt").write_text("-1 -1 -1 1 1 1 0.1")
    return dict(zip(stems, poses, strict=True))


@pytest.mark.parametrize("folder", ["rgb", "images"])
def test_a_known_point_is_seen_where_it_was_put(tmp_path, folder):
    poses = make(tmp_path, folder=folder)
    scene = read_scene(tmp_path)
    assert scene.source == "tanks-temples" and len(scene.views) == 9
    for view in scene.views:
        wanted = pinhole(K, poses[view.path.stem], POINT)
        np.testing.assert_allclose(seen_at(scene, view, POINT), wanted, atol=1e-9)
        assert view.path.parent.name == folder and view.path.is_file()


def test_the_prefix_is_the_split(tmp_path):
    make(tmp_path)
    scene = read_scene(tmp_path)
    assert [v.name for v in scene.of_split("heldout")] == [f"1_{i:05}.png" for i in (0, 3, 6)]


@pytest.mark.parametrize(
    ("prefixes", "heldout"), [("002", ["2_00002"]), ("000000000", ["0_00000", "0_00008"])]
)
def test_two_is_for_testing_and_no_test_picture_means_every_eighth(tmp_path, prefixes, heldout):
    make(tmp_path, [f"{p}_{i:05}" for i, p in enumerate(prefixes)])
    assert [v.path.stem for v in read_scene(tmp_path).of_split("heldout")] == heldout


def test_distances_are_those_of_the_files(tmp_path):
    """Positions alone enter scale and centre.

    The homogeneous 1 would be most of the norm of positions as small as these, and scale and
    distances would no longer go together when the scene is written a hundred times as large.
    """
    poses = make(tmp_path, poses=ring(9, radius=0.01, height=0.016))
    scene = read_scene(tmp_path)
    raw = np.array([poses[v.path.stem][:3, 3] for v in scene.views])
    np.testing.assert_allclose([v.c2w[:3, 3] for v in scene.views], raw, atol=1e-12)
    world = np.array([scene.c2w_world(v)[:3, 3] for v in scene.views])
    apart = [np.linalg.norm(p[:, None] - p[None], axis=-1) for p in (raw, world)]
    np.testing.assert_allclose(apart[1], apart[0] * scene.scale, rtol=1e-9, atol=1e-12)
    # The same scene a hundred times as large is the same scene in metres.
    (tmp_path / "b").mkdir()
    large = ring(9, radius=0.01, height=0.016)
    for pose in large:
        pose[:3, 3] *= 100
    make(tmp_path / "b", poses=large)
    other = read_scene(tmp_path / "b")
    assert other.scale * 100 == pytest.approx(scene.scale)
    np.testing.assert_allclose([other.c2w_world(v)[:3, 3] for v in other.views], world, atol=1e-9)


@pytest.mark.parametrize(
    ("intrinsics", "wanted"),
    [
        (" ".join(repr(float(v)) for v in K.flat), (30, 31, 15, 13)),
        ("28.5 16 12 0.\n0. 0. 0.\n0.\n1.\n24 32\n", (28.5, 28.5, 16, 12)),
        ("28.5\n", (28.5, 28.5, 16, 12)),
        (text(K[:3]), (30, 31, 15, 13)),
    ],
)
def test_ways_to_write_intrinsics(tmp_path, intrinsics, wanted):
    make(tmp_path, intrinsics=intrinsics)
    camera = read_scene(tmp_path).cameras[0]
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == wanted


def test_pictures_without_pose_and_poses_without_picture_are_told(tmp_path):
    make(tmp_path)
    (tmp_path / "rgb/0_00001.png").unlink()
    (tmp_path / "pose/0_00002.txt").unlink()
    scene = read_scene(tmp_path)
    assert len(scene.views) == 7
    assert any("1 of the 8" in w and "0_00001.png" in w for w in scene.warnings)
    assert any("1 pictures have no pose (first: 0_00002.png)" in w for w in scene.warnings)


def damaged_pose(root, words):
    (root / "pose/0_00001.txt").write_text(words)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda r: (r / "intrinsics.txt").unlink(), r"intrinsics\.txt is missing; get it"),
        (lambda r: (r / "intrinsics.txt").write_text(" \n"), "is empty; it must hold"),
        (lambda r: (r / "intrinsics.txt").write_text(text(K)[:-4]), "has 15 numbers instead of"),
        (lambda r: (r / "intrinsics.txt").write_text("nan"), "not finite"),
        (lambda r: (r / "intrinsics.txt").write_text(text(K + np.eye(4, k=1))), "has skew"),
        (lambda r: (r / "intrinsics.txt").write_text("f = 3"), "not numbers only: 'f = 3'"),
        (lambda r: (r / "intrinsics.txt").write_text(text(4 * K)), "outside of the 32x24"),
        (lambda r: damaged_pose(r, "1 2 3"), r"0_00001\.txt has 3 numbers instead of the 16"),
        (lambda r: damaged_pose(r, text(np.full((4, 4), np.nan))), "not finite"),
        (lambda r: damaged_pose(r, text(np.diag([1, 1, -1, 1]))), "holds no rotation matrix"),
        (lambda r: damaged_pose(r, text(np.diag([1, 2, 3, 1]))), "holds no rotation matrix"),
        (lambda r: write_images(r / "rgb", ["0_00001.png"], (20, 24)), "another shape"),
        (lambda r: (r / "rgb").rename(r / "pictures"), "neither rgb/ nor images/"),
        (
            lambda r: [p.rename(p.with_name(f"x{p.name}")) for p in list((r / "rgb").iterdir())],
            "has the name of a pose",
        ),
    ],
)
def test_what_is_wrong_is_said_in_one_sentence(tmp_path, damage, message):
    make(tmp_path)
    damage(tmp_path)
    with pytest.raises(UserError, match=message) as caught:
        read_scene(tmp_path)
    assert "\n" not in str(caught.value) and str(caught.value).endswith(".")
