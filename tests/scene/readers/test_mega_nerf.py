"""Mega-NeRF: `train|val/metadata/*.pt` and `rgbs/`."""

import numpy as np
import pytest
import torch
from support.scene_builders import look_at, pinhole, pixel_of, write_images

from climatenerf.core.errors import UserError
from climatenerf.scene import read_scene

INTRINSICS = (30.0, 31.0, 15.0, 13.0)
K = [[30.0, 0, 15.0], [0, 31.0, 13.0], [0, 0, 1]]
ORIGIN = np.array([-150.0, 40.0, 25.0])  # down, right, backward: 150 m above 0
SCALE = 60.0
POINT = np.array([42.0, -31.0, 103.0])


def poses(count=8):
    """Poses in (right, forward, up) metres, OpenCV axes: a ring of drones that look inward."""
    turns = np.arange(count) / count * 2 * np.pi
    return [
        look_at((40 + 30 * np.cos(t), -25 + 30 * np.sin(t), 150 + 2 * np.sin(3 * t)), POINT)
        for t in turns
    ]


def drb(vectors):
    """Convert columns from (right, forward, up) to (down, right, backward)."""
    right, forward, up = vectors
    return np.stack([-up, right, -forward])


def stored(pose):
    """Stored pose, by the README of Mega-NeRF: DRB camera and world, columns reordered."""
    right, down, ahead = pose[:3, :3].T
    camera = drb(np.stack([down, right, -ahead, pose[:3, 3]], axis=-1))
    camera[:, 3] = (camera[:, 3] - ORIGIN) / SCALE
    return np.concatenate([camera[:, 1:2], -camera[:, :1], camera[:, 2:4]], axis=-1)


def save(path, **changes):
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save({k: v for k, v in changes.items() if v is not None}, path)


def make(root, suffix=".jpg", coordinates=True, turn=None):
    for i, upright in enumerate(poses()):
        pose = upright if turn is None else turn @ upright
        folder = root / ("val" if i in (0, 5) else "train")
        write_images(folder / "rgbs", [f"{i:06}{suffix}"])
        save(
            folder / "metadata" / f"{i:06}.pt",
            W=32, H=24, intrinsics=torch.tensor(INTRINSICS),
            c2w=torch.tensor(stored(pose), dtype=torch.float32),
            distortion=torch.zeros(4),
        )  # fmt: skip
    if coordinates:
        origin = torch.tensor(ORIGIN, dtype=torch.float32)
        save(root / "coordinates.pt", origin_drb=origin, pose_scale_factor=SCALE)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".JPG"])
def test_points_project_to_their_true_pixels(tmp_path, suffix):
    make(tmp_path, suffix)
    scene = read_scene(tmp_path)
    assert scene.source == "mega-nerf" and len(scene.views) == 8
    for view in scene.views:
        true = poses()[int(view.path.stem)]
        np.testing.assert_allclose(view.c2w, true, atol=2e-5)
        np.testing.assert_allclose(pixel_of(scene, view, POINT), pinhole(K, true, POINT), atol=1e-4)


def test_rays_match_the_formula_of_mega_nerf(tmp_path):
    make(tmp_path)
    scene = read_scene(tmp_path)
    for view in scene.views:
        x, y = 3.5, 20.5
        flat = np.array([(x - 15) / 30, -(y - 13) / 31, -1.0])
        ray = stored(poses()[int(view.path.stem)])[:, :3] @ flat
        found = scene.cameras[view.camera].directions(np.array([x, y])) @ view.c2w[:3, :3].T
        np.testing.assert_allclose(drb(found), ray / np.linalg.norm(ray), atol=1e-5)


def test_world_frame_is_metric_with_z_up(tmp_path):
    make(tmp_path)
    scene = read_scene(tmp_path)
    assert scene.scale_source == "metric-input"
    np.testing.assert_array_equal(scene.world_from_input, np.eye(4))
    positions = np.array([scene.c2w_world(v)[:3, 3] for v in scene.views])
    assert positions[:, 2].min() > 147 and positions[:, 2].max() < 153
    assert np.ptp(positions[:, 0]) == pytest.approx(60, abs=0.1)


