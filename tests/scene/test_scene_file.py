import errno
import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.scene_builders import names_of, ring, write_colmap, write_images

from climatenerf.core.errors import UserError
from climatenerf.scene import load_scene, read_scene, save_scene
from climatenerf.scene.readers.ply import read_points, write_points

POINTS = np.random.default_rng(1).normal(size=(50, 3))


@pytest.fixture
def scene(tmp_path):
    root = tmp_path / "capture"
    write_images(root / "images", names_of(9))
    write_images(root / "masks", names_of(2))
    write_colmap(root / "sparse/0", ring(9), names_of(9), points=POINTS)
    return read_scene(root)


def test_scene_round_trip(scene, tmp_path):
    path = save_scene(scene, tmp_path / "run")
    again = load_scene(tmp_path / "run")
    assert path.name == "scene.json" and load_scene(path).root == scene.root
    assert again.cameras == scene.cameras and again.root == scene.root
    for a, b in zip(again.views, scene.views, strict=True):
        np.testing.assert_array_equal(a.c2w, b.c2w)
        assert replace(a, c2w=b.c2w) == b
    np.testing.assert_array_equal(again.points, scene.points)
    np.testing.assert_array_equal(again.world_from_input, scene.world_from_input)
    for name in ("source", "scale_source", "scale_error", "ground_z", "lowest_ground_z"):
        assert getattr(again, name) == getattr(scene, name)
    assert again.up_report == scene.up_report and again.warnings == scene.warnings


def test_observations_round_trip_and_can_be_deleted(scene, tmp_path):
    rng = np.random.default_rng(0)
    seen = [np.sort(rng.choice(50, size=i, replace=False)) for i in range(9)]
    views = tuple(replace(v, seen=s) for v, s in zip(scene.views, seen, strict=True))
    save_scene(replace(scene, views=views), tmp_path / "run")
    for view, expected in zip(load_scene(tmp_path / "run").views, seen, strict=True):
        np.testing.assert_array_equal(view.seen, expected)
    file = tmp_path / "run/points_seen.npz"
    np.savez(file, view=[0], point=[50])
    with pytest.raises(UserError, match="delete it"):
        load_scene(tmp_path / "run")
    file.write_bytes(b"PK\x03\x04 not a zip")
    with pytest.raises(UserError, match="delete it"):
        load_scene(tmp_path / "run")
    file.write_bytes(b"")
    with pytest.raises(UserError, match="delete it"):
        load_scene(tmp_path / "run")
    file.unlink()  # as the message advises
    assert load_scene(tmp_path / "run").views[3].seen is None
    unobserved = tuple(replace(v, seen=None) for v in scene.views)
    save_scene(replace(scene, views=unobserved), tmp_path / "run")
    assert not file.exists() and load_scene(tmp_path / "run").views[0].seen is None


def test_saved_paths_are_relative(scene, tmp_path):
    save_scene(scene, tmp_path / "run")
    data = json.loads((tmp_path / "run/scene.json").read_text())
    assert data["views"][0]["path"] == "images/000.png"
    assert data["root"] == os.path.join("..", "capture") and data["schema_version"] == 1


def test_scene_loads_after_both_folders_moved(scene, tmp_path):
    save_scene(scene, tmp_path / "run")
    (tmp_path / "new").mkdir()
    for name in ("run", "capture"):
        (tmp_path / name).rename(tmp_path / "new" / name)
    assert load_scene(tmp_path / "new/run").views[0].path.is_file()


def test_scene_loads_after_the_run_folder_moved(scene, tmp_path):
    save_scene(scene, tmp_path / "run")
    (tmp_path / "a/b").mkdir(parents=True)
    (tmp_path / "run").rename(tmp_path / "a/b/run")
    assert load_scene(tmp_path / "a/b/run").views[0].path.is_file()


