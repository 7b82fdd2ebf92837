"""Exported scenes are read by the readers of this package and by COLMAP."""

import json
from dataclasses import replace

import numpy as np
import pytest
from support.scene_builders import names_of, ring, write_images

from climatenerf.core.errors import UserError
from climatenerf.scene import Camera, Scene, View, read_scene
from climatenerf.scene.export import export_colmap, export_transforms
from climatenerf.scene.readers.colmap import read_colmap
from climatenerf.scene.readers.transforms_json import read_transforms

CAMERAS = (
    Camera(32, 24, 30.0, 31.0, 16.2, 11.9, k1=0.01, k2=-0.002, p1=1e-4, p2=-2e-4),
    Camera(32, 24, 28.0, 28.0, 16.0, 12.0),
    Camera(32, 24, 20.0, 20.0, 16.0, 12.0, k1=0.02, k4=1e-3, fisheye=True),
    Camera(32, 24, 30.0, 30.0, 16.0, 12.0, k1=0.01, k3=0.003),
)


@pytest.fixture
def scene(tmp_path):
    names = names_of(9)
    write_images(tmp_path / "scene" / "images", names)
    points = np.random.default_rng(0).uniform(-1, 1, (40, 3))
    views = tuple(
        View(
            name,
            tmp_path / "scene" / "images" / name,
            i % len(CAMERAS),
            pose,
            "heldout" if i == 4 else "train",
            seen=np.arange(i, 40, 3),
        )
        for i, (name, pose) in enumerate(zip(names, ring(9), strict=True))
    )
    similarity = np.diag([3.0, 3.0, 3.0, 1.0])
    return Scene(tmp_path / "scene", "test", CAMERAS, views, points, similarity)


def assert_same(views, cameras, scene):
    assert [v.name for v in views] == [v.name for v in scene.views]
    for a, b in zip(views, scene.views, strict=True):
        np.testing.assert_allclose(a.c2w, b.c2w, atol=1e-9)
        assert a.path == b.path
        for name, value in vars(scene.cameras[b.camera]).items():
            assert getattr(cameras[a.camera], name) == pytest.approx(value, rel=1e-9), name


def test_transforms_round_trip(scene):
    export_transforms(scene, scene.root)
    again = read_transforms(scene.root)
    assert_same(again.views, again.cameras, scene)
    assert [v.split for v in again.views] == [v.split for v in scene.views]
    np.testing.assert_allclose(again.points, scene.points, atol=1e-6)
    assert read_scene(scene.root).views[0].name == "000.png"


def test_colmap_round_trip_with_tracks(scene):
    export_colmap(scene, scene.root)
    again = read_colmap(scene.root)
    assert_same(again.views, again.cameras, scene)
    np.testing.assert_allclose(again.points, scene.points, atol=1e-9)
    for a, b in zip(again.views, scene.views, strict=True):
        np.testing.assert_array_equal(np.sort(a.seen), b.seen)


def test_pycolmap_reads_the_model_without_reprojection_error(scene):
    pycolmap = pytest.importorskip("pycolmap")
    views = tuple(replace(v, camera=0) for v in scene.views)
    model = export_colmap(replace(scene, views=views), scene.root)
    found = pycolmap.Reconstruction(str(model))
    assert found.num_reg_images() == 9 and found.num_points3D() == 40
    found.update_point_3d_errors()
    assert found.compute_mean_reprojection_error() < 1e-3
    image = found.find_image_with_name("003.png")
    np.testing.assert_allclose(image.projection_center(), scene.views[3].c2w[:3, 3], atol=1e-9)


def test_paths_outside_the_folder_are_absolute_and_files_are_not_overwritten(scene, tmp_path):
    path = export_transforms(scene, tmp_path / "out")
    names = [f["file_path"] for f in json.loads(path.read_text())["frames"]]
    assert names[0] == str(scene.views[0].path)
    before = path.read_bytes()
    with pytest.raises(UserError, match="already exists"):
        export_transforms(scene, tmp_path / "out")
    assert path.read_bytes() == before
    export_colmap(scene, tmp_path / "out")
    with pytest.raises(UserError, match="already exists"):
        export_colmap(scene, tmp_path / "out")
