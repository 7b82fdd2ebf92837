"""Import of an existing COLMAP model through the command line: the embedded street as text."""

import shutil

import numpy as np
import pytest
from PIL import Image
from support.command_line import STREET, run_cli
from support.photo_builders import exif

from climatenerf.scene import load_scene, read_scene
from climatenerf.scene.export import export_colmap
from climatenerf.scene.images import load_labels

HOME = (47.3769, 8.5417)
LAT_M, LON_M = 111177.0, 75520.0  # m per degree at HOME


@pytest.fixture(scope="module")
def posed(tmp_path_factory):
    """Twelve photos with GPS and gravity; the model contains all but the last."""
    truth = read_scene(STREET, holdout="0")
    root = tmp_path_factory.mktemp("posed")
    export_colmap(truth, root)
    lines = (root / "sparse" / "0" / "images.txt").read_text().splitlines()
    head, rest = lines[:1], lines[1:]
    kept = [rest[2 * i : 2 * i + 2] for i in range(0, 55, 5)]
    (root / "sparse" / "0" / "images.txt").write_text("\n".join(head + sum(kept, [])) + "\n")
    for view in truth.views[0:60:5]:
        pose = truth.c2w_world(view)
        x, y, z = pose[:3, 3]
        g = pose[:3, :3].T @ np.array([0, 0, -1.0])
        data = exif(
            gps=(HOME[0] + 2 * y / LAT_M, HOME[1] + 2 * x / LON_M, z),
            gravity=(-g[1], -g[0], -g[2]),
            camera=("Apple", "iPhone 12"),
        )
        path = root / "photos" / view.name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.open(view.path).convert("RGB").save(path, format="JPEG", quality=95, exif=data)
    return truth, root


def test_model_photos_and_labels_become_a_scene(posed, tmp_path, capsys):
    truth, root = posed
    labels = STREET / "labels"
    out = tmp_path / "scene"
    args = ("capture", root / "photos", "--from-colmap", root, "-o", out, "--labels", labels)
    assert run_cli(*args) == 0
    output = capsys.readouterr()
    assert "11 of 12 pictures have poses" in output.out
    assert "it is not in the COLMAP model" in output.err
    scene = load_scene(out)
    assert len(scene.views) == 11 and scene.scale_source == "gps"
    by_name = {view.name: view for view in truth.views}
    for view in scene.views:
        # GPS was written for a street twice as large.
        estimated, true = scene.c2w_world(view), truth.c2w_world(by_name[view.name])
        np.testing.assert_allclose(
            estimated[:2, 3], 2 * true[:2, 3] + offset(scene, truth), atol=0.06
        )
        assert view.path.read_bytes() == (root / "photos" / view.name).read_bytes()
        found, given = load_labels(view, scene), load_labels(by_name[view.name], truth)
        np.testing.assert_array_equal(found, given)
    assert scene.up_report["gravity"] < 1 and "gravity" in scene.up_report["used"]
    up = scene.world_from_input[2, :3] / scene.scale
    assert np.degrees(np.arccos(up[2])) < 1
    assert "Reprojection error: unknown" in (out / "report.md").read_text()
    # The scene folder is self-contained.
    assert run_cli("export", out, "-o", tmp_path / "out") == 0


def offset(scene, truth):
    """Offset from the doubled street to the GPS frame, whose origin is the median position."""
    return -np.array([
        (scene.georeference["longitude"] - HOME[1]) * LON_M,
        (scene.georeference["latitude"] - HOME[0]) * LAT_M,
    ])  # fmt: skip


def test_labels_can_be_added_in_a_second_run(posed, tmp_path):
    _, root = posed
    out = tmp_path / "scene"
    args = ("capture", root / "photos", "--from-colmap", root / "sparse", "-o", out)
    assert run_cli(*args) == 0
    assert all(view.label_path is None for view in load_scene(out).views)
    assert run_cli(*args, "--labels", STREET / "labels") == 0
    assert all(view.label_path is not None for view in load_scene(out).views)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda root, here: (here / "no-model", root / "photos"), "contains no COLMAP model"),
        (lambda root, here: (root, here / "photos"), "0 of the 11 pictures"),
        (lambda root, here: (root, root / "photos" / "none.jpg"), "does not exist"),
    ],
)
def test_mismatched_inputs_give_one_error_sentence(posed, tmp_path, capsys, change, message):
    _, root = posed
    (tmp_path / "photos").mkdir()
    (tmp_path / "no-model").mkdir()
    model, photos = change(root, tmp_path)
    out = tmp_path / "scene"
    assert run_cli("capture", photos, "--from-colmap", model, "-o", out) == 2
    output = capsys.readouterr().err
    assert message in output and "Traceback" not in output
    assert not (out / "scene.json").exists()


def test_photos_in_the_output_folder_are_not_removed(posed, tmp_path, capsys):
    _, root = posed
    mine = tmp_path / "mine"
    shutil.copytree(root / "photos", mine / "images")
    shutil.copytree(root / "sparse", mine / "sparse")
    before = sorted(p.name for p in mine.rglob("*"))
    for photos, out in ((mine / "images", mine), (mine, mine), (mine / "images", mine / "images")):
        assert run_cli("capture", photos, "--from-colmap", mine, "-o", out) == 2
        assert "another folder" in capsys.readouterr().err
        assert sorted(p.name for p in mine.rglob("*")) == before


def test_sidecar_flags_need_existing_folders(posed, tmp_path, capsys):
    _, root = posed
    args = ("capture", root / "photos", "--from-colmap", root, "-o", tmp_path / "scene")
    for kind in ("labels", "masks", "depth"):
        assert run_cli(*args, f"--{kind}", tmp_path / "absent") == 2
        assert f"--{kind}" in capsys.readouterr().err
