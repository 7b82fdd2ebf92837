"""The NSVF layout: `rgb/`, `pose/*.txt`, `intrinsics.txt`."""

import numpy as np
import pytest
from support.scene_builders import pinhole, pixel_of, ring, write_images

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
def test_points_project_to_their_true_pixels(tmp_path, folder):
    poses = make(tmp_path, folder=folder)
    scene = read_scene(tmp_path)
    assert scene.source == "tanks-temples" and len(scene.views) == 9
    for view in scene.views:
        expected = pinhole(K, poses[view.path.stem], POINT)
        np.testing.assert_allclose(pixel_of(scene, view, POINT), expected, atol=1e-9)
        assert view.path.parent.name == folder and view.path.is_file()


def test_split_follows_the_prefix(tmp_path):
    make(tmp_path)
    scene = read_scene(tmp_path)
    assert [v.name for v in scene.of_split("heldout")] == [f"1_{i:05}.png" for i in (0, 3, 6)]


@pytest.mark.parametrize(
    ("prefixes", "heldout"), [("002", ["2_00002"]), ("000000000", ["0_00000", "0_00008"])]
)
def test_prefix_2_is_held_out_and_default_split_is_every_eighth(tmp_path, prefixes, heldout):
    make(tmp_path, [f"{p}_{i:05}" for i, p in enumerate(prefixes)])
    assert [v.path.stem for v in read_scene(tmp_path).of_split("heldout")] == heldout


def test_distances_scale_with_the_poses(tmp_path):
    """Scale and centre depend on positions only, not on their homogeneous coordinate.

    For positions as small as these, the homogeneous 1 would dominate their norm.
    """
    poses = make(tmp_path, poses=ring(9, radius=0.01, height=0.016))
    scene = read_scene(tmp_path)
    raw = np.array([poses[v.path.stem][:3, 3] for v in scene.views])
    np.testing.assert_allclose([v.c2w[:3, 3] for v in scene.views], raw, atol=1e-12)
    world = np.array([scene.c2w_world(v)[:3, 3] for v in scene.views])
    before, after = [np.linalg.norm(p[:, None] - p[None], axis=-1) for p in (raw, world)]
    np.testing.assert_allclose(after, before * scene.scale, rtol=1e-9, atol=1e-12)
    # A scene written a hundred times as large is the same scene in metres.
    (tmp_path / "b").mkdir()
    large = ring(9, radius=0.01, height=0.016)
    for pose in large:
        pose[:3, 3] *= 100
    make(tmp_path / "b", poses=large)
    other = read_scene(tmp_path / "b")
    assert other.scale * 100 == pytest.approx(scene.scale)
    np.testing.assert_allclose([other.c2w_world(v)[:3, 3] for v in other.views], world, atol=1e-9)


@pytest.mark.parametrize(
    ("intrinsics", "expected"),
    [
        (" ".join(repr(float(v)) for v in K.flat), (30, 31, 15, 13)),
        ("28.5 16 12 0.\n0. 0. 0.\n0.\n1.\n24 32\n", (28.5, 28.5, 16, 12)),
        ("28.5\n", (28.5, 28.5, 16, 12)),
        (text(K[:3]), (30, 31, 15, 13)),
    ],
)
def test_forms_of_intrinsics(tmp_path, intrinsics, expected):
    make(tmp_path, intrinsics=intrinsics)
    camera = read_scene(tmp_path).cameras[0]
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == expected


def test_unposed_images_and_missing_images_give_warnings(tmp_path):
    make(tmp_path)
    (tmp_path / "rgb/0_00001.png").unlink()
    (tmp_path / "pose/0_00002.txt").unlink()
    scene = read_scene(tmp_path)
    assert len(scene.views) == 7
    assert any("1 of the 8" in w and "0_00001.png" in w for w in scene.warnings)
    notes = [str(each) for each in scene.findings]
    assert any("1 images have no pose (first: 0_00002.png)" in note for note in notes)


def damage_pose(root, content):
    (root / "pose/0_00001.txt").write_text(content)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda r: (r / "intrinsics.txt").unlink(), r"intrinsics\.txt is missing; restore it"),
        (lambda r: (r / "intrinsics.txt").write_text(" \n"), "is empty; write"),
        (lambda r: (r / "intrinsics.txt").write_text(text(K)[:-4]), "has 15 numbers instead of"),
        (lambda r: (r / "intrinsics.txt").write_text("nan"), "not finite"),
        (lambda r: (r / "intrinsics.txt").write_text(text(K + np.eye(4, k=1))), "has skew"),
        (lambda r: (r / "intrinsics.txt").write_text("f = 3"), "more than numbers: 'f = 3'"),
        (lambda r: (r / "intrinsics.txt").write_text(text(4 * K)), "outside the 32x24"),
        (lambda r: damage_pose(r, "1 2 3"), r"0_00001\.txt has 3 numbers instead of the 16"),
        (lambda r: damage_pose(r, text(np.full((4, 4), np.nan))), "not finite"),
        (lambda r: damage_pose(r, text(np.diag([1, 1, -1, 1]))), "contains no rotation matrix"),
        (lambda r: damage_pose(r, text(np.diag([1, 2, 3, 1]))), "contains no rotation matrix"),
        (lambda r: write_images(r / "rgb", ["0_00001.png"], (20, 24)), "another shape"),
        (lambda r: (r / "rgb").rename(r / "pictures"), "neither rgb/ nor images/"),
        (
            lambda r: [p.rename(p.with_name(f"x{p.name}")) for p in list((r / "rgb").iterdir())],
            "has the name of a pose",
        ),
    ],
)
def test_damage_raises_one_sentence(tmp_path, damage, message):
    make(tmp_path)
    damage(tmp_path)
    with pytest.raises(UserError, match=message) as caught:
        read_scene(tmp_path)
    assert "\n" not in str(caught.value) and str(caught.value).endswith(".")