def test_frame_with_tilted_cameras_is_not_taken_as_metric(tmp_path):
    """Mega-NeRF's converter from COLMAP writes `coordinates.pt` for such frames, too."""
    turn = np.eye(4)
    turn[:3, :3] = np.array([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]])
    make(tmp_path, turn=turn)
    scene = read_scene(tmp_path)
    assert scene.scale_source == "camera-height-assumed"
    up = scene.world_from_input[:3, :3] @ turn[:3, 2]
    assert up[2] / np.linalg.norm(up) > np.cos(np.radians(10))


def test_scale_is_assumed_without_coordinates(tmp_path):
    make(tmp_path, coordinates=False)
    scene = read_scene(tmp_path)
    assert scene.scale_source == "camera-height-assumed"
    positions = np.array([v.c2w[:3, 3] for v in scene.views])
    assert np.ptp(positions[:, 0]) == pytest.approx(60 / SCALE, rel=1e-3)


def test_split_follows_the_folders(tmp_path):
    make(tmp_path)
    scene = read_scene(tmp_path)
    assert [v.name for v in scene.of_split("heldout")] == ["val/000000.jpg", "val/000005.jpg"]


def good():
    return {
        "W": 32, "H": 24, "intrinsics": torch.tensor(INTRINSICS),
        "c2w": torch.tensor(stored(poses()[1])),
    }  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"intrinsics": None}, r"000001\.pt has no intrinsics"),
        ({"c2w": None}, r"000001\.pt has no c2w"),
        ({"intrinsics": torch.ones(3)}, r"intrinsics in .* has shape \(3,\) instead of \(4,\)"),
        ({"intrinsics": torch.zeros(4)}, "focal length 0"),
        ({"c2w": torch.eye(4)}, r"c2w in .* has shape \(4, 4\)"),
        ({"c2w": torch.full((3, 4), torch.nan)}, "not finite"),
        ({"c2w": torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0]])}, "no rotation"),
        ({"W": "wide"}, "W in .* is not numeric"),
        ({"W": float("nan")}, "not finite"),
        ({"W": 20}, "another shape"),
    ],
)
def test_invalid_metadata_raises(tmp_path, changes, message):
    make(tmp_path)
    save(tmp_path / "train/metadata/000001.pt", **{**good(), **changes})
    with pytest.raises(UserError, match=message) as caught:
        read_scene(tmp_path)
    assert "\n" not in str(caught.value)


class Malicious:
    """A pickle that runs code when loaded."""

    def __reduce__(self):
        return print, ("run",)


def test_damaged_files_raise_and_run_no_code(tmp_path, capsys):
    make(tmp_path)
    path = tmp_path / "train/metadata/000001.pt"
    original = path.read_bytes()
    for data in (b"", original[: len(original) // 2], b"not a file of torch"):
        path.write_bytes(data)
        with pytest.raises(UserError, match=r"000001\.pt cannot be read .*; download it again"):
            read_scene(tmp_path)
    no_dictionary = (torch.ones(3), "no dictionary of named values")
    for value, message in (no_dictionary, (Malicious(), "cannot be read")):
        torch.save(value, path)
        with pytest.raises(UserError, match=message):
            read_scene(tmp_path)
    assert "run" not in capsys.readouterr().out
    path.write_bytes(original)
    save(tmp_path / "coordinates.pt", origin_drb=torch.zeros(3), pose_scale_factor=0.0)
    with pytest.raises(UserError, match="not finite and above 0"):
        read_scene(tmp_path)


def test_missing_images_and_missing_poses(tmp_path):
    make(tmp_path)
    (tmp_path / "train/rgbs/000001.jpg").unlink()
    scene = read_scene(tmp_path)
    assert len(scene.views) == 7
    assert any("1 of the 8" in w and "000001.jpg" in w for w in scene.warnings)
    for path in tmp_path.glob("*/metadata/*.pt"):
        path.unlink()
    with pytest.raises(UserError, match=r"no \.pt in them"):
        read_scene(tmp_path)