def test_world_poses_are_rigid_and_in_metres(scene):
    for view in scene.views:
        pose = scene.c2w_world(view)
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        expected = scene.world_from_input @ view.c2w[:, 3]
        np.testing.assert_allclose(pose[:, 3], expected, atol=1e-12)


def test_newer_schema_raises_with_both_versions(scene, tmp_path):
    path = save_scene(scene, tmp_path / "run")
    data = json.loads(path.read_text())
    path.write_text(json.dumps({**data, "schema_version": 7}))
    with pytest.raises(UserError, match=r"version 7.* up to 1"):
        load_scene(tmp_path / "run")


@pytest.mark.parametrize(
    "change",
    [
        lambda d: d.pop("views"),
        lambda d: d.update(world_from_input=[[1]]),
        lambda d: d.update(ground_z=float("nan")),
        lambda d: d["views"][0].update(camera=9),
        lambda d: d["views"][0].update(split="maybe"),
        lambda d: d["views"][0]["c2w"][0].__setitem__(0, None),
        lambda d: d.update(views=[]),
        lambda d: d.update(schema_version="one"),
        lambda d: d["cameras"][0].update(zoom=3),
    ],
)
def test_damaged_scene_file_raises(scene, tmp_path, change):
    path = save_scene(scene, tmp_path / "run")
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))
    with pytest.raises(UserError, match=r"scene\.json"):
        load_scene(tmp_path / "run")


def test_missing_and_malformed_scene_files_raise(tmp_path):
    with pytest.raises(UserError, match=r"scene\.json does not exist"):
        load_scene(tmp_path)
    (tmp_path / "scene.json").write_text("{")
    with pytest.raises(UserError, match="not valid JSON"):
        load_scene(tmp_path)
    (tmp_path / "scene.json").write_text("[1]")
    with pytest.raises(UserError, match="JSON object"):
        load_scene(tmp_path)


def test_full_disk_leaves_the_saved_scene_intact(scene, tmp_path, monkeypatch):
    path = save_scene(scene, tmp_path / "run")
    before = path.read_bytes()

    def full(self, data):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(UserError, match="disk is full"):
        save_scene(replace(scene, ground_z=5.0), tmp_path / "run")
    assert path.read_bytes() == before
    assert sorted(p.name for p in (tmp_path / "run").iterdir()) == [
        "points.ply",
        "points_seen.npz",
        "scene.json",
    ]


def test_folder_that_cannot_be_created_raises(scene, tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(UserError, match="cannot create"):
        save_scene(scene, tmp_path / "file" / "run")


def test_ply_in_ascii_and_big_endian(tmp_path):
    head = "element vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
    head += "property uchar red\nelement face 0\nproperty list uchar int vertex_indices\n"
    a = tmp_path / "a.ply"
    a.write_text(f"ply\nformat ascii 1.0\n{head}end_header\n1 2 3 255\n4 5 6.5 0\n")
    np.testing.assert_array_equal(read_points(a), [[1, 2, 3], [4, 5, 6.5]])
    kind = np.dtype([("x", ">f4"), ("y", ">f4"), ("z", ">f4"), ("r", "u1")])
    body = np.array([(1, 2, 3, 255), (4, np.nan, 6.5, 0)], kind).tobytes()
    a.write_bytes(f"ply\nformat binary_big_endian 1.0\n{head}end_header\n".encode() + body)
    np.testing.assert_array_equal(read_points(a), [[1, 2, 3]])
    a.write_bytes(a.read_bytes()[:-3])
    with pytest.raises(UserError, match=r"a\.ply"):
        read_points(a)


def test_invalid_ply_raises(tmp_path):
    path = Path(tmp_path / "x.ply")
    path.write_bytes(b"hello")
    with pytest.raises(UserError, match=r"x\.ply"):
        read_points(path)
    with pytest.raises(UserError, match=r"y\.ply"):
        read_points(tmp_path / "y.ply")
    write_points(path, POINTS)
    np.testing.assert_array_equal(read_points(path), POINTS)
